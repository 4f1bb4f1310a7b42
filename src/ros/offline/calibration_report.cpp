#include "imu_pose_calib/ros/offline/calibration_report.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <boost/algorithm/string/trim.hpp>
#include <cerrno>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <memory>
#include <optional>
#include <sstream>
#include <system_error>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/tables.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kOverview = 6000;     // instants over the whole recording
constexpr size_t kErrorBounds = 400;   // the same, with covariance
constexpr size_t kGrowth = 4000;       // the same, for the growth of the information
constexpr double kGridStep = 0.005;    // [s]
constexpr double kLongestGrid = 60.0;  // [s]
constexpr double kZoom = 1.0;          // [s]
constexpr double kZoomStep = 0.002;    // [s] of what is predicted
constexpr size_t kZoomCount = 501;     // of them in a zoom
constexpr double kAverage = 0.002;     // [s] around an instant, for what is averaged about it
constexpr double kDerivative = 0.001;  // [s] the same, for derivatives by the time shift
constexpr double kEdge = 0.1;          // [s] so close to gaps, the trajectory is not believed

// In the order of Quantity.
constexpr const char* kNames[] = {"position", "rotation", "gyro", "accel"};

/// An instant in each of `count` equal parts of a span [s], `place` (0..1) within it, and others
/// around each.
std::vector<double> Instants(double begin, double end, size_t count, double place,
                             const std::vector<double>& around = {0.0}) {
  std::vector<double> instants;
  for (size_t k = 0; k < count; ++k)
    for (const double away : around)
      instants.push_back(
          begin + (static_cast<double>(k) + place) / static_cast<double>(count) * (end - begin) +
          away);
  return instants;
}

template <int size>
Eigen::Matrix<double, size, 1> Nothing() {
  return Eigen::Matrix<double, size, 1>::Constant(std::numeric_limits<double>::quiet_NaN());
}

/// Times [s], and rows of what need not be that exact.
struct Series {
  NumpyTable<double> t{1};
  NumpyTable<float> rows;

  explicit Series(size_t columns) : rows(columns) {}
  template <typename... Parts>
  void Add(double time, const Parts&... parts) {
    t.AddRow(time);
    rows.AddRow(parts...);
  }
  void Write(const std::string& file) const {
    t.Write(file + "_t.npy");
    rows.Write(file + ".npy");
  }
};

/// The series of one session that was solved; names of files begin with `prefix`.
class SolvedSession {
 public:
  SolvedSession(const CalibrationRun& run, size_t session, std::string prefix)
      : s_(session),
        solution_(*run.result.solution),
        estimate_(solution_.estimate.sessions[session]),
        has_covariance_(solution_.marginals.inverse.valid()),
        trajectory_(run.result.solution, session),
        prefix_(std::move(prefix)) {}

  /// [s] of a pose.
  double PoseTime(int64_t t_ns) const { return Seconds(t_ns - trajectory_.epoch_ns()); }
  /// Of a sample of the gyroscope, or of the accelerometer, whose samples are late.
  double ImuTime(int64_t t_ns, size_t imu, bool is_accel) const {
    const double delay = is_accel ? solution_.estimate.imus[imu].accel_delay : 0.0;
    return estimate_.imus[imu].PoseTime(Seconds(t_ns - solution_.imus[s_][imu].epoch_ns) - delay);
  }

  /// Residuals of the sensors of the session, and what is said of them.
  YAML::Node WriteResiduals() const {
    YAML::Node sensors(YAML::NodeType::Sequence);
    for (size_t k = 0; k < solution_.residuals.size(); ++k) {
      const SensorResiduals& found = solution_.residuals[k];
      if (found.session != s_) continue;
      const std::string quantity = kNames[static_cast<size_t>(found.quantity)];
      const bool is_of_poses = found.quantity <= Quantity::kRotation;
      const std::string file =
          prefix_ + (is_of_poses ? "" : "_i" + std::to_string(found.imu)) + "_" + quantity;
      Series series(4);
      for (size_t i = 0; i < found.t.size(); ++i)
        series.Add(found.t[i], found.residual[i], found.weight[i]);
      series.Write(file + "_residual");
      YAML::Node node;
      node["quantity"] = quantity;
      node["imu"] = found.imu;
      node["noise"] = YamlNumber(found.noise);
      node["noise_found"] = YamlNumber(solution_.statistics[k].noise);
      node["rms"] = YamlNumber(solution_.statistics[k].rms);
      node["rate_hz"] = YamlNumber(solution_.models[k].rate_hz);
      sensors.push_back(node);
    }
    return sensors;
  }

