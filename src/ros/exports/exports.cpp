#include "imu_pose_calib/ros/exports/exports.h"

#include <Eigen/LU>
#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>
#include <boost/algorithm/string/replace.hpp>
#include <cmath>
#include <filesystem>
#include <map>
#include <sstream>

#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

// --- Templates ---

struct Template {
  const char* name;  ///< ExportFile::ending, with imuN when there is a file for each IMU
  const char* text;
};

/// In the order in which the files are written.
constexpr Template kTemplates[] = {
#include "export_templates.inc"  // what is in exports/, see CMakeLists.txt
};
/// What comments have in common: {head}, of the result and what the file is of, and {axes}, of a
/// model whose accelerometer matrix is triangular.
constexpr Template kParts[] = {
#include "export_parts.inc"
};

constexpr char kEach[] = "{each imu}\n", kEnd[] = "{end}\n";

/// What stands for a name in braces.
using Values = std::map<std::string, std::string>;

/// `text` with its values, without the lines that name one that there is not. Braces of JSON are no
/// names: a quote or nothing follows. The further lines of a value are indented like the first.
std::string Fill(const std::string& text, const Values& values) {
  std::string filled;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    const std::string next_line = "\n" + line.substr(0, line.find_first_not_of(' '));
    bool is_there = true;
    for (size_t begin = 0; (begin = line.find('{', begin)) != std::string::npos;) {
      const size_t end = line.find_first_of("\"}", ++begin);
      if (end == std::string::npos || line[end] == '"') continue;
      const auto value = values.find(line.substr(begin, end - begin));
      is_there = is_there && value != values.end();
      if (!is_there) break;
      const std::string put = boost::replace_all_copy(value->second, "\n", next_line);
      line.replace(begin - 1, end + 2 - begin, put);
      begin += put.size() - 1;
    }
    if (is_there) filled += line + "\n";
  }
  return filled;
}

std::string Escaped(const std::string& text,
                    const std::vector<std::pair<const char*, const char*>>& marks) {
  std::string escaped = Printable(text);
  for (const auto& [mark, escape] : marks) boost::replace_all(escaped, mark, escape);
  return escaped;
}

/// For YAML and JSON.
std::string Quoted(const std::string& text) {
  return "\"" + Escaped(text, {{"\\", "\\\\"}, {"\"", "\\\""}}) + "\"";
}

/// The printable lines of a comment as they stand in YAML, XML or JSON that begins like `body`.
std::string Comment(const std::string& text, const std::string& body) {
  const bool is_xml = body[0] == '<', is_json = boost::starts_with(body, "{\n");
  std::vector<std::string> comment;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    if (is_xml) boost::replace_all(line, "--", "- -");  // "--" must not stand in a comment
    if (is_xml && line.back() == '-') line += " ";
    comment.push_back(is_xml ? line : is_json ? Quoted(line) : "# " + line);
  }
  return boost::join(comment, is_json ? ",\n" : "\n");
}

/// The text of a file. `imus`: values of each IMU in it, the first of which count outside of what
/// is there for each. `comment`: instead of that in the template, if it is not empty.
std::string Render(const Template& file, const Values& head, const std::vector<Values>& imus,
                   std::string comment = "") {
  std::string own_comment, body;
  std::istringstream lines(file.text);
  for (std::string line; std::getline(lines, line);)
    (line[0] == '#' ? own_comment += line.substr(2) : body += line) += "\n";
  if (comment.empty()) comment = own_comment;
  for (const auto& [name, text] : kParts)
    boost::replace_all(comment, "{" + std::string(name) + "}", text);
  Values values = imus.front();
  values.insert(head.begin(), head.end());
  values["comment"] = Comment(Fill(comment, values), body);

  const size_t each = body.find(kEach), end = body.find(kEnd);
  if (each == std::string::npos) return Fill(body, values);
  const size_t begin = each + std::size(kEach) - 1;
  std::string text = Fill(body.substr(0, each), values);
  for (const Values& imu : imus) text += Fill(body.substr(begin, end - begin), imu);
  return text + Fill(body.substr(end + std::size(kEnd) - 1), values);
}

// --- Values ---

void PutIf(bool is_there, const std::string& name, const std::string& text, Values* values) {
  if (is_there) values->emplace(name, text);
}

