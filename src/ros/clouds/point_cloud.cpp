#include "imu_pose_calib/ros/clouds/point_cloud.h"

#include <sensor_msgs/point_cloud2_iterator.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

using sensor_msgs::PointCloud2;
using sensor_msgs::PointField;

/// Names that drivers give to the times of points.
const char* const kTimeNames[] = {"t",           "time",        "timestamp",         "time_stamp",
                                  "offset_time", "time_offset", "point_time_offset", "rel_time"};

struct Unit {
  const char* name;
  double seconds;
};
constexpr Unit kUnits[] = {{"s", 1.0}, {"ms", 1e-3}, {"us", 1e-6}, {"ns", 1e-9}};

/// The times of a cloud fill this part of the time between two; less than 1000 between the bounds,
/// so that only one unit can.
constexpr double kLeastFill = 0.02, kMostFill = 1.5;
constexpr double kUsualPeriod = 0.1;    // [s] of clouds, when there is only one
constexpr double kLongestOffset = 1.0;  // [s] from the stamp of a cloud to that of a point

template <typename T>
double ValueAs(const uint8_t* data) {
  T value;
  std::memcpy(&value, data, sizeof(value));
  return static_cast<double>(value);
}

/// How the values of a field are stored.
struct Type {
  uint8_t number;
  size_t size;  ///< [bytes]
  double (*value)(const uint8_t* data);
};
constexpr Type kTypes[] = {
    {PointField::INT8, 1, ValueAs<int8_t>},   {PointField::UINT8, 1, ValueAs<uint8_t>},
    {PointField::INT16, 2, ValueAs<int16_t>}, {PointField::UINT16, 2, ValueAs<uint16_t>},
    {PointField::INT32, 4, ValueAs<int32_t>}, {PointField::UINT32, 4, ValueAs<uint32_t>},
    {PointField::FLOAT32, 4, ValueAs<float>}, {PointField::FLOAT64, 8, ValueAs<double>}};

std::string Text(double value) { return Format("%.10g", value); }

/// A cloud whose sizes fit each other.
class CheckedCloud {
 public:
  explicit CheckedCloud(const PointCloud2& cloud) : cloud_(cloud) {
    if (cloud.is_bigendian) throw InputError("is_bigendian = 1 must be 0");
    const uint64_t row = uint64_t{cloud.width} * cloud.point_step;
    if (cloud.height > 1 && cloud.row_step < row)
      throw InputError("row_step = " + std::to_string(cloud.row_step) + " must be at least " +
                       std::to_string(row) + ", width times point_step");
    row_step_ = cloud.height > 1 ? cloud.row_step : row;
    const uint64_t size = row_step_ * cloud.height;
    if (cloud.data.size() != size)
      throw InputError("size of data = " + std::to_string(cloud.data.size()) + " must be " +
                       std::to_string(size) + " by width, height and point_step");
    if (cloud.point_step == 0) throw InputError("point_step = 0 must be positive");
  }

  /// Place and type of a field; nothing when there is none of that name.
  struct Field {
    size_t offset;
    const Type* type;

    double Of(const uint8_t* point) const { return type->value(point + offset); }
  };
  std::optional<Field> Find(const std::string& name) const {
    for (const PointField& field : cloud_.fields) {
      if (field.name != name) continue;
      const auto type = std::find_if(std::begin(kTypes), std::end(kTypes),
                                     [&](const Type& t) { return t.number == field.datatype; });
      if (type == std::end(kTypes))
        throw InputError("datatype of field '" + name + "' = " + std::to_string(field.datatype) +
                         " must be 1 to 8");
      if (uint64_t{field.offset} + type->size > cloud_.point_step)
        throw InputError("offset of field '" + name + "' = " + std::to_string(field.offset) +
                         " leaves no " + std::to_string(type->size) +
                         " bytes within point_step = " + std::to_string(cloud_.point_step));
      return Field{field.offset, type};
    }
    return std::nullopt;
  }

