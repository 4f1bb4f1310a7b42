#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <boost/range/adaptor/map.hpp>
#include <cmath>
#include <cstring>
#include <ctime>
#include <map>

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

bool IsEmpty(const std::string& cell) { return cell.empty(); }

bool IsBlank(const Cells& cells) { return std::all_of(cells.begin(), cells.end(), IsEmpty); }

/// The lines of a table, with the cells of the current one.
struct Rows : TextLines {
  using TextLines::TextLines;

  Cells cells;

  /// False at the end.
  bool Next() {
    std::string line;
    if (!TextLines::Next(&line)) return false;
    cells = Split(line);
    return true;
  }
  [[noreturn]] void FailCell(size_t column, const std::string& expected) const {
    TextLines::FailCell(std::to_string(column + 1), Cell(cells, column), expected);
  }
  double Number(size_t column) const {
    const std::optional<double> value = ParseNumber(Cell(cells, column));
    if (!value || !std::isfinite(*value)) FailCell(column, "a number");
    return *value;
  }
};

/// Metres in a unit of length; 0: unknown.
double Metres(std::string unit) {
  boost::to_lower(unit);
  if (unit == "mm" || unit == "millimeters") return 1e-3;
  if (unit == "cm" || unit == "centimeters") return 1e-2;
  return unit == "m" || unit == "meters" ? 1.0 : 0.0;
}

