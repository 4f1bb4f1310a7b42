#include "imu_pose_calib/ros/io/mocap_csv.h"

#include <algorithm>
#include <array>
#include <boost/algorithm/string.hpp>
#include <boost/lexical_cast/try_lexical_convert.hpp>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <map>
#include <optional>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/io/printable.h"

namespace imu_pose_calib {
namespace {

using Cells = std::vector<std::string>;

constexpr double kDegree = 3.14159265358979323846 / 180.0;
constexpr double kMaxTime = 4e9;  // [s]

/// The lines of a table.
class Lines {
 public:
  Lines(std::istream& in, std::string name) : in_(in), name_(std::move(name)) {}

  /// The cells of the next line, without blanks and quotes around them. False at the end.
  bool Next(Cells* cells) {
    std::string line;
    if (!std::getline(in_, line)) return false;
    ++number_;
    if (number_ == 1 && boost::starts_with(line, "\xEF\xBB\xBF")) line.erase(0, 3);
    boost::split(*cells, line, boost::is_any_of(","));
    for (std::string& cell : *cells) boost::trim_if(cell, boost::is_any_of(" \t\r\""));
    return true;
  }

  [[noreturn]] void Fail(const std::string& text) const {
    throw InputError("'" + name_ + "': " + Printable(text));
  }
  [[noreturn]] void FailHere(const std::string& text) const {
    Fail("line " + std::to_string(number_) + " " + text);
  }
  [[noreturn]] void FailCell(size_t column, const std::string& text,
                             const std::string& expected) const {
    FailHere("column " + std::to_string(column + 1) + " is " +
             (text.empty() ? "empty" : "'" + text.substr(0, 60) + "'") + ", must be " + expected);
  }

  double Number(const Cells& cells, size_t column) const {
    const std::string& text = Cell(cells, column);
    double value = 0.0;
    if (!boost::conversion::try_lexical_convert(text, value) || !std::isfinite(value))
      FailCell(column, text, "a number");
    return value;
  }

  /// Empty where the line is too short.
  static const std::string& Cell(const Cells& cells, size_t column) {
    static const std::string kEmpty;
    return column < cells.size() ? cells[column] : kEmpty;
  }

