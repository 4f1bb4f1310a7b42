#include "imu_pose_calib/simulation/simulator_options.h"

namespace imu_pose_calib {

Motion ParseMotion(const std::string& name) {
  for (const auto& [motion, known] : kMotions)
    if (name == known) return motion;
  throw InputError("motion '" + name +
                   "' is unknown; must be handheld, tumble, arm, drone, planar, hinge or static");
}

std::vector<Effect> Effects(SimulatorOptions* options) {
  RealEffects& real = options->effects;
  StreamEffects &pose = real.pose_stream, &imu = real.imu_stream;
  const char *cutoff = "cutoff of a first-order low-pass", *jitter = "sigma of the stamps",
             *latency = "mean of an exponential delay of the stamps",
             *burst = "samples that are stamped together", *step = "to which stamps are cut",
             *drops = "samples that are missing";
  return {
      {"vibration", &real.vibration, 2.0, 0.0, 1e3, "M/S^2",
       "of the body, 20 to 80 Hz, rms per axis; it turns along"},
      {"rocking", &real.rocking, 0.1, 0.0, 1e2, "RAD/S",
       "of the body about a point 0.2 m off, 20 to 80 Hz, rms per axis"},
      {"shocks", &real.shocks, 20.0, 0.0, 1e4, "M/S^2",
       "peak of jolts of the body, 30 a minute; it turns along"},
      {"gyro-filter", &real.gyro_filter_hz, 50.0, 0.0, 1e5, "HZ", cutoff},
      {"accel-filter", &real.accel_filter_hz, 50.0, 0.0, 1e5, "HZ", cutoff},
      {"scale-misalignment", &real.scale_misalignment, 5e-3, 0.0, 1.0, "1",
       "of gyroscope and accelerometer, sigma of the elements"},
      {"size-effect", &real.size_effect, 3e-3, 0.0, 1.0, "M",
       "distance between the axes of the accelerometer"},
      {"g-sensitivity", &real.g_sensitivity, 2e-4, 0.0, 1.0, "S/M",
       "of the gyroscope, rad/s per m/s^2, sigma of the elements"},
      {"temperature-drift", &real.temperature_drift, 1e-2, 0.0, 10.0, "RAD/S",
       "of the gyroscope's bias within minutes; of the accelerometer's ten times as much"},
      {"pose-exposure", &options->pose_exposure_s, 1e-2, 0.0, 1.0, "S",
       "time over which a pose is the mean"},
      {"pose-scale", &real.pose_scale, 2e-3, -0.9, 10.0, "1", "of the positions, less 1"},
      {"slow-errors", &real.slow_errors, 1e-3, 0.0, 10.0, "M",
       "of positions, and of rotations in rad, that last for 3 s"},
      {"marker-offset", &real.marker_offset, 0.1, 0.0, 10.0, "M",
       "of the marker's origin from the points that are tracked"},
      {"fused-poses", &real.fused_poses_s, 0.05, 0.0, 10.0, "S",
       "time over which positions are smoothed and rotations follow the gyroscope"},
      {"pose-updates", &real.pose_updates, 2e-3, 0.0, 10.0, "M",
       "sigma of positions, 20 a second, that correct poses which an imu carries on in between"},
      {"clock-drift", &options->clock_drift, 2e-5, -0.1, 0.1, "S/S", "growth of the time shift"},
      {"imu-wander", &imu.wander_s, 2e-3, -1.0, 1.0, "S",
       "amplitude of a sine of a minute that the imu's clock follows"},
      {"imu-clock-step", &imu.clock_step_s, 5e-3, -1.0, 1.0, "S",
       "by which the imu's clock jumps ahead, once"},
      {"pose-clock-step", &pose.clock_step_s, 5e-3, -1.0, 1.0, "S",
       "by which the clock of the poses jumps ahead, once"},
      {"gravity", &real.gravity, 0.02, -1.0, 1.0, "M/S^2",
       "by which gravity is stronger than 9.80665"},
      {"pose-jitter", &pose.jitter_s, 1e-3, 0.0, 10.0, "S", jitter},
      {"imu-jitter", &imu.jitter_s, 1e-3, 0.0, 10.0, "S", jitter},
      {"pose-latency", &pose.latency_s, 2e-3, 0.0, 10.0, "S", latency},
      {"imu-latency", &imu.latency_s, 2e-3, 0.0, 10.0, "S", latency},
      {"pose-burst", &pose.burst, 3.0, 0.0, 1e3, "N", burst},
      {"imu-burst", &imu.burst, 5.0, 0.0, 1e3, "N", burst},
      {"pose-stamp-step", &pose.step_s, 4e-3, 0.0, 10.0, "S", step},
      {"imu-stamp-step", &imu.step_s, 4e-3, 0.0, 10.0, "S", step},
      {"pose-drops", &pose.drops, 2.0, 0.0, 90.0, "%", drops},
      {"imu-drops", &imu.drops, 2.0, 0.0, 90.0, "%", drops},
      {"soft-mount", &real.mount_hz, 25.0, 0.0, 1e5, "HZ",
       "resonance of the spring that holds the imu"},
      {"pose-drift", &real.pose_drift, 5e-3, 0.0, 10.0, "M",
       "of the frame of the poses, a walk: sigma after 1 m of way, and a tenth of it in rad"},
  };
}

}  // namespace imu_pose_calib