/// A matrix as {name}: a list, row by row; {name rows}: a list for each row; {name block}: one list
/// with a line for each row; {name words}: no list; {name.0}, ...: each number.
void Put(const std::string& name, const Eigen::MatrixXd& matrix, Values* values) {
  std::vector<std::string> rows, words;
  for (Eigen::Index i = 0; i < matrix.rows(); ++i) {
    std::string& row = rows.emplace_back();
    for (Eigen::Index j = 0; j < matrix.cols(); ++j) {
      row += (j == 0 ? "" : ", ") + YamlNumber(matrix(i, j) + 0.0);  // -0.0 is 0.0 then
      (*values)[name + "." + std::to_string(words.size())] = YamlNumber(matrix(i, j));
      words.push_back(YamlNumber(matrix(i, j)));
    }
  }
  (*values)[name] = "[" + boost::join(rows, ", ") + "]";
  (*values)[name + " rows"] = "- [" + boost::join(rows, "]\n- [") + "]";
  (*values)[name + " block"] = "[" + boost::join(rows, ",\n  ") + "]";
  (*values)[name + " words"] = boost::join(words, " ");
}

/// A transform between two frames: "MI" for T_MI.
void Put(const std::string& frames, const Rigid3& T, Values* values) {
  Put("p_" + frames, T.p, values);
  Put("q_" + frames, T.q.coeffs(), values);
  Put("R_" + frames, T.q.toRotationMatrix(), values);
  Put("T_" + frames, T.Matrix(), values);
}

/// The place `n` of what tf is to publish: x_parent = T_PC x_child.
Values LinkValues(size_t n, const std::string& parent, const std::string& child,
                  const Rigid3& T_PC) {
  const auto xml = [](const std::string& text) {
    return Escaped(text, {{"&", "&amp;"}, {"<", "&lt;"}, {">", "&gt;"}, {"\"", "&quot;"}});
  };
  Values values = {{"n", std::to_string(n)},
                   {"parent", xml(parent)},
                   {"child", xml(child)},
                   {"parent word", xml(ShellWord(parent))},
                   {"child word", xml(ShellWord(child))}};
  Put("PC", T_PC, &values);
  Put("rpy_PC", RollPitchYaw(T_PC.q), &values);
  return values;
}

/// A pose sensor in the first session that it shares with the IMU; null: there is none.
struct Shared {
  const PoseSensorSession* sensor = nullptr;
  const ImuSession* imu = nullptr;

  /// t_imu - t_sensor of one instant, that of the IMU's clock_reference [s].
  double ImuLessSensor() const {
    const double shift = sensor->time_shift - imu->time_shift, drift = sensor->clock_drift;
    return shift + drift / (1.0 + drift) * (imu->clock_reference - sensor->clock_reference - shift);
  }
};
Shared FindShared(const StoredResult& stored, size_t imu, size_t sensor) {
  const std::vector<SessionCalibration>& sessions = stored.result.sessions;
  for (size_t s = 0; s < sessions.size(); ++s) {
    const PoseSensorSession& its = stored.result.pose_sensors[sensor].sessions[s];
    if (its.is_present && sessions[s].imus[imu].is_present) return {&its, &sessions[s].imus[imu]};
  }
  return {};
}