  Field Coordinate(const std::string& name) const {
    const auto field = Find(name);
    if (!field || field->type->number < PointField::FLOAT32)  // the last two of them
      throw InputError("field '" + name + "' must be there as float32 or float64; the fields are " +
                       Names());
    return *field;
  }

  std::string Names() const {
    std::string names;
    for (const PointField& field : cloud_.fields) names += (names.empty() ? "" : ", ") + field.name;
    return names;
  }

  /// Calls `use(data)` for each point.
  template <typename Use>
  void ForEach(Use use) const {
    for (uint64_t i = 0; i < cloud_.height && cloud_.width > 0; ++i)
      for (uint64_t j = 0; j < cloud_.width; ++j)
        use(cloud_.data.data() + i * row_step_ + j * cloud_.point_step);
  }

  size_t size() const { return size_t{cloud_.width} * cloud_.height; }

 private:
  const PointCloud2& cloud_;
  uint64_t row_step_;
};

/// Least and largest time of the points, as in the field.
struct TimeRange {
  double least = std::numeric_limits<double>::infinity(), largest = -least;
  bool IsEmpty() const { return least > largest; }
  double Span() const { return IsEmpty() ? 0.0 : largest - least; }
};

TimeRange RangeOf(const PointCloud2& message, const std::string& name) {
  const CheckedCloud cloud(message);
  TimeRange range;
  const auto field = cloud.Find(name);
  if (!field) return range;
  cloud.ForEach([&](const uint8_t* data) {
    const double value = field->Of(data);
    if (!std::isfinite(value)) return;
    range.least = std::min(range.least, value);
    range.largest = std::max(range.largest, value);
  });
  return range;
}

/// Median time from a cloud to the next [s].
double PeriodOf(const std::vector<PointCloud2>& clouds) {
  std::vector<double> periods;
  for (size_t k = 1; k < clouds.size(); ++k) {
    const double period = (clouds[k].header.stamp - clouds[k - 1].header.stamp).toSec();
    if (period > 0.0) periods.push_back(period);
  }
  return periods.empty() ? kUsualPeriod : Median(std::move(periods));
}

bool IsWithin(const TimeRange& range, double unit_s, double of_s) {
  return std::abs(unit_s * range.least - of_s) <= kLongestOffset &&
         std::abs(unit_s * range.largest - of_s) <= kLongestOffset;
}

/// The unit that `choice` names, or by which `span` fills the period.
Unit UnitOf(const std::string& choice, const std::string& field, double span, double period_s) {
  for (const Unit& unit : kUnits) {
    const double fill = unit.seconds * span / period_s;
    if (choice == unit.name || (choice == "auto" && fill > kLeastFill && fill < kMostFill))
      return unit;
  }
  throw InputError("times in field '" + field + "' of the points span " + Text(span) +
                   " within a cloud while clouds follow each other by " + Text(period_s) +
                   " s, which neither s, ms, us nor ns explain; give point_time");
}

void CheckChoice(const std::string& choice) {
  if (choice == "auto" || choice == "none") return;
  for (const Unit& unit : kUnits)
    if (choice == unit.name) return;
  throw InputError("point_time '" + choice + "' is unknown; must be auto, none, s, ms, us or ns");
}

}  // namespace

PointTime FindPointTime(const std::vector<PointCloud2>& clouds, const std::string& choice) {
  CheckChoice(choice);
  if (choice == "none" || clouds.empty()) return {};
  PointTime time;
  const CheckedCloud first(clouds.front());
  for (const char* name : kTimeNames) {
    if (!first.Find(name)) continue;
    time.field = name;
    break;
  }
  if (time.field.empty()) {
    if (choice == "auto") return {};
    throw InputError("point_time = " + choice +
                     ", but no field of the clouds is called t, time or timestamp; they are " +
                     first.Names());
  }
  double span = 0.0;
  for (const PointCloud2& cloud : clouds) span = std::max(span, RangeOf(cloud, time.field).Span());
  if (span == 0.0) return {};
  const Unit unit = UnitOf(choice, time.field, span, PeriodOf(clouds));
  time.unit = unit.name;
  time.unit_s = unit.seconds;
  const auto is_within = [&](bool is_since) {
    return std::all_of(clouds.begin(), clouds.end(), [&](const PointCloud2& cloud) {
      const TimeRange range = RangeOf(cloud, time.field);
      return range.IsEmpty() ||
             IsWithin(range, time.unit_s, is_since ? 0.0 : cloud.header.stamp.toSec());
    });
  };
  time.is_since = is_within(true);
  if (!time.is_since && !is_within(false))
    throw InputError("times in field '" + time.field + "' of the points, from " +
                     Text(time.unit_s * RangeOf(clouds.front(), time.field).least) +
                     " s on, are neither within " + Text(kLongestOffset) +
                     " s of the stamp of their cloud (" +
                     Text(clouds.front().header.stamp.toSec()) +
                     " s) nor after it by that; point_time none leaves them out");
  return time;
}

