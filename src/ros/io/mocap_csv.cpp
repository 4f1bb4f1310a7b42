#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <cmath>
#include <cstring>
#include <ctime>
#include <map>
#include <set>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/io/text_table.h"

namespace imu_pose_calib {
namespace {

using Cells = std::vector<std::string>;

constexpr double kMaxTime = 1e-9 * kMaxStampNs;  // [s]
/// First lines of an export of Vicon.
const Cells kViconParts{"Segments", "Objects",       "Trajectories",
                        "Devices",  "Model Outputs", "Joints"};

/// The cells of a line, without blanks and quotes around them.
Cells Split(const std::string& line) {
  Cells cells;
  boost::split(cells, line, boost::is_any_of(","));
  for (std::string& cell : cells) boost::trim_if(cell, boost::is_any_of(" \t\r\""));
  return cells;
}

/// Empty where the line is too short.
std::string Cell(const Cells& cells, size_t column) {
  return column < cells.size() ? cells[column] : "";
}

/// The lines of a table.
class CellLines : public TextLines {
 public:
  using TextLines::TextLines;

  /// The cells of the next line. False at the end.
  bool Next(Cells* cells) {
    std::string line;
    if (!TextLines::Next(&line)) return false;
    *cells = Split(line);
    return true;
  }

  [[noreturn]] void FailCell(size_t column, const std::string& text,
                             const std::string& expected) const {
    TextLines::FailCell(std::to_string(column + 1), text, expected);
  }