/// Of the head of a comment, printable. `has_all_imus`, `has_all_sensors`: the file holds every one
/// of the rig; `player`: the pose sensor that plays a part in it.
Values HeadValues(const StoredResult& stored, bool has_all_imus, bool has_all_sensors,
                  std::optional<size_t> player) {
  const Calibration& result = stored.result;
  const size_t imus = result.imus.size();
  const std::vector<PoseSensorCalibration>& sensors = result.pose_sensors;
  const auto usable = std::count_if(sensors.begin(), sensors.end(), IsUsable);
  const RecordingInfo& info = stored.infos.front();
  Values values = {{"file", Printable(std::filesystem::path(stored.path).filename().string())},
                   {"version", Printable(stored.version)},
                   {"run_id", stored.run_id.empty() ? "" : ", run_id: " + Printable(stored.run_id)},
                   {"status", ToString(result.status)},
                   {"message", Printable(result.message)},
                   {"marker", Printable(info.marker_frame)}};
  PutIf(has_all_sensors && usable > 0, "all_sensors", std::to_string(usable), &values);
  if (imus > 0) {
    const ImuSession& imu = stored.Clock(0);
    values.insert({{"if imu", ""},
                   {"imu", Printable(info.imus[0].imu_frame)},
                   {"time_shift", YamlNumber(imu.time_shift)},
                   {"time_shift_std", Number(imu.time_shift_std)},
                   {"clock_reference", YamlNumber(imu.clock_reference)},
                   {"accel_delay", Number(result.imus[0].accel_delay)}});
    const size_t sessions = result.sessions.size();
    PutIf(imu.clock_drift != 0.0, "clock_drift", Number(imu.clock_drift), &values);
    PutIf(sessions > 1, "sessions", std::to_string(sessions), &values);
    PutIf(std::abs(imu.time_shift) > 1.0, "if far", "", &values);
    PutIf(imus > 1, has_all_imus ? "all_imus" : "one_of_imus", std::to_string(imus), &values);
  }
  if (player) {
    values.insert({{"sensor", Printable(info.pose_sensors[*player].frame)},
                   {"sensor_status", ToString(sensors[*player].status)},
                   {"sensor_message", Printable(sensors[*player].message)}});
    PutIf(sensors.size() > 1, "one_of_sensors",
          std::to_string(*player) + " of " + std::to_string(sensors.size()), &values);
    if (const PoseSensorSession* clock = FindShared(stored, 0, *player).sensor) {
      values.insert({{"sensor_shift", YamlNumber(clock->time_shift)},
                     {"sensor_shift_std", Number(clock->time_shift_std)},
                     {"sensor_reference", YamlNumber(clock->clock_reference)}});
      PutIf(clock->clock_drift != 0.0, "sensor_drift", Number(clock->clock_drift), &values);
    }
  }
  return values;
}

/// The pose sensor that plays a camera or lidar: the one that is asked for, else the first that is
/// usable; none: the marker plays it.
std::optional<size_t> FindPlayer(const StoredResult& stored, std::optional<size_t> asked) {
  const std::vector<PoseSensorCalibration>& sensors = stored.result.pose_sensors;
  const auto first = std::find_if(sensors.begin(), sensors.end(), IsUsable);
  if (!asked && first == sensors.end()) return std::nullopt;
  if (!asked) return static_cast<size_t>(first - sensors.begin());
  const std::string name = "pose sensor " + std::to_string(*asked);
  if (*asked >= sensors.size())
    Reject(name, " is not in the result, which has ", sensors.size(), ", from 0");
  if (!IsUsable(sensors[*asked]))
    Reject(name, " is ", ToString(sensors[*asked].status),
           ", must be ok or weak: ", sensors[*asked].message);
  return asked;
}

/// A matrix as L Q, lower triangle with a positive diagonal times rotation.
struct LowerTimesRotation {
  Eigen::Matrix3d L, Q;
};
LowerTimesRotation SplitLower(const Eigen::Matrix3d& M) {
  // Gram-Schmidt suffices: M is close to a rotation. Eigen's QR takes seconds to compile.
  LowerTimesRotation split{Eigen::Matrix3d::Zero(), M};
  auto& [L, Q] = split;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < i; ++j) {
      L(i, j) = Q.row(i).dot(Q.row(j));
      Q.row(i) -= L(i, j) * Q.row(j);
    }
    L(i, i) = Q.row(i).norm();
    Q.row(i) /= L(i, i);
  }
  return split;
}

/// The shortest turn to x_W from x_G, whose z is up. Eigen's FromTwoVectors() takes seconds to
/// compile.
Eigen::Quaterniond FromUpright(const Eigen::Vector3d& g_W) {
  const Eigen::Vector3d up_W = -g_W.normalized();
  const double twice_cos = std::sqrt(2.0 * (1.0 + up_W.z()));  // of half the angle
  if (twice_cos < 1e-6) return {0.0, 1.0, 0.0, 0.0};
  return {0.5 * twice_cos, -up_W.y() / twice_cos, up_W.x() / twice_cos, 0.0};
}