/// Where the values of a body are, and what they mean.
struct BodyColumns {
  std::string body;
  std::vector<size_t> values;  ///< of its rotation, x y z or x y z w, and its position
  std::string order;           ///< of Euler angles, "XYZ"; empty: helical
  double rotation_unit = 1.0;  ///< [rad]
  double position_unit = 1.0;  ///< [m]
  size_t time = 0;
  double rate_hz = 1.0;  ///< of what is counted there: frames, or seconds
  int64_t start_ns = 0;  ///< from which they count
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
void AddPose(const BodyColumns& columns, const Rows& rows, std::vector<PoseSample>* poses) {
  const double t_s = rows.Number(columns.time) / columns.rate_hz;
  if (!(std::abs(t_s) < kMaxTime))
    rows.FailCell(columns.time, columns.time == 0 ? "a frame" : "a time in seconds");
  const auto is_empty = [&](size_t column) { return Cell(rows.cells, column).empty(); };
  if (std::all_of(columns.values.begin(), columns.values.end(), is_empty)) return;
  std::vector<double> v;
  for (const size_t column : columns.values) v.push_back(rows.Number(column));
  const Eigen::Vector3d position = columns.position_unit * Eigen::Vector3d::Map(&v[v.size() - 3]);
  // A sum in seconds would not be exact.
  const int64_t t_ns = columns.start_ns + std::llround(1e9 * t_s);
  poses->push_back({t_ns, Rotation(columns, v), position, {}});
}

/// The columns of each body by what they hold: RX, RY, RZ, RW of its rotation, TX, TY, TZ of its
/// position.
using Bodies = std::map<std::string, std::map<std::string, size_t>>;

/// The body that is wanted of those that there are.
std::string ChooseBody(const Bodies& bodies, const std::string& wanted, const Rows& rows) {
  const std::string list = boost::join(bodies | boost::adaptors::map_keys, ", ");
  if (bodies.empty()) rows.Fail("holds no rigid body");
  if (wanted.empty() && bodies.size() > 1)
    rows.Fail("holds several bodies: " + list + "; choose with body");
  if (!wanted.empty() && bodies.count(wanted) == 0)
    rows.Fail("has no body '" + wanted + "'; it has: " + list);
  return wanted.empty() ? bodies.begin()->first : wanted;
}

/// The columns of a body's rotation and position.
std::vector<size_t> FindValues(const Bodies& bodies, const std::string& body, bool is_quaternion,
                               const Rows& rows) {
  std::vector<size_t> values;
  for (const std::string name : {"RX", "RY", "RZ", "RW", "TX", "TY", "TZ"}) {
    if (name == "RW" && !is_quaternion) continue;
    const auto column = bodies.at(body).find(name);
    if (column == bodies.at(body).end())
      rows.FailHere("names no column " + name + " of '" + body + "', which must have " +
                    (is_quaternion ? "XYZW" : "XYZ") + " of the Rotation and XYZ of the Position");
    values.push_back(column->second);
  }
  return values;
}

// --- Motive ---

/// Nanoseconds since 1970 of "2024-05-31 01.02.03.456 PM", as if it were UTC.
int64_t ParseStart(const std::string& text, const Rows& rows) {
  const bool is_pm = boost::ends_with(text, " PM");
  const bool is_half = is_pm || boost::ends_with(text, " AM");
  std::tm time{};
  const char* rest = strptime(text.c_str(), is_half ? "%Y-%m-%d %I.%M." : "%Y-%m-%d %H.%M.", &time);
  const size_t size = rest == nullptr ? 0 : std::strlen(rest) - (is_half ? 3 : 0);
  const std::optional<double> seconds = ParseNumber(std::string(rest ? rest : "", size));
  if (!(seconds && *seconds >= 0.0 && *seconds < 61.0) || time.tm_year < 70 || time.tm_year >= 200)
    rows.Fail("Capture Start Time is " + Quote(text) +
              ", must be like '2024-05-31 01.02.03.456 PM'");
  if (is_pm) time.tm_hour += 12;
  return (timegm(&time) * 1000 + std::llround(1e3 * *seconds)) * 1'000'000;
}

/// Reads the rows that say what a column belongs to; the last, of axes, begins with Frame.
Bodies MotiveBodies(Rows* rows) {
  std::map<std::string, Cells> header;  // by the first cell that is not empty
  for (;;) {
    if (!rows->Next()) rows->Fail("has no row that begins with Frame");
    if (rows->cells[0] == "Frame") break;
    const auto cell = std::find_if_not(rows->cells.begin(), rows->cells.end(), IsEmpty);
    if (cell != rows->cells.end()) header[*cell == "Position" ? "Rotation" : *cell] = rows->cells;
  }
  for (const char* row : {"Type", "Name", "Rotation"})
    if (header.count(row) == 0)
      rows->Fail("has no row of " + std::string(row) + " above the row that begins with Frame");
  Bodies bodies;
  for (size_t k = 2; k < rows->cells.size(); ++k) {
    const std::string kind = Cell(header["Rotation"], k), name = Cell(header["Name"], k);
    const bool is_value = kind == "Rotation" || kind == "Position";
    if (Cell(header["Type"], k) != "Rigid Body" || !is_value) continue;
    const std::string& axis = rows->cells[k];
    if (!bodies[name].emplace((kind == "Rotation" ? "R" : "T") + axis, k).second)
      rows->FailHere("names the " + kind + " " + axis + " of '" + name + "' twice");
  }
  return bodies;
}

BodyColumns ReadMotiveHeader(const std::string& body, Rows* rows) {
  rows->Next();
  std::map<std::string, std::string> settings;
  for (size_t k = 0; k + 1 < rows->cells.size(); k += 2)
    settings[rows->cells[k]] = rows->cells[k + 1];
  const std::string &length = settings["Length Units"], &space = settings["Coordinate Space"],
                    &start = settings["Capture Start Time"], &rotation = settings["Rotation Type"];
  BodyColumns columns;
  columns.time = 1;
  columns.position_unit = Metres(length);
  if (columns.position_unit == 0.0)
    rows->FailHere("has the Length Units " + Quote(length) +
                   ", must be Meters, Centimeters or Millimeters");
  if (!space.empty() && space != "Global")
    rows->FailHere("has the Coordinate Space " + Quote(space) + ", must be Global");
  if (!start.empty()) columns.start_ns = ParseStart(start, *rows);
  if (rotation != "Quaternion") {
    const std::string axes = "XYZ";
    if (!std::is_permutation(axes.begin(), axes.end(), rotation.begin(), rotation.end()))
      rows->Fail("Rotation Type is " + Quote(rotation) +
                 ", must be Quaternion or an order of Euler angles as XYZ");
    columns.order = rotation;
    columns.rotation_unit = M_PI / 180.0;
  }
  const Bodies bodies = MotiveBodies(rows);
  columns.body = ChooseBody(bodies, body, *rows);
  columns.values = FindValues(bodies, columns.body, columns.order.empty(), *rows);
  return columns;
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

BodyColumns ReadViconHeader(const std::string& body, Rows* rows) {
  do {
    if (!rows->Next()) rows->Fail("has no part Segments or Objects, which hold poses");
  } while (rows->cells[0] != "Segments" && rows->cells[0] != "Objects");
  const auto next = [rows](const char* what) {
    if (!rows->Next()) rows->Fail(std::string("ends before ") + what);
    return rows->cells;
  };
  BodyColumns columns;
  next("the rate");
  columns.rate_hz = rows->Number(0);
  if (!(columns.rate_hz >= 1e-3 && columns.rate_hz <= 1e6)) rows->FailCell(0, "a rate [Hz]");
  const Cells names = next("the names of the bodies"), axes = next("the names of the columns");
  if (axes[0] != "Frame") rows->FailCell(0, "Frame");
  const Cells units = next("the units");

  Bodies bodies;
  std::string name;  // stands above the first column of a body
  for (size_t k = 0; k < axes.size(); ++k) {
    if (!Cell(names, k).empty()) name = ViconName(names[k]);
    if (!name.empty()) bodies[name].emplace(axes[k], k);
  }
  columns.body = ChooseBody(bodies, ViconName(body), *rows);
  std::map<std::string, size_t>& places = bodies[columns.body];
  const bool is_quaternion = places.count("RW") > 0;
  columns.values = FindValues(bodies, columns.body, is_quaternion, *rows);
  columns.position_unit = Metres(Cell(units, places["TX"]));
  if (columns.position_unit == 0.0) rows->FailCell(places["TX"], "mm, cm or m");
  const std::string angle = Cell(units, places["RX"]);
  if (!is_quaternion && angle != "deg" && angle != "rad")
    rows->FailCell(places["RX"], "deg or rad");
  if (angle == "deg") columns.rotation_unit = M_PI / 180.0;
  return columns;
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
  Rows rows(in, name);
  const BodyColumns columns =
      is_vicon ? ReadViconHeader(body, &rows) : ReadMotiveHeader(body, &rows);
  MocapPoses mocap{{}, columns.body};
  while (rows.Next()) {
    if (is_vicon && IsBlank(rows.cells)) break;  // another part may follow
    if (IsBlank(rows.cells)) continue;
    const std::string sub = is_vicon ? Cell(rows.cells, 1) : "";
    if (sub != "0" && !sub.empty()) rows.FailCell(1, "0: poses have no sub frames");
    AddPose(columns, rows, &mocap.poses);
  }
  if (mocap.poses.empty()) rows.Fail("holds no pose of '" + mocap.body + "'");
  return mocap;
}

}  // namespace imu_pose_calib