  double Number(const Cells& cells, size_t column) const {
    const std::string text = Cell(cells, column);
    const std::optional<double> value = ParseNumber(text);
    if (!value || !std::isfinite(*value)) FailCell(column, text, "a number");
    return *value;
  }
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
  std::vector<size_t> values;  ///< of its rotation, x y z or x y z w, and its position
  std::string order;           ///< of Euler angles, "XYZ"; empty: helical
  double rotation_unit = 1.0;  ///< [rad]
  double position_unit = 1.0;  ///< [m]
  size_t time = 0;
  double rate_hz = 1.0;  ///< of what is counted there: frames, or seconds
};

Eigen::Quaterniond Rotation(const BodyColumns& columns, const std::vector<double>& v) {
  if (v.size() == 7) return {v[3], v[0], v[1], v[2]};
  const Eigen::Vector3d angles = columns.rotation_unit * Eigen::Vector3d(v[0], v[1], v[2]);
  if (columns.order.empty()) return Exp(angles);
  Eigen::Quaterniond q = Eigen::Quaterniond::Identity();
  for (const char name : columns.order) {
    const int axis = name - 'X';
    q = q * Eigen::AngleAxisd(angles[axis], Eigen::Vector3d::Unit(axis));
  }
  return q;
}

/// Adds the pose in a line, unless the body was not seen there.
void AddPose(const BodyColumns& columns, const Cells& cells, const CellLines& lines,
             std::vector<PoseSample>* poses) {
  const double t_s = lines.Number(cells, columns.time) / columns.rate_hz;
  if (!(std::abs(t_s) < kMaxTime))
    lines.FailCell(columns.time, cells[columns.time],
                   columns.time == 0 ? "a frame" : "a time in seconds");
  const auto is_empty = [&](size_t column) { return Cell(cells, column).empty(); };
  if (std::all_of(columns.values.begin(), columns.values.end(), is_empty)) return;
  std::vector<double> v;
  for (const size_t column : columns.values) v.push_back(lines.Number(cells, column));
  const Eigen::Vector3d position = columns.position_unit * Eigen::Vector3d::Map(&v[v.size() - 3]);
  poses->push_back({std::llround(1e9 * t_s), Rotation(columns, v), position, {}});
}

/// The body that is wanted of those that there are.
std::string ChooseBody(const std::set<std::string>& names, const std::string& wanted,
                       const CellLines& lines) {
  const std::string list = boost::join(names, ", ");
  if (names.empty()) lines.Fail("holds no rigid body");
  if (wanted.empty() && names.size() > 1)
    lines.Fail("holds several bodies: " + list + "; choose with body");
  if (!wanted.empty() && names.count(wanted) == 0)
    lines.Fail("has no body '" + wanted + "'; it has: " + list);
  return wanted.empty() ? *names.begin() : wanted;
}

// --- Motive ---

/// Seconds since 1970 of "2024-05-31 01.02.03.456 PM", as if it were UTC.
double ParseStart(const std::string& text, const CellLines& lines) {
  const bool is_pm = boost::ends_with(text, " PM");
  const bool is_half = is_pm || boost::ends_with(text, " AM");
  std::tm time{};
  const char* rest = strptime(text.c_str(), is_half ? "%Y-%m-%d %I.%M." : "%Y-%m-%d %H.%M.", &time);
  const size_t size = rest == nullptr ? 0 : std::strlen(rest) - (is_half ? 3 : 0);
  const std::optional<double> seconds = ParseNumber(std::string(rest ? rest : "", size));
  if (!(seconds && *seconds >= 0.0 && *seconds < 61.0) || time.tm_year < 70 || time.tm_year >= 200)
    lines.Fail("Capture Start Time is " + Quote(text) +
               ", must be like '2024-05-31 01.02.03.456 PM'");
  if (is_pm) time.tm_hour += 12;
  return static_cast<double>(timegm(&time)) + *seconds;
}

/// The rows above the row of axes, which begins with Frame: what a column belongs to.
using MotiveHeader = std::map<std::string, Cells>;

/// The columns of a body.
BodyColumns MotiveColumns(MotiveHeader& header, const Cells& axes, const std::string& body,
                          const std::string& rotation_type, const CellLines& lines) {
  const bool is_quaternion = rotation_type == "Quaternion";
  BodyColumns columns;
  if (!is_quaternion) {
    std::string sorted = rotation_type;
    std::sort(sorted.begin(), sorted.end());
    if (sorted != "XYZ")
      lines.Fail("Rotation Type is " + Quote(rotation_type) +
                 ", must be Quaternion or an order of Euler angles as XYZ");
    columns.order = rotation_type;
    columns.rotation_unit = M_PI / 180.0;
  }
  const auto find = [&](const std::string& kind, const std::string& names) {
    const size_t wanted = columns.values.size() + names.size();
    for (const char axis : names)
      for (size_t k = 2; k < axes.size(); ++k)
        if (Cell(header["Type"], k) == "Rigid Body" && Cell(header["Name"], k) == body &&
            Cell(header["Rotation"], k) == kind && axes[k] == std::string(1, axis))
          columns.values.push_back(k);
    if (columns.values.size() != wanted)
      lines.FailHere("does not name the columns " + names + " of the " + kind + " of '" + body +
                     "'");
  };
  find("Rotation", is_quaternion ? "XYZW" : "XYZ");
  find("Position", "XYZ");
  return columns;
}

MocapPoses ReadMotive(CellLines lines, const std::string& body) {
  Cells cells;
  lines.Next(&cells);
  std::map<std::string, std::string> settings;
  for (size_t k = 0; k + 1 < cells.size(); k += 2) settings[cells[k]] = cells[k + 1];
  const double metres = Metres(settings["Length Units"]);
  if (metres == 0.0)
    lines.FailHere("has the Length Units " + Quote(settings["Length Units"]) +
                   ", must be Meters, Centimeters or Millimeters");
  const std::string &space = settings["Coordinate Space"], &start = settings["Capture Start Time"];
  if (!space.empty() && space != "Global")
    lines.FailHere("has the Coordinate Space " + Quote(space) + ", must be Global");
  const double start_s = start.empty() ? 0.0 : ParseStart(start, lines);

  MotiveHeader header;  // by the first cell that is not empty
  for (;;) {
    if (!lines.Next(&cells)) lines.Fail("has no row that begins with Frame");
    if (cells[0] == "Frame") break;
    const auto cell = std::find_if(cells.begin(), cells.end(),
                                   [](const std::string& text) { return !text.empty(); });
    if (cell != cells.end()) header[*cell == "Position" ? "Rotation" : *cell] = cells;
  }
  for (const char* row : {"Type", "Name", "Rotation"})
    if (header.count(row) == 0)
      lines.Fail("has no row of " + std::string(row) + " above the row that begins with Frame");
  std::set<std::string> names;
  for (size_t k = 2; k < cells.size(); ++k)
    if (Cell(header["Type"], k) == "Rigid Body") names.insert(Cell(header["Name"], k));
  MocapPoses mocap;
  mocap.body = ChooseBody(names, body, lines);
  BodyColumns columns = MotiveColumns(header, cells, mocap.body, settings["Rotation Type"], lines);
  columns.position_unit = metres;
  columns.time = 1;
  while (lines.Next(&cells))
    if (!IsBlank(cells)) AddPose(columns, cells, lines, &mocap.poses);
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

BodyColumns ViconColumns(const Cells& axes, const Cells& units, size_t begin,
                         const CellLines& lines) {
  const auto find = [&](const std::string& axis) {
    size_t k = begin;
    while (k < begin + 7 && Cell(axes, k) != axis) ++k;
    return k;
  };
  const auto need = [&](const std::string& axis) {
    const size_t k = find(axis);
    if (k == begin + 7)
      lines.FailHere("names no column " + axis + " from column " + std::to_string(begin + 1) +
                     " on, where the body begins");
    return k;
  };
  BodyColumns columns;
  columns.values = {need("RX"), need("RY"), need("RZ"), need("TX"), need("TY"), need("TZ")};
  const size_t rx = columns.values[0], tx = columns.values[3], w = find("RW");
  const std::string length = Cell(units, tx), angle = Cell(units, rx);
  columns.position_unit = Metres(length);
  if (columns.position_unit == 0.0) lines.FailCell(tx, length, "mm, cm or m");
  if (w < tx) {
    columns.values.insert(columns.values.begin() + 3, w);
    return columns;
  }
  if (angle != "deg" && angle != "rad") lines.FailCell(rx, angle, "deg or rad");
  if (angle == "deg") columns.rotation_unit = M_PI / 180.0;
  return columns;
}

MocapPoses ReadVicon(CellLines lines, const std::string& body) {
  Cells cells, names, axes, units;
  do {
    if (!lines.Next(&cells)) lines.Fail("has no part Segments or Objects, which hold poses");
  } while (cells[0] != "Segments" && cells[0] != "Objects");
  const auto next = [&](Cells* row, const char* what) {
    if (!lines.Next(row)) lines.Fail(std::string("ends before ") + what);
  };
  next(&cells, "the rate");
  const double rate_hz = lines.Number(cells, 0);
  if (!(rate_hz >= 1e-3 && rate_hz <= 1e6)) lines.FailCell(0, cells[0], "a rate [Hz]");
  next(&names, "the names of the bodies");
  next(&axes, "the names of the columns");
  if (axes[0] != "Frame") lines.FailCell(0, axes[0], "Frame");
  next(&units, "the units");

  std::set<std::string> bodies;
  for (std::string& name : names) {
    name = ViconName(name);
    if (!name.empty()) bodies.insert(name);
  }
  MocapPoses mocap;
  mocap.body = ChooseBody(bodies, ViconName(body), lines);
  const auto begin = std::find(names.begin(), names.end(), mocap.body) - names.begin();
  BodyColumns columns = ViconColumns(axes, units, static_cast<size_t>(begin), lines);
  columns.rate_hz = rate_hz;
  while (lines.Next(&cells) && !IsBlank(cells)) {  // another part may follow
    if (const std::string sub = Cell(cells, 1); sub != "0" && !sub.empty())
      lines.FailCell(1, sub, "0: poses have no sub frames");
    AddPose(columns, cells, lines, &mocap.poses);
  }
  return mocap;
}

}  // namespace

std::optional<MocapPoses> ReadMocapCsv(std::istream& in, const std::string& name,
                                       const std::string& body) {
  std::string line;
  TextLines(in, name).Next(&line);
  in.clear();
  in.seekg(0);
  const Cells first = Split(line);
  const bool is_vicon = std::count(kViconParts.begin(), kViconParts.end(), first[0]) > 0 &&
                        IsBlank({first.begin() + 1, first.end()});
  if (!is_vicon && first[0] != "Format Version") return std::nullopt;
  CellLines lines(in, name);
  MocapPoses mocap = is_vicon ? ReadVicon(lines, body) : ReadMotive(lines, body);
  if (mocap.poses.empty()) lines.Fail("holds no pose of '" + mocap.body + "'");
  return mocap;
}

}  // namespace imu_pose_calib