/// The IMU as models see it whose accelerometer matrix is triangular: in axes A along the
/// accelerometer's, with the origin of I.
struct AccelAxes {
  Rigid3 T_MA;
  LowerTimesRotation accel;  ///< measured = L Q f_I + bias = L f_A + bias
  LowerTimesRotation gyro;   ///< measured = L Q omega_A + bias
  double angle_deg;          ///< by which A is turned from I
};
AccelAxes ToAccelAxes(const ImuCalibration& imu) {
  const LowerTimesRotation accel = SplitLower(imu.accel_matrix);
  const Eigen::Quaterniond q_IA(Eigen::Matrix3d(accel.Q.transpose()));
  return {{(imu.T_MI.q * q_IA).normalized(), imu.T_MI.p},
          accel,
          SplitLower(imu.gyro_matrix * accel.Q.transpose()),
          q_IA.angularDistance(Eigen::Quaterniond::Identity()) * 180.0 / M_PI};
}

/// Of the programs that know scale and misalignment.
void PutModels(const StoredResult& stored, size_t imu, Values* values) {
  const ImuCalibration& calibration = stored.result.imus[imu];
  const ImuSession& session = stored.Clock(imu);
  const auto& [T_MA, accel, gyro, angle_deg] = ToAccelAxes(calibration);
  const bool is_scaled = stored.result.imu_model == ImuModel::kScaleMisalignment;
  const bool is_turned = angle_deg != 0.0;
  PutIf(is_turned, "if turned", "", values);
  PutIf(is_turned, "turned_deg", Number(angle_deg), values);
  PutIf(is_scaled, "if scaled", "", values);
  values->insert({{"but_axes", is_turned ? " but for the axes below" : ""},
                  {"kalibr_model", is_scaled ? "scale-misalignment" : "calibrated"}});
  Put("AM", T_MA.Inverse(), values);
  Put("AA0", T_MA.Inverse() * ToAccelAxes(stored.result.imus[0]).T_MA, values);
  Put("L_accel", accel.L, values);
  Put("Q_accel", accel.Q, values);
  Put("L_gyro_A", gyro.L, values);
  Put("Q_gyro_A", gyro.Q, values);
  const LowerTimesRotation gyro_I = SplitLower(calibration.gyro_matrix);
  Put("L_gyro_I", gyro_I.L, values);
  Put("Q_gyro_I", gyro_I.Q, values);

  // basalt: calibrated = (1 + S) measured - b, so 1 + S = M^-1
  const Eigen::Matrix3d M_a = accel.L.inverse(), S_a = M_a - Eigen::Matrix3d::Identity();
  const Eigen::Matrix3d M_g = (gyro.L * gyro.Q).inverse();
  const Eigen::Matrix3d S_g = M_g - Eigen::Matrix3d::Identity();
  Eigen::Matrix<double, 9, 1> accel_bias;
  accel_bias << M_a * session.accel_bias, S_a.col(0), S_a(1, 1), S_a(2, 1), S_a(2, 2);
  Eigen::Matrix<double, 12, 1> gyro_bias;
  gyro_bias << M_g * session.gyro_bias, S_g.col(0), S_g.col(1), S_g.col(2);
  Put("basalt_accel_bias", accel_bias, values);
  Put("basalt_gyro_bias", gyro_bias, values);
}

/// White noise of a sensor, and the walk of its bias.
void PutNoise(const std::string& sensor, const std::string& name, double sigma, double rate_hz,
              double walk, Values* values) {
  if (!(sigma > 0.0 && rate_hz > 0.0))
    Reject("the result has no noise and rate of the ", name,
           ", which must be positive: ", YamlNumber(sigma), " at ", YamlNumber(rate_hz), " Hz");
  const double sample_walk = walk * std::sqrt(rate_hz);
  values->insert({{sensor + "_std", YamlNumber(sigma)},
                  {sensor + "_variance", YamlNumber(sigma * sigma)},
                  {sensor + "_density", YamlNumber(sigma / std::sqrt(rate_hz))},
                  {sensor + "_walk", YamlNumber(walk)},
                  {sensor + "_sample_walk", YamlNumber(sample_walk)},
                  {sensor + "_sample_walk_variance", YamlNumber(sample_walk * sample_walk)}});
}

/// t_imu0 - t_imuN of one instant, in a session that has both. 0 when there is none.
double OffsetToFirst(const StoredResult& stored, size_t imu) {
  for (const SessionCalibration& session : stored.result.sessions)
    if (session.imus[0].is_present && session.imus[imu].is_present)
      return session.imus[imu].time_shift - session.imus[0].time_shift;
  return 0.0;
}