 private:
  std::istream& in_;
  std::string name_;
  size_t number_ = 0;
};

bool IsBlank(const Cells& cells) {
  return std::all_of(cells.begin(), cells.end(),
                     [](const std::string& cell) { return cell.empty(); });
}

/// Metres in a unit of length; 0: unknown.
double Metres(std::string unit) {
  boost::to_lower(unit);
  if (unit == "mm" || unit == "millimeters") return 1e-3;
  if (unit == "cm" || unit == "centimeters") return 1e-2;
  return unit == "m" || unit == "meters" ? 1.0 : 0.0;
}

/// Where the values of a body are, and what they mean.
struct BodyColumns {
  std::vector<size_t> rotation;  ///< x y z, or x y z w
  std::vector<size_t> position;
  std::string order;           ///< of Euler angles, "XYZ"; empty: helical
  double rotation_unit = 1.0;  ///< [rad]
  double position_unit = 1.0;  ///< [m]
};

Eigen::Quaterniond Rotation(const BodyColumns& columns, const Cells& cells, const Lines& lines) {
  std::vector<double> v;
  for (const size_t column : columns.rotation) v.push_back(lines.Number(cells, column));
  if (v.size() == 4) return {v[3], v[0], v[1], v[2]};
  for (double& angle : v) angle *= columns.rotation_unit;
  if (columns.order.empty()) return Exp(Eigen::Vector3d(v[0], v[1], v[2]));
  Eigen::Quaterniond q = Eigen::Quaterniond::Identity();
  for (const char name : columns.order) {
    const int axis = name - 'X';
    q = q * Eigen::AngleAxisd(v[static_cast<size_t>(axis)], Eigen::Vector3d::Unit(axis));
  }
  return q;
}

/// The pose in a line; none where the body was not seen.
std::optional<PoseSample> Pose(const BodyColumns& columns, double t_s, const Cells& cells,
                               const Lines& lines) {
  const auto is_empty = [&](size_t column) { return Lines::Cell(cells, column).empty(); };
  if (std::all_of(columns.rotation.begin(), columns.rotation.end(), is_empty) &&
      std::all_of(columns.position.begin(), columns.position.end(), is_empty))
    return std::nullopt;
  PoseSample pose;
  pose.t_ns = std::llround(1e9 * t_s);
  pose.q_WM = Rotation(columns, cells, lines);
  for (int i = 0; i < 3; ++i)
    pose.p_WM[i] =
        columns.position_unit * lines.Number(cells, columns.position[static_cast<size_t>(i)]);
  return pose;
}

/// The body that is wanted of those that there are.
std::string ChooseBody(std::vector<std::string> names, const std::string& wanted,
                       const Lines& lines) {
  std::sort(names.begin(), names.end());
  names.erase(std::unique(names.begin(), names.end()), names.end());
  const std::string list = boost::join(names, ", ");
  if (names.empty()) lines.Fail("holds no rigid body");
  if (wanted.empty() && names.size() > 1)
    lines.Fail("holds several bodies: " + list + "; choose with body");
  if (!wanted.empty() && std::count(names.begin(), names.end(), wanted) == 0)
    lines.Fail("has no body '" + wanted + "'; it has: " + list);
  return wanted.empty() ? names[0] : wanted;
}

// --- Motive ---

/// Seconds since 1970 of "2024-05-31 01.02.03.456 PM", as if it were UTC.
double ParseStart(const std::string& text, const Lines& lines) {
  std::tm time{};
  double seconds = 0.0;
  char half[3] = "";
  const int count =
      std::sscanf(text.c_str(), "%4d-%2d-%2d %2d.%2d.%lf %2s", &time.tm_year, &time.tm_mon,
                  &time.tm_mday, &time.tm_hour, &time.tm_min, &seconds, half);
  const std::string part = half;
  const bool is_day = time.tm_year >= 1970 && time.tm_year < 2100 && time.tm_mon >= 1 &&
                      time.tm_mon <= 12 && time.tm_mday >= 1 && time.tm_mday <= 31;
  const bool is_time = time.tm_hour >= (count == 7 ? 1 : 0) &&
                       time.tm_hour <= (count == 7 ? 12 : 23) && time.tm_min >= 0 &&
                       time.tm_min < 60 && seconds >= 0.0 && seconds < 61.0;
  if (count < 6 || !is_day || !is_time || (count == 7 && part != "AM" && part != "PM"))
    lines.Fail("Capture Start Time is '" + text.substr(0, 60) +
               "', must be like '2024-05-31 01.02.03.456 PM'");
  if (count == 7) time.tm_hour = time.tm_hour % 12 + (part == "PM" ? 12 : 0);
  time.tm_year -= 1900;
  time.tm_mon -= 1;
  return static_cast<double>(timegm(&time)) + seconds;
}

/// The columns of a body by the rows above "Frame": its names, what it is, and its axes.
BodyColumns MotiveColumns(const std::map<std::string, Cells>& rows, const Cells& axes,
                          const std::string& body, const std::string& rotation_type,
                          const Lines& lines) {
  const bool is_quaternion = rotation_type == "Quaternion";
  BodyColumns columns;
  const std::string wanted = is_quaternion ? "XYZW" : "XYZ";
  if (!is_quaternion) {
    std::string sorted = rotation_type;
    std::sort(sorted.begin(), sorted.end());
    if (sorted != "XYZ")
      lines.Fail("Rotation Type is '" + rotation_type.substr(0, 60) +
                 "', must be Quaternion or an order of Euler angles as XYZ");
    columns.order = rotation_type;
    columns.rotation_unit = kDegree;
  }
  const auto find = [&](const std::string& kind, const std::string& names) {
    std::vector<size_t> found;
    for (const char axis : names) {
      for (size_t k = 2; k < axes.size(); ++k)
        if (Lines::Cell(rows.at("Type"), k) == "Rigid Body" &&
            Lines::Cell(rows.at("Name"), k) == body && Lines::Cell(rows.at("kind"), k) == kind &&
            axes[k] == std::string(1, axis))
          found.push_back(k);
    }
    if (found.size() != names.size())
      lines.FailHere("does not name the columns " + names + " of the " + kind + " of '" + body +
                     "'");
    return found;
  };
  columns.rotation = find("Rotation", wanted);
  columns.position = find("Position", "XYZ");
  return columns;
}

MocapPoses ReadMotive(const Cells& first, Lines* lines, const std::string& body) {
  std::map<std::string, std::string> settings;
  for (size_t k = 0; k + 1 < first.size(); k += 2) settings[first[k]] = first[k + 1];
  const double metres = Metres(settings["Length Units"]);
  if (metres == 0.0)
    lines->FailHere("has the Length Units '" + settings["Length Units"].substr(0, 60) +
                    "', must be Meters, Centimeters or Millimeters");
  const std::string space = settings["Coordinate Space"];
  if (!space.empty() && space != "Global")
    lines->FailHere("has the Coordinate Space '" + space.substr(0, 60) + "', must be Global");
  const std::string& start = settings["Capture Start Time"];
  const double start_s = start.empty() ? 0.0 : ParseStart(start, *lines);

  std::map<std::string, Cells> rows;  // of the header
  Cells cells;
  for (;;) {
    if (!lines->Next(&cells)) lines->Fail("has no row that begins with Frame");
    if (cells[0] == "Frame") break;
    const auto cell = std::find_if(cells.begin(), cells.end(),
                                   [](const std::string& text) { return !text.empty(); });
    if (cell == cells.end()) continue;
    rows[*cell == "Rotation" || *cell == "Position" ? "kind" : *cell] = cells;
  }
  for (const char* row : {"Type", "Name", "kind"})
    if (rows.count(row) == 0)
      lines->Fail("has no row of " + std::string(row == std::string("kind") ? "Rotation" : row) +
                  " above the row that begins with Frame");
  std::vector<std::string> names;
  for (size_t k = 2; k < cells.size(); ++k)
    if (Lines::Cell(rows["Type"], k) == "Rigid Body") names.push_back(Lines::Cell(rows["Name"], k));
  MocapPoses mocap;
  mocap.body = ChooseBody(names, body, *lines);
  BodyColumns columns = MotiveColumns(rows, cells, mocap.body, settings["Rotation Type"], *lines);
  columns.position_unit = metres;
  while (lines->Next(&cells)) {
    if (IsBlank(cells)) continue;
    const double t_s = lines->Number(cells, 1);
    if (!(std::abs(t_s) < kMaxTime)) lines->FailCell(1, cells[1], "a time in seconds");
    if (const auto pose = Pose(columns, t_s, cells, *lines)) mocap.poses.push_back(*pose);
  }
  // Apart, as a sum in seconds would not be exact.
  for (PoseSample& pose : mocap.poses) pose.t_ns += std::llround(1e3 * start_s) * 1'000'000;
  return mocap;
}

// --- Vicon ---

/// The name of a body: "rig" for "rig:rig" and for "Global Angle rig:rig".
std::string ViconName(std::string cell) {
  if (boost::starts_with(cell, "Global Angle ")) cell.erase(0, 13);
  const size_t colon = cell.find(':');
  if (colon != std::string::npos && cell.substr(0, colon) == cell.substr(colon + 1))
    cell.erase(colon);
  return cell;
}

BodyColumns ViconColumns(const Cells& axes, const Cells& units, size_t begin, const Lines& lines) {
  const auto find = [&](const std::string& axis) {
    for (size_t k = begin; k < std::min(axes.size(), begin + 7); ++k)
      if (axes[k] == axis) return k;
    return axes.size();
  };
  const auto need = [&](const std::string& axis) {
    const size_t k = find(axis);
    if (k == axes.size())
      lines.FailHere("names no column " + axis + " from column " + std::to_string(begin + 1) +
                     " on, where the body begins");
    return k;
  };
  BodyColumns columns;
  columns.rotation = {need("RX"), need("RY"), need("RZ")};
  columns.position = {need("TX"), need("TY"), need("TZ")};
  const size_t w = find("RW");
  const std::string& length = Lines::Cell(units, columns.position[0]);
  columns.position_unit = Metres(length);
  if (columns.position_unit == 0.0) lines.FailCell(columns.position[0], length, "mm, cm or m");
  if (w < columns.position[0]) {
    columns.rotation.push_back(w);
    return columns;
  }
  const std::string& angle = Lines::Cell(units, columns.rotation[0]);
  if (angle != "deg" && angle != "rad") lines.FailCell(columns.rotation[0], angle, "deg or rad");
  if (angle == "deg") columns.rotation_unit = kDegree;
  return columns;
}

MocapPoses ReadVicon(const Cells& first, Lines* lines, const std::string& body) {
  Cells cells = first, names, axes, units;
  while (cells[0] != "Segments" && cells[0] != "Objects")
    if (!lines->Next(&cells)) lines->Fail("has no part Segments or Objects, which hold poses");
  const auto next = [&](Cells* row, const char* what) {
    if (!lines->Next(row)) lines->Fail(std::string("ends before ") + what);
  };
  next(&cells, "the rate");
  const double rate_hz = lines->Number(cells, 0);
  if (!(rate_hz >= 1e-3 && rate_hz <= 1e6)) lines->FailCell(0, cells[0], "a rate [Hz]");
  next(&names, "the names of the bodies");
  next(&axes, "the names of the columns");
  if (axes[0] != "Frame") lines->FailCell(0, axes[0], "Frame");
  next(&units, "the units");

  std::vector<std::string> bodies;
  for (const std::string& name : names)
    if (!name.empty()) bodies.push_back(ViconName(name));
  MocapPoses mocap;
  mocap.body = ChooseBody(bodies, ViconName(body), *lines);
  size_t begin = 0;
  while (ViconName(names[begin]) != mocap.body) ++begin;
  const BodyColumns columns = ViconColumns(axes, units, begin, *lines);
  while (lines->Next(&cells) && !IsBlank(cells)) {  // another part may follow
    const double frame = lines->Number(cells, 0);
    if (!(std::abs(frame / rate_hz) < kMaxTime)) lines->FailCell(0, cells[0], "a frame");
    if (const std::string& sub = Lines::Cell(cells, 1); sub != "0" && !sub.empty())
      lines->FailCell(1, sub, "0: poses have no sub frames");
    if (const auto pose = Pose(columns, frame / rate_hz, cells, *lines))
      mocap.poses.push_back(*pose);
  }
  return mocap;
}

bool IsMotive(const Cells& first) { return first[0] == "Format Version"; }

bool IsVicon(const Cells& first) {
  static const std::array<const char*, 6> kParts = {"Segments", "Objects",       "Trajectories",
                                                    "Devices",  "Model Outputs", "Joints"};
  return std::count(kParts.begin(), kParts.end(), first[0]) > 0 &&
         IsBlank({first.begin() + 1, first.end()});
}

}  // namespace

bool IsMocapCsv(std::istream& in) {
  Cells first;
  const bool is_one = Lines(in, "").Next(&first) && (IsMotive(first) || IsVicon(first));
  in.clear();
  in.seekg(0);
  return is_one;
}

MocapPoses ReadMocapCsv(std::istream& in, const std::string& name, const std::string& body) {
  Lines lines(in, name);
  Cells first;
  if (!lines.Next(&first) || !(IsMotive(first) || IsVicon(first)))
    lines.Fail("is no CSV of Motive or Vicon");
  MocapPoses mocap =
      IsMotive(first) ? ReadMotive(first, &lines, body) : ReadVicon(first, &lines, body);
  if (mocap.poses.empty()) lines.Fail("holds no pose of '" + mocap.body + "'");
  return mocap;
}

}  // namespace imu_pose_calib
