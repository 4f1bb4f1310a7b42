// Accuracy of rigs over simulated recordings of known truth: several sessions against one of the
// same length, and two IMUs on one body with clocks of their own against each alone. RMS errors in
// units of the sigma that the single long session, or the IMU alone, reports by the model (its
// bound), and normalised error squared per degree of freedom of the model's covariance.
//
//   rig_accuracy [SEEDS = 30] [SECONDS = 60]

#include <Eigen/Cholesky>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

/// Sums over seeds of the errors of a transform [m, rad].
struct Errors {
  double translation2 = 0.0, rotation2 = 0.0, nees = 0.0, translation_variance = 0.0,
         rotation_variance = 0.0;

  void Add(const Rigid3& T, const Matrix6d& covariance, const Rigid3& truth) {
    Vector6d e;
    e << T.p - truth.p, Log(Eigen::Quaterniond(truth.q.conjugate() * T.q));
    translation2 += e.head<3>().squaredNorm();
    rotation2 += e.tail<3>().squaredNorm();
    translation_variance += covariance.topLeftCorner<3, 3>().trace();
    rotation_variance += covariance.bottomRightCorner<3, 3>().trace();
    nees += e.dot(covariance.llt().solve(e)) / 6.0;
  }
  void Print(const std::string& name, const Errors& bound, int seeds) const {
    std::printf("  %-28s%9.4f mm %9.5f deg%8.2f%8.2f%8.2f%8.2f%9.2f\n", name.c_str(),
                1e3 * std::sqrt(translation2 / seeds), 180.0 / M_PI * std::sqrt(rotation2 / seeds),
                std::sqrt(translation2 / bound.translation_variance),
                std::sqrt(rotation2 / bound.rotation_variance),
                std::sqrt(translation_variance / bound.translation_variance),
                std::sqrt(rotation_variance / bound.rotation_variance), nees / seeds);
  }
};

SimulatorOptions Truth(int seed, double duration_s) {
  SimulatorOptions truth;
  truth.seed = 2000 + static_cast<unsigned>(seed);
  truth.duration_s = duration_s;
  truth.accel_delay_s = 2e-3;
  return truth;
}

void Header(const char* title) {
  std::printf("\n%s\n%52s%16s\n  %-28s%12s %12s%8s%8s%8s%8s%9s\n", title, "RMS / bound",
              "sigma / bound", "", "RMS", "RMS", "p", "R", "p", "R", "nees");
}

/// Sessions of a quarter of the time, each with a motion, world and clock of its own.
void CompareSessions(int seeds, double duration_s) {
  Errors whole, sessions, moved;
  int named = 0;
  for (int seed = 1; seed <= seeds; ++seed) {
    const SimulatorOptions truth = Truth(seed, duration_s);
    const Calibration one = Calibrate({}, Simulate(truth));
    whole.Add(one.imus[0].T_MI, one.imus[0].model_covariance, truth.T_MI);
    std::vector<SessionData> data, with_moved;
    for (unsigned k = 0; k < 4; ++k) {
      SimulatorOptions part = Truth(seed, 0.25 * duration_s);
      part.seed = truth.seed + 1000 * k;
      part.time_shift_s = 0.02 + 100.0 * k;
      part.g_W = Exp(Eigen::Vector3d(0.3 * k, 0.1, 0.0)) * part.g_W;
      data.push_back(Simulate(part));
      if (k == 1) part.T_MI.p.z() += 2e-3;
      with_moved.push_back(Simulate(part));
    }
    const Calibration rig = Calibrate({}, data);
    sessions.Add(rig.imus[0].T_MI, rig.imus[0].model_covariance, truth.T_MI);
    const Calibration wrong = Calibrate({}, with_moved);
    named += wrong.message.find("session 2 stands out: translation z") == 0 ? 1 : 0;
    if (seed == 1) std::printf("%s\n%s\n", rig.message.c_str(), wrong.message.c_str());
  }
  Header("sessions");
  whole.Print("one session", whole, seeds);
  sessions.Print("four sessions of a quarter", whole, seeds);
  std::printf("  a marker moved by 2 mm in session 2 is named in %d of %d\n", named, seeds);
}

void CompareImus(int seeds, double duration_s) {
  Errors alone[2], together[2], between, between_alone;
  for (int seed = 1; seed <= seeds; ++seed) {
    const SimulatorOptions truth[2] = {Truth(seed, duration_s),
                                       FurtherImu(Truth(seed, duration_s), 1)};
    SessionData both = Simulate(truth[0], 2);
    const SessionData second = {both.poses, {both.imus[1]}, {}};
    const Calibration rig = Calibrate({}, both);
    both.imus.pop_back();
    const Calibration single[2] = {Calibrate({}, both), Calibrate({}, second)};
    for (size_t i = 0; i < 2; ++i) {
      together[i].Add(rig.imus[i].T_MI, rig.imus[i].model_covariance, truth[i].T_MI);
      alone[i].Add(single[i].imus[0].T_MI, single[i].imus[0].model_covariance, truth[i].T_MI);
    }
    const Rigid3 true_between = truth[0].T_MI.Inverse() * truth[1].T_MI;
    between.Add(rig.between_imus[0].T, rig.between_imus[0].covariance, true_between);
    between_alone.Add(single[0].imus[0].T_MI.Inverse() * single[1].imus[0].T_MI,
                      rig.between_imus[0].covariance, true_between);
  }
  Header("two imus");
  for (size_t i = 0; i < 2; ++i) {
    alone[i].Print("imu" + std::to_string(i) + " alone", alone[i], seeds);
    together[i].Print("imu" + std::to_string(i) + " together", together[i], seeds);
  }
  between_alone.Print("between, from two runs", between, seeds);
  between.Print("between, from one", between, seeds);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  const int seeds = argc > 1 ? std::atoi(argv[1]) : 30;
  const double duration_s = argc > 2 ? std::atof(argv[2]) : 60.0;
  if (seeds < 1 || !(duration_s > 0.0)) {
    std::fprintf(stderr, "usage: rig_accuracy [SEEDS] [SECONDS]\n");
    return 1;
  }
  imu_pose_calib::CompareSessions(seeds, duration_s);
  imu_pose_calib::CompareImus(seeds, duration_s);
}