/// Of px4: body axes B with the origin of the imu.
void PutBody(const Eigen::Quaterniond& q_BI, const Rigid3& T_IM, double time_shift,
             Values* values) {
  const double delay_ms = 1e3 * time_shift;
  const bool fits = delay_ms >= 0.0 && delay_ms <= 300.0;
  const bool is_imu = q_BI.isApprox(Eigen::Quaterniond::Identity());
  Put("BM", Rigid3{q_BI * T_IM.q, q_BI * T_IM.p}, values);
  Put("q_BI", q_BI.coeffs(), values);
  (*values)["axes_are_taken"] = is_imu ? ": the imu's axes are taken for the body's;" : "";
  PutIf(fits, "delay_ms", YamlNumber(delay_ms), values);
  PutIf(!fits, "unfit_delay_ms", Number(delay_ms), values);
}

/// Of the pose sensor S that plays a camera or lidar; without one the marker does.
void PutPlayer(const StoredResult& stored, size_t imu, std::optional<size_t> player,
               Values* values) {
  const Rigid3& T_MI = stored.result.imus[imu].T_MI;
  const Rigid3 T_MA = ToAccelAxes(stored.result.imus[imu]).T_MA;
  const Rigid3 T_SM = player ? stored.result.pose_sensors[*player].T_MS.Inverse() : Rigid3();
  const Rigid3 T_SI = player ? T_SM * T_MI : T_MI;
  const RecordingInfo& info = stored.infos.front();
  const Shared shared = player ? FindShared(stored, imu, *player) : Shared();
  const double shift = shared.sensor ? shared.ImuLessSensor() : -stored.Clock(imu).time_shift;
  Put("SI", T_SI, values);
  Put("IS", T_SI.Inverse(), values);
  Put("SA", player ? T_SM * T_MA : T_MA, values);
  const std::string text = YamlNumber(shift);
  PutIf(!player || shared.sensor != nullptr, "player_shift", text, values);
  values->insert(
      {{"player", player ? "sensor" : "marker"},
       {"player_topic", Quoted(player ? info.pose_sensors[*player].topic : info.pose_topic)},
       {"player_shift_has_no_key",
        player ? "the clocks: subtract " + text + " s from the stamps of the imu beforehand."
               : "time_shift: add it to the stamps of the imu beforehand."},
       {"player_shift_is", player ? "time_shift of the sensor - that of the imu" : "-time_shift"},
       {"why_left_out", player ? "They are not known" : "It is no camera"}});
}

/// All that `file` may name of an IMU. Frames: marker M, imu I, first imu I0, accelerometer's axes
/// A.
Values ImuValues(const StoredResult& stored, size_t imu, const Template& file,
                 const ExportChoice& choice) {
  const SessionCalibration& session = stored.result.sessions[0];
  const ImuSession& clock = stored.Clock(imu);
  const Rigid3& T_MI = stored.result.imus[imu].T_MI;
  if (!(std::abs(clock.time_shift) < 9e9))
    Reject("time_shift = ", YamlNumber(-clock.time_shift), " s does not fit nanoseconds");
  Values values =
      LinkValues(imu, stored.infos.front().marker_frame, stored.Info(imu).imu_frame, T_MI);
  values.insert({{"gyro_topic", Quoted(stored.Info(imu).GyroSource())},
                 {"rate", YamlNumber(clock.gyro.rate_hz)},
                 {"whole_rate", std::to_string(std::lround(clock.gyro.rate_hz))},
                 {"-time_shift", YamlNumber(-clock.time_shift)},
                 {"-time_shift_ns", std::to_string(std::llround(-1e9L * clock.time_shift))},
                 {"time_offset", YamlNumber(OffsetToFirst(stored, imu))},
                 {"gravity", YamlNumber(session.g_W.norm())},
                 {"position_std", YamlNumber(session.noise.position)},
                 {"rotation_std", YamlNumber(session.noise.rotation)}});
  Put("MI", T_MI, &values);
  Put("IM", T_MI.Inverse(), &values);
  Put("I0I", imu == 0 ? Rigid3() : stored.result.imus[0].T_MI.Inverse() * T_MI, &values);
  Put("q_WG", FromUpright(session.g_W).coeffs(), &values);
  PutBody(choice.q_body_imu, T_MI.Inverse(), clock.time_shift, &values);
  PutPlayer(stored, imu, choice.pose_sensor, &values);
  PutModels(stored, imu, &values);
  if (boost::contains(file.text, "{accel_")) {  // else a result without noise will do
    PutNoise("gyro", "gyroscope", clock.noise.gyro, clock.gyro.rate_hz,
             stored.options.gyro_bias_walk, &values);
    PutNoise("accel", "accelerometer", clock.noise.accel, clock.accel.rate_hz,
             stored.options.accel_bias_walk, &values);
  }
  return values;
}

