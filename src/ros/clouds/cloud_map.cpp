#include "imu_pose_calib/ros/clouds/cloud_map.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <memory>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr int64_t kStepNs = 1'000'000;  // between the poses of a cloud
constexpr double kFarthest = 1e6;       // [m] in W

/// Places at which sharpness is judged, and points that are to be around each.
constexpr size_t kPlaces = 5000, kLeastPoints = 10;
constexpr double kLeastVariance = 1e-12;  // [m^2] of points in a plane

/// The poses T_WM as they were recorded, by their stamps.
std::map<int64_t, Rigid3> Recorded(const CalibrationOptions& options,
                                   const std::vector<PoseSample>& samples) {
  std::map<int64_t, Rigid3> poses;
  for (const PoseSample& sample : samples) {
    const PoseSample pose = ToMarkerPose(options, sample);
    if (pose.p_WM.allFinite() && pose.q_WM.coeffs().allFinite() && pose.q_WM.norm() > 0.0 &&
        pose.t_ns > 0)
      poses[pose.t_ns] = {pose.q_WM.normalized(), pose.p_WM};
  }
  return poses;
}

/// Linear between the poses before and after.
std::optional<Rigid3> Between(const std::map<int64_t, Rigid3>& poses, int64_t t_ns) {
  const auto after = poses.upper_bound(t_ns);
  if (after == poses.begin() || after == poses.end()) return std::nullopt;
  const auto& [begin_ns, before] = *std::prev(after);
  const double u =
      static_cast<double>(t_ns - begin_ns) / static_cast<double>(after->first - begin_ns);
  return Interpolate(before, after->second, u);
}

/// What one takes for the time shift [ns] without a calibration: 0 where the stamps could be of one
/// clock, else what lets samples of both arrive together.
int64_t ShiftByArrival(const RecordingInfo& info, const SessionData& data) {
  std::vector<int64_t> poses = Stamps(data.poses), gyro = Stamps(data.imus[0].gyro);
  const auto [pose_begin, pose_end] = std::minmax_element(poses.begin(), poses.end());
  const auto [imu_begin, imu_end] = std::minmax_element(gyro.begin(), gyro.end());
  const int64_t common = std::min(*pose_end, *imu_end) - std::max(*pose_begin, *imu_begin);
  const bool is_one_clock = common > std::min(*pose_end - *pose_begin, *imu_end - *imu_begin) / 2;
  if (is_one_clock || !info.imus[0].gyro_latency || !info.pose_latency) return 0;
  return std::llround(1e9 * (info.imus[0].gyro_latency->median_s - info.pose_latency->median_s));
}

Cube CubeOf(const Eigen::Vector3d& p, double size) {
  const auto place = (p.array() / size).floor().cast<int64_t>().eval();
  return {place.x(), place.y(), place.z()};
}

/// Points of a map, by the cubes that they are in.
using Cubes = std::map<Cube, std::vector<size_t>>;

/// Variances [m^2] of the points around point k along the principal axes; nothing when there are
/// too few. `cubes`: of the size of the radius.
std::optional<Eigen::Array3d> VariancesAround(size_t k, const std::vector<Eigen::Vector3f>& points,
                                              const Cubes& cubes, double radius) {
  const Eigen::Vector3d center = points[k].cast<double>();
  const Cube middle = CubeOf(center, radius);
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  Eigen::Matrix3d squares = Eigen::Matrix3d::Zero();
  size_t count = 0;
  for (int64_t cube = 0; cube < 27; ++cube) {
    const auto found = cubes.find(
        {middle[0] + cube / 9 - 1, middle[1] + cube / 3 % 3 - 1, middle[2] + cube % 3 - 1});
    if (found == cubes.end()) continue;
    for (const size_t j : found->second) {
      const Eigen::Vector3d d = points[j].cast<double>() - center;
      if (d.squaredNorm() > radius * radius) continue;
      sum += d;
      squares += d * d.transpose();
      ++count;
    }
  }
  if (count < kLeastPoints) return std::nullopt;
  const auto n = static_cast<double>(count);
  const Eigen::Matrix3d covariance = (squares - sum * sum.transpose() / n) / (n - 1.0);
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(covariance, Eigen::EigenvaluesOnly);
  return solver.eigenvalues().array().max(kLeastVariance);
}

}  // namespace