  /// Motion from `begin` to `end` [s], and the sigmas of the trajectory of the marker: position in
  /// W [m], rotation about the marker's axes [rad].
  void WriteMotion(double begin, double end) const {
    WriteStates("motion", Instants(begin, end, kOverview, 0.5));
    NumpyTable<double> sigmas(7);
    for (const double t : Instants(begin, end, has_covariance_ ? kErrorBounds : 0, 0.5)) {
      Vector6d variance = Nothing<6>();
      if (const auto covariance = trajectory_.MarkerCovariance(t))
        variance << covariance->diagonal().segment<3>(3), covariance->diagonal().head<3>();
      sigmas.AddRow(t, Vector6d(variance.cwiseSqrt()));
    }
    sigmas.Write(prefix_ + "_error_bounds.npy");
  }

  /// The motion where it says what the samples of an IMU should be, and its biases.
  void WriteImu(size_t imu) const {
    const std::string name = "i" + std::to_string(imu) + "_";
    const auto [begin, end] = Covered(imu);
    const double zoom = FindLiveliest(begin, end);
    const std::vector<double> average = {-kAverage, 0.0, kAverage};
    WriteStates(name + "predicted", Instants(begin, end, kOverview, 0.0, average));
    WriteStates(name + "zoom",
                Instants(zoom, zoom + kZoomCount * kZoomStep, kZoomCount, 0.0, average));
    WriteStates(name + "growth", Instants(begin, end, kGrowth, 0.5,
                                          {-kEdge, -kDerivative, 0.0, kDerivative, kEdge}));
    WriteGrid(name + "grid", begin, end);
    WriteBiases(name + "gyro_bias", imu, estimate_.imus[imu].gyro_bias, 0);
    WriteBiases(name + "accel_bias", imu, estimate_.imus[imu].accel_bias, 3);
  }

  /// Residuals of a pose sensor and their weights; by how much V has moved where the sensor is
  /// since its piece began [m, rad], in V, and whether one begins.
  void WriteSensor(size_t place, const PoseSensorCalibration& sensor) const {
    const PoseSensorSession& own = sensor.sessions[s_];
    const std::string file = prefix_ + "_p" + std::to_string(place);
    const double epoch = Seconds(trajectory_.epoch_ns());
    Series series(8);
    for (const PoseSensorSession::Residual& r : own.residuals)
      series.Add(r.t - epoch, r.position, r.rotation, r.position_weight, r.rotation_weight);
    series.Write(file + "_residual");
    NumpyTable<double> world(8);
    Rigid3 begin;
    for (const PoseSensorSession::WorldKnot& knot : own.world) {
      if (knot.begins_piece) begin = knot.T_VW;
      Eigen::Vector3d moved = Eigen::Vector3d::Zero();
      if (const auto marker = trajectory_.Marker(knot.t - epoch)) {
        const Eigen::Vector3d p_WS = marker->p_WB + marker->q_WB * sensor.T_MS.p;
        moved = knot.T_VW.p - begin.p + own.scale * (knot.T_VW.q * p_WS - begin.q * p_WS);
      } else if (!knot.begins_piece) {
        moved = Nothing<3>();
      }
      world.AddRow(knot.t - epoch, moved,
                   Log(Eigen::Quaterniond(knot.T_VW.q * begin.q.conjugate())),
                   knot.begins_piece ? 1.0 : 0.0);
    }
    world.Write(file + "_world.npy");
  }