/// Whether a file is of the frames on the body, of sensors of any kind.
bool IsOfFrames(const Template& file) { return boost::contains(file.text, "{child"); }

/// Whether a pose sensor plays a part in a file.
bool HasPlayer(const Template& file) {
  const auto names = {"{player", "_SI", "_IS", "_SA"};
  return std::any_of(names.begin(), names.end(),
                     [&](const char* name) { return boost::contains(file.text, name); });
}

std::string EndingOf(const Template& file, size_t imu) {
  return boost::replace_all_copy<std::string>(file.name, "imuN", "imu" + std::to_string(imu));
}

bool IsOf(const std::string& program, const Template& file) {
  return boost::starts_with(std::string(file.name) + ".", program + ".");
}

bool NeedsImu(const std::string& program) {
  return std::any_of(std::begin(kTemplates), std::end(kTemplates), [&](const Template& file) {
    return IsOf(program, file) && !IsOfFrames(file);
  });
}

/// The path of a result without its ending.
std::filesystem::path Stem(std::filesystem::path result) {
  if (result.extension() == ".yaml" || result.extension() == ".yml") result.replace_extension();
  return result;
}

/// The cameras of a chain of Kalibr, or of OpenVINS, by their names: x_imu = T x_cam.
std::vector<std::pair<std::string, Rigid3>> ParseCameraChain(const std::string& yaml) {
  const YAML::Node root = ParseYaml(yaml);
  std::vector<std::pair<std::string, Rigid3>> cameras;
  if (!root.IsMap()) Reject("must be a map");
  for (const auto& entry : root) {
    const std::string name = entry.first.IsScalar() ? entry.first.Scalar() : "";
    const YAML::Node camera = entry.second;
    if (!boost::starts_with(name, "cam") || !camera.IsMap()) continue;
    if (camera["T_cam_imu"])
      cameras.emplace_back(name, ReadMatrix(name + ": T_cam_imu", camera["T_cam_imu"]).Inverse());
    else if (camera["T_imu_cam"])
      cameras.emplace_back(name, ReadMatrix(name + ": T_imu_cam", camera["T_imu_cam"]));
    else
      Reject(name,
             " has no T_cam_imu; give the camchain-imucam.yaml of the calibration with the imu");
  }
  if (cameras.empty()) Reject("holds no cam0");
  return cameras;
}

}  // namespace

std::vector<std::string> ExportNames() {
  std::vector<std::string> names;
  for (const Template& file : kTemplates)
    if (names.empty() || !IsOf(names.back(), file))
      names.emplace_back(file.name, std::strcspn(file.name, "."));
  return names;
}

std::vector<std::string> ParseExports(const std::string& list) {
  std::vector<std::string> known = ExportNames();
  std::istringstream words(boost::replace_all_copy(list, ",", " "));
  std::vector<std::string> names;
  for (std::string word; words >> word;) {
    if (word == "all") return known;
    if (std::find(known.begin(), known.end(), word) == known.end())
      Reject("export '", word, "' is unknown; must be among ", boost::join(known, ", "),
             ", or all");
    if (std::find(names.begin(), names.end(), word) == names.end()) names.push_back(word);
  }
  return names;
}