Eigen::Quaterniond ToRightAngles(const Eigen::Quaterniond& q) {
  const auto quarters = [](int count, const Eigen::Vector3d& axis) {
    return Eigen::AngleAxisd(0.5 * M_PI * count, axis);
  };
  Eigen::Quaterniond best = Eigen::Quaterniond::Identity();
  for (int k = 0; k < 64; ++k) {  // all 24, some of them several times
    const Eigen::Quaterniond candidate = quarters(k / 16, Eigen::Vector3d::UnitX()) *
                                         quarters(k / 4 % 4, Eigen::Vector3d::UnitY()) *
                                         quarters(k % 4, Eigen::Vector3d::UnitZ());
    if (candidate.angularDistance(q) < best.angularDistance(q)) best = candidate;
  }
  return best;
}

std::vector<SensorPoses> PosesWithAndWithout(const SensorMount& sensor,
                                             const OfflineResult& offline) {
  const auto mounted = [&](const Rigid3& T_MI) {
    return sensor.T_IS ? T_MI * *sensor.T_IS : *sensor.T_MS;
  };
  const Rigid3 T_MI = offline.result.imus[0].T_MI, T_MS = mounted(T_MI);
  const Rigid3 guessed_T_MS =
      mounted(sensor.guessed_T_MI.value_or(Rigid3{ToRightAngles(T_MI.q), Eigen::Vector3d::Zero()}));

  const std::shared_ptr<const Solution> solution = offline.result.solution;
  const auto track = std::make_shared<const SessionTrajectory>(solution, 0);
  const auto recorded = std::make_shared<const std::map<int64_t, Rigid3>>(
      Recorded(offline.options, offline.sessions[0].poses));
  const int64_t epoch_ns = track->epoch_ns(), imu_epoch_ns = solution->imus[0][0].epoch_ns;
  const ImuSessionEstimate clock = solution->estimate.sessions[0].imus[0];
  const bool on_imu_clock = sensor.is_on_imu_clock;
  const int64_t shift_ns = on_imu_clock ? ShiftByArrival(offline.infos[0], offline.sessions[0]) : 0;

  const auto make = [=](const char* name, bool is_solved, const Rigid3& T_MS_used,
                        bool is_clocked) {
    const auto pose = [=](int64_t stamp_ns) -> std::optional<Rigid3> {
      // On the pose clock, after its epoch [s].
      const double t = is_clocked && on_imu_clock ? clock.PoseTime(Seconds(stamp_ns - imu_epoch_ns))
                                                  : Seconds(stamp_ns + shift_ns - epoch_ns);
      const auto body = track->Marker(t);
      if (!body) return std::nullopt;
      const auto T_WM = is_solved ? Rigid3{body->q_WB, body->p_WB}
                                  : Between(*recorded, epoch_ns + std::llround(1e9 * t));
      return T_WM ? std::optional(*T_WM * T_MS_used) : std::nullopt;
    };
    return SensorPoses{name, pose};
  };
  std::vector<SensorPoses> all = {make("without calibration", false, guessed_T_MS, false)};
  if (sensor.T_IS) all.push_back(make("all but T_marker_imu", true, guessed_T_MS, true));
  if (on_imu_clock) all.push_back(make("all but the time shift", true, T_MS, false));
  all.push_back(make("all but the trajectory", false, T_MS, true));
  all.push_back(make("calibrated", true, T_MS, true));
  return all;
}