std::vector<CloudPoint> ReadCloud(const PointCloud2& message, const PointTime& time) {
  const CheckedCloud cloud(message);
  const CheckedCloud::Field xyz[] = {cloud.Coordinate("x"), cloud.Coordinate("y"),
                                     cloud.Coordinate("z")};
  const auto intensity = cloud.Find("intensity");
  const auto own_time =
      time.field.empty() ? std::optional<CheckedCloud::Field>() : cloud.Find(time.field);
  if (!time.field.empty() && !own_time)
    throw InputError("field '" + time.field + "' must be there, as in the first cloud");
  const double epoch_s = time.is_since ? 0.0 : message.header.stamp.toSec();

  std::vector<CloudPoint> points;
  points.reserve(cloud.size());
  cloud.ForEach([&](const uint8_t* data) {
    CloudPoint point;
    for (int i = 0; i < 3; ++i) point.p_S[i] = static_cast<float>(xyz[i].Of(data));
    if (intensity) point.intensity = static_cast<float>(intensity->Of(data));
    if (own_time && point.p_S.allFinite()) {
      const double after_s = time.unit_s * own_time->Of(data) - epoch_s;
      if (!(std::abs(after_s) <= kLongestOffset))
        throw InputError("field '" + time.field + "' puts a point " + Text(after_s) +
                         " s after the stamp of its cloud; must be within " + Text(kLongestOffset) +
                         " s");
      point.time_after_ns = std::llround(1e9 * after_s);
    }
    points.push_back(point);
  });
  return points;
}

bool HasIntensity(const PointCloud2& cloud) {
  return CheckedCloud(cloud).Find("intensity").has_value();
}

std::string ToPcd(const std::vector<MapPoint>& points, bool has_intensity) {
  std::string pcd = "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n";
  pcd += has_intensity ? "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
                       : "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n";
  pcd += Format("WIDTH %zu\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS %zu\nDATA binary\n",
                points.size(), points.size());
  const size_t size = (has_intensity ? 4 : 3) * sizeof(float);
  pcd.reserve(pcd.size() + size * points.size());
  for (const MapPoint& point : points) pcd.append(reinterpret_cast<const char*>(&point), size);
  return pcd;
}

PointCloud2 NewCloud(const std::string& frame, const std::vector<const char*>& names,
                     size_t points) {
  PointCloud2 cloud;
  cloud.header.frame_id = frame;
  cloud.height = 1;
  cloud.is_dense = 1u;
  for (const char* name : names) {
    PointField field;
    field.name = name;
    field.offset = cloud.point_step;
    field.datatype = field.name == "t" ? PointField::UINT32 : PointField::FLOAT32;
    field.count = 1;
    cloud.fields.push_back(field);
    cloud.point_step += 4;
  }
  sensor_msgs::PointCloud2Modifier(cloud).resize(points);
  return cloud;
}

PointCloud2 ToMessage(const std::vector<MapPoint>& points, const std::string& frame) {
  static_assert(sizeof(MapPoint) == 4 * sizeof(float));
  PointCloud2 message = NewCloud(frame, {"x", "y", "z", "intensity"}, points.size());
  if (!points.empty()) std::memcpy(message.data.data(), points.data(), message.data.size());
  return message;
}

}  // namespace imu_pose_calib