std::vector<ExportFile> Export(const StoredResult& stored, const std::string& name,
                               const ExportChoice& given) {
  if (stored.result.imus.empty() && NeedsImu(name))
    Reject("export '", name, "' needs an IMU, and the result has none");
  const ExportChoice choice = {given.q_body_imu, FindPlayer(stored, given.pose_sensor)};
  std::vector<ExportFile> files;
  for (const Template& file : kTemplates) {
    if (!IsOf(name, file)) continue;
    const bool is_of_one = boost::contains(file.name, "imuN");
    const bool has_all = is_of_one || boost::contains(file.text, kEach);
    const Values head = HeadValues(stored, has_all, IsOfFrames(file),
                                   HasPlayer(file) ? choice.pose_sensor : std::nullopt);
    std::vector<Values> imus;  // or frames
    for (size_t i = 0; !IsOfFrames(file) && i < (has_all ? stored.result.imus.size() : 1); ++i)
      imus.push_back(ImuValues(stored, i, file, choice));
    if (IsOfFrames(file))
      for (const auto& [frame, T_MF] : BodyFrames(stored.result, stored.infos.front()))
        imus.push_back(LinkValues(imus.size(), stored.infos.front().marker_frame, frame, T_MF));
    if (!is_of_one) files.push_back({file.name, Render(file, head, imus)});
    for (size_t i = 0; is_of_one && i < imus.size(); ++i)
      files.push_back({EndingOf(file, i), Render(file, head, {imus[i]})});
  }
  return files;
}

std::vector<ExportFile> ExportChain(const StoredResult& stored, size_t imu,
                                    const std::string& path) {
  constexpr char kComment[] = R"(marker -> imu -> cameras, {head}
cameras: x_cam = T_cam_imu x_imu of {source}; published is its inverse)";
  if (imu >= stored.result.imus.size())
    Reject("--imu ", imu, ": '", stored.path, "' has ", stored.result.imus.size(), " imus, from 0");
  Values head = HeadValues(stored, true, false, std::nullopt);
  head["source"] = Printable(path);
  const std::string& frame = stored.Info(imu).imu_frame;
  std::vector<Values> links = {
      LinkValues(0, stored.infos.front().marker_frame, frame, stored.result.imus[imu].T_MI)};
  for (const auto& [name, T_imu_cam] : LoadYaml("camera chain", path, ParseCameraChain))
    links.push_back(LinkValues(links.size(), frame, name, T_imu_cam));
  std::vector<ExportFile> files;
  for (const Template& file : kTemplates)
    if (IsOf("urdf", file) || IsOf("tf", file))
      files.push_back({file.name, Render(file, head, links, kComment)});
  return files;
}

std::vector<std::string> ExportPaths(const std::string& result,
                                     const std::vector<std::string>& names, size_t imus) {
  std::vector<std::string> paths;
  for (const std::string& name : names)
    for (const Template& file : kTemplates) {
      if (!IsOf(name, file) || (imus == 0 && NeedsImu(name))) continue;
      const size_t files = boost::contains(file.name, "imuN") ? imus : 1;
      for (size_t i = 0; i < files; ++i)
        paths.push_back(Stem(result).string() + "." + EndingOf(file, i));
    }
  return paths;
}

std::vector<std::string> WriteExports(const StoredResult& stored,
                                      const std::vector<std::string>& names, OutputFiles* outputs,
                                      const std::string& folder, const ExportChoice& choice) {
  std::filesystem::path stem = Stem(stored.path);
  if (!folder.empty()) {
    stem = folder / stem.filename();
    outputs->MakeFolder(folder);
  }
  const bool is_all = names == ExportNames();
  std::vector<std::string> paths;
  for (const std::string& name : names) {
    if (is_all && stored.result.imus.empty() && NeedsImu(name)) continue;
    for (const ExportFile& file : Export(stored, name, choice)) {
      paths.push_back(stem.string() + "." + file.ending);
      outputs->Write(paths.back(), file.text);
    }
  }
  return paths;
}

std::string ExportNote(const StoredResult& stored, const std::vector<std::string>& names) {
  if (stored.result.imus.empty()) return "";
  const double angle_deg = ToAccelAxes(stored.result.imus[0]).angle_deg;
  std::vector<std::string> turned;
  std::copy_if(names.begin(), names.end(), std::back_inserter(turned), [](const std::string& name) {
    return std::any_of(std::begin(kTemplates), std::end(kTemplates), [&](const Template& file) {
      return IsOf(name, file) && boost::contains(file.text, "{axes}");
    });
  });
  if (turned.empty() || angle_deg == 0.0) return "";
  return "the imu axes of " + boost::join(turned, ", ") + " are those of the accelerometer, by " +
         Number(angle_deg) + " deg off those of T_marker_imu: the files say so, too";
}

}  // namespace imu_pose_calib