std::optional<Eigen::Vector3d> CloudMotion::Place(int64_t stamp_ns, const Eigen::Vector3f& p_S) {
  const auto at = [this](int64_t t_ns) -> const std::optional<Rigid3>& {
    const auto [pose, is_new] = poses_.try_emplace(t_ns);
    if (is_new) pose->second = pose_(t_ns);
    return pose->second;
  };
  const int64_t after_ns = stamp_ns % kStepNs, begin_ns = stamp_ns - after_ns;
  const std::optional<Rigid3>&begin = at(begin_ns),
        &end = at(after_ns > 0 ? begin_ns + kStepNs : begin_ns);
  if (!begin || !end) return std::nullopt;
  const Eigen::Vector3d p = p_S.cast<double>();
  const double u = static_cast<double>(after_ns) / static_cast<double>(kStepNs);
  // On the chord instead of the arc: of a turn by an angle a it misses a^2 / 8 of the range.
  return Eigen::Vector3d((1.0 - u) * (begin->q * p + begin->p) + u * (end->q * p + end->p));
}

void VoxelMap::Add(const Eigen::Vector3d& p_W, float intensity) {
  if (!(p_W.array().abs() <= kFarthest).all())
    Reject("a point is more than ", static_cast<int>(kFarthest), " m from the origin of the poses");
  Sum& sum = cubes_.try_emplace(CubeOf(p_W, size_), Sum::Zero()).first->second;
  sum += (Sum() << p_W, static_cast<double>(intensity), 1.0).finished();
  if (cubes_.size() > most_)
    Reject("the map has more than ", most_, " points; give a larger voxel, or a smaller max_range");
}

std::vector<MapPoint> VoxelMap::Points() const {
  std::vector<MapPoint> points(cubes_.size());
  auto point = points.begin();
  for (const auto& [cube, sum] : cubes_)
    Eigen::Vector4f::Map((point++)->data()) = (sum.head<4>() / sum[4]).cast<float>();
  return points;
}

std::vector<Sharpness> CompareSharpness(const std::vector<std::vector<Eigen::Vector3f>>& maps,
                                        double radius) {
  std::vector<size_t> used;
  for (size_t k = 0; k < maps.front().size(); ++k)
    if (std::all_of(maps.begin(), maps.end(), [k](const auto& map) { return map[k].allFinite(); }))
      used.push_back(k);
  const auto to_cubes = [&used](const std::vector<Eigen::Vector3f>& map, double size) {
    Cubes cubes;
    for (const size_t k : used) cubes[CubeOf(map[k].cast<double>(), size)].push_back(k);
    return cubes;
  };
  std::vector<Cubes> cubes;
  for (const auto& map : maps) cubes.push_back(to_cubes(map, radius));
  std::vector<Sharpness> sharpness(maps.size());
  std::vector<std::vector<double>> distances(maps.size());
  const Cubes places = to_cubes(maps.back(), 0.5 * radius);  // one point of each
  const size_t stride = places.size() / kPlaces + 1;
  size_t number = 0;
  for (const auto& [cube, inside] : places) {
    if (number++ % stride != 0) continue;
    std::vector<Eigen::Array3d> variances;
    for (size_t m = 0; m < maps.size(); ++m)
      if (const auto around = VariancesAround(inside.front(), maps[m], cubes[m], radius))
        variances.push_back(*around);
    if (variances.size() < maps.size()) continue;
    for (size_t m = 0; m < maps.size(); ++m) {
      sharpness[m].entropy += 0.5 * (2.0 * M_PI * M_E * variances[m]).log().sum();
      distances[m].push_back(std::sqrt(variances[m].minCoeff()));
    }
  }
  for (size_t m = 0; m < maps.size(); ++m) {
    sharpness[m].places = distances[m].size();
    if (distances[m].empty()) continue;
    sharpness[m].entropy /= static_cast<double>(distances[m].size());
    sharpness[m].thickness = Median(std::move(distances[m]));
  }
  return sharpness;
}

}  // namespace imu_pose_calib