 private:
  /// Rows of t, p_WM, q_WM (x, y, z, w), omega_M, alpha_M, a_W; in gaps without numbers.
  void WriteStates(const std::string& name, const std::vector<double>& instants) const {
    NumpyTable<double> table(17);
    for (const double t : instants) {
      if (const auto state = trajectory_.Marker(t))
        table.AddRow(t, state->p_WB, state->q_WB.coeffs(), state->omega_B, state->alpha_B,
                     state->a_W);
      else
        table.AddRow(t, Nothing<16>());
    }
    table.Write(prefix_ + "_" + name + ".npy");
  }

  /// What the gyroscope's samples cover [s].
  std::pair<double, double> Covered(size_t imu) const {
    for (const SensorResiduals& sensor : solution_.residuals)
      if (sensor.session == s_ && sensor.imu == imu && sensor.quantity == Quantity::kGyro &&
          !sensor.t.empty())
        return {sensor.t.front(), sensor.t.back()};
    return {0.0, 0.0};
  }

  /// Where the second begins in which the marker turns most.
  double FindLiveliest(double begin, double end) const {
    constexpr double kLook = 0.05;  // [s]
    double liveliest = begin, most = -1.0;
    for (double t = begin; t + kZoom < end; t += 0.5 * kZoom) {
      std::vector<double> rates;
      for (double u = t; u < t + kZoom; u += kLook)
        if (const auto state = trajectory_.Marker(u)) rates.push_back(state->omega_B.norm());
      if (rates.empty()) continue;
      const double usual = Median(std::move(rates));  // not that of a shock
      if (usual > most) liveliest = t;
      most = std::max(most, usual);
    }
    return liveliest;
  }

  /// Evenly over the longest run without a gap, for at most kLongestGrid, and how fast the poses
  /// alone turn there [rad/s].
  void WriteGrid(const std::string& name, double begin, double end) const {
    constexpr double kLook = 0.02;  // [s]
    double from = begin, to = begin, run = begin;
    for (double t = begin; t <= end && to - from < kLongestGrid; t += kLook) {
      if (!trajectory_.Marker(t)) run = t + kLook;
      if (t - run > to - from) {
        from = run;
        to = t;
      }
    }
    std::vector<double> instants;
    NumpyTable<double> rates(1);
    MarkerState<double> poses;
    for (double t = from; t < to && solution_.trajectories[s_]->Evaluate(t, &poses);
         t += kGridStep) {
      instants.push_back(t);
      rates.AddRow(poses.omega_M.norm());
    }
    WriteStates(name, instants);
    rates.Write(prefix_ + "_" + name + "_rates.npy");
  }

  /// Values at the knots, and their sigmas, which begin at `first` of the covariance.
  void WriteBiases(const std::string& name, size_t imu, const BiasKnots& knots,
                   Eigen::Index first) const {
    NumpyTable<double> table(7);
    for (size_t k = 0; k < knots.t.size(); ++k) {
      const double t = estimate_.imus[imu].PoseTime(knots.t[k]);
      Eigen::Vector3d sigma = Nothing<3>();
      if (has_covariance_)
        sigma = trajectory_.BiasCovariance(imu, t)->diagonal().segment<3>(first).cwiseSqrt();
      table.AddRow(t, knots.values[k], sigma);
    }
    table.Write(prefix_ + "_" + name + ".npy");
  }

  const size_t s_;
  const Solution& solution_;
  const SessionEstimate& estimate_;
  const bool has_covariance_;
  const SessionTrajectory trajectory_;
  const std::string prefix_;
};

/// What was recorded, in the order of arrival and in SI units. `solved`: nothing before a solve;
/// times are after the first sample of the stream then.
void WriteRecorded(const CalibrationOptions& options, const SessionData& session,
                   const std::optional<SolvedSession>& solved, const std::string& prefix) {
  Series poses(7);
  for (const PoseSample& sample : session.poses) {
    const PoseSample pose = ToMarkerPose(options, sample);
    poses.Add(
        solved ? solved->PoseTime(pose.t_ns) : Seconds(pose.t_ns - session.poses.front().t_ns),
        pose.p_WM, pose.q_WM.coeffs());
  }
  poses.Write(prefix + "_poses");
  for (size_t i = 0; i < session.imus.size(); ++i)
    for (const bool is_accel : {false, true}) {
      if (session.imus[i].IsEmpty()) continue;
      const auto& samples = is_accel ? session.imus[i].accel : session.imus[i].gyro;
      const double unit = is_accel ? options.accel_unit : options.gyro_unit;
      Series series(3);
      for (const ImuSample& sample : samples)
        series.Add(solved ? solved->ImuTime(sample.t_ns, i, is_accel)
                          : Seconds(sample.t_ns - samples.front().t_ns),
                   unit * sample.value);
      series.Write(prefix + "_i" + std::to_string(i) + (is_accel ? "_accel" : "_gyro"));
    }
}

YAML::Node ToYaml(const CheckedStream& stream) {
  YAML::Node node;
  node["role"] = stream.role;
  node["imu"] = stream.imu;
  node["topic"] = stream.topic;
  node["count"] = stream.check.count;
  node["used"] = stream.report.used;
  node["rate_hz"] = YamlNumber(stream.check.rate_hz);
  node["jitter_s"] = YamlNumber(stream.check.jitter_s);
  node["longest_gap_s"] = YamlNumber(stream.check.longest_gap_s);
  node["missing"] = YamlNumber(stream.check.missing);
  node["repeated"] = YamlNumber(stream.check.repeated);
  node["recovered"] = stream.report.stamps_recovered;
  node["dropped"] = Dropped(stream.report);
  if (stream.latency)
    node["latency"] = YamlList(Eigen::Vector2d(stream.latency->median_s, stream.latency->spread_s));
  return node;
}

/// The check of a session that was solved: its streams as recorded, and what the solve used.
DataCheck CheckSolved(const CalibrationOptions& options, const SessionData& recorded,
                      const SessionCalibration& solved) {
  SessionData session = recorded;
  const SessionStamps stamps = RecoverStamps(options.recover_stamps, &session);
  DataCheck check;
  CheckStreams(recorded, session, stamps, &check);
  check.poses.report = solved.poses;
  for (size_t i = 0; i < solved.imus.size(); ++i) {
    check.imus[i].gyro.report = solved.imus[i].gyro;
    check.imus[i].accel.report = solved.imus[i].accel;
  }
  return check;
}

YAML::Node WriteSession(const CalibrationRun& run, size_t s, const std::string& prefix) {
  const SessionData& recorded = run.sessions[s];
  const RecordingInfo info = WithPrintableNames(run.infos[s]);
  std::optional<SolvedSession> solved;
  if (run.result.solution) solved.emplace(run, s, prefix);
  WriteRecorded(run.options, recorded, solved, prefix);
  const DataCheck check = solved ? CheckSolved(run.options, recorded, run.result.sessions[s])
                                 : CheckData(run.options, recorded);
  YAML::Node node;
  node["source"] = info.Source();
  for (const CheckedStream& stream : CheckedStreams(check, info))
    if (stream.role == "poses" || !recorded.imus[stream.imu].IsEmpty())
      node["streams"].push_back(ToYaml(stream));
  node["imus"] = YAML::Node(YAML::NodeType::Sequence);
  for (size_t i = 0; i < recorded.imus.size(); ++i)
    if (!recorded.imus[i].IsEmpty()) node["imus"].push_back(i);
  for (const std::string& warning : check.warnings) node["warnings"].push_back(warning);
  if (!solved) return node;
  const SessionCalibration& session = run.result.sessions[s];
  node["gaps"] = session.gaps;
  node["jumps"] = session.jumps;
  node["knot_spacing_s"] = YamlNumber(session.knot_spacing_s);
  node["gravity"] = YamlList(session.g_W);
  node["sensors"] = solved->WriteResiduals();
  solved->WriteMotion(solved->PoseTime(recorded.poses.front().t_ns),
                      solved->PoseTime(recorded.poses.back().t_ns));
  for (size_t i = 0; i < recorded.imus.size(); ++i)
    if (session.imus[i].is_present) solved->WriteImu(i);
  for (size_t k = 0; k < run.result.pose_sensors.size(); ++k) {
    const PoseSensorCalibration& sensor = run.result.pose_sensors[k];
    if (sensor.sessions[s].is_present) solved->WriteSensor(k, sensor);
  }
  return node;
}

// --- The page ---

std::string ReadAll(const std::string& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

/// Runs `program` with two arguments, without input and output and with stderr in the file
/// `errors`; whether it succeeded.
bool Run(std::string program, std::string first, std::string second, const std::string& errors) {
  char* const words[] = {program.data(), first.data(), second.data(), nullptr};
  posix_spawn_file_actions_t files;
  posix_spawn_file_actions_init(&files);
  posix_spawn_file_actions_addopen(&files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_addopen(&files, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
  posix_spawn_file_actions_addopen(&files, STDERR_FILENO, errors.c_str(),
                                   O_WRONLY | O_CREAT | O_TRUNC, 0600);
  posix_spawnattr_t attributes;
  posix_spawnattr_init(&attributes);
  sigset_t none;
  sigemptyset(&none);
  posix_spawnattr_setsigmask(&attributes, &none);  // not what InterruptGuard blocks here
  posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK);
  pid_t pid = 0;
  const int reason = posix_spawn(&pid, words[0], &files, &attributes, words, environ);
  posix_spawnattr_destroy(&attributes);
  posix_spawn_file_actions_destroy(&files);
  if (reason != 0)
    Reject("'", program, "' cannot be run: ", std::generic_category().message(reason));
  int status = 0;
  while (waitpid(pid, &status, 0) < 0 && errno == EINTR) continue;
  return WIFEXITED(status) && WEXITSTATUS(status) == EXIT_SUCCESS;
}

}  // namespace

YAML::Node YamlList(const Eigen::VectorXd& values) {
  YAML::Node list(YAML::NodeType::Sequence);
  for (Eigen::Index k = 0; k < values.size(); ++k) list.push_back(YamlNumber(values[k]));
  return list;
}

void WriteReportData(const CalibrationRun& run, const std::string& folder) {
  const Calibration& result = run.result;
  const bool is_refused = !run.refusal.empty();
  std::string command = ReadAll("/proc/self/cmdline");  // words end with 0
  std::replace(command.begin(), command.end(), '\0', ' ');
  YAML::Node report;
  report["version"] = kVersion;
  report["command"] = Printable(boost::trim_right_copy(command));
  report["folder"] = Printable(std::filesystem::current_path());
  report["run_id"] = run.run_id;
  report["status"] = is_refused ? "refused" : ToString(result.status);
  report["message"] = Printable(is_refused ? run.refusal : result.message);
  report["solved"] = result.solution != nullptr;
  report["options"] = YAML::Load(ToYaml(run.options));
  for (size_t s = 0; s < run.sessions.size(); ++s)
    report["sessions"].push_back(WriteSession(run, s, folder + "/s" + std::to_string(s)));
  WriteFile(folder + "/report.yaml", YAML::Dump(report));
  if (result.solution)
    WriteFile(folder + "/result.yaml", ToYaml(result, run.infos, run.options, {run.run_id}));
}

std::string DrawReport(const CalibrationRun& run, const std::string& path) {
  const std::string failure = "report '" + path + "' cannot be drawn";
  const TemporaryFolder folder;
  WriteReportData(run, folder.path());
  const std::filesystem::path script =
      std::filesystem::read_symlink("/proc/self/exe").parent_path() / "report.py";
  if (!std::filesystem::exists(script)) Reject(failure, ": there is no ", script.string());
  const std::string drawn =
      (folder.path() / "drawn").string() + std::filesystem::path(path).extension().string();
  const std::string errors = folder.path() / "errors.txt";
  if (Run(script, folder.path(), drawn, errors)) return ReadAll(drawn);
  const std::string reasons = boost::trim_copy(ReadAll(errors));
  Reject(failure, ": ", reasons.substr(reasons.rfind('\n') + 1));
}

}  // namespace imu_pose_calib
