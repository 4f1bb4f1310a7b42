#include "imu_pose_calib/ros/io/point_cloud.h"

#include <sensor_msgs/point_cloud2_iterator.h>
#include <sensor_msgs/point_field_conversion.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/text.h"

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

/// A cloud whose sizes fit each other.
class CheckedCloud {
 public:
  explicit CheckedCloud(const PointCloud2& cloud) : cloud_(cloud) {
    if (cloud.is_bigendian) Reject("is_bigendian = 1 must be 0");
    const uint64_t row = uint64_t{cloud.width} * cloud.point_step;
    if (cloud.height > 1 && cloud.row_step < row)
      Reject(Format("row_step = %u must be at least %lu, width times point_step", cloud.row_step,
                    row));
    row_step_ = cloud.height > 1 ? cloud.row_step : row;
    if (const uint64_t size = row_step_ * cloud.height; cloud.data.size() != size)
      Reject(Format("size of data = %zu must be %lu by width, height and point_step",
                    cloud.data.size(), size));
    if (cloud.point_step == 0) Reject("point_step = 0 must be positive");
  }

  /// The field of that name; null when there is none.
  const PointField* Find(const std::string& name) const {
    const auto field = std::find_if(cloud_.fields.begin(), cloud_.fields.end(),
                                    [&](const PointField& f) { return f.name == name; });
    if (field == cloud_.fields.end()) return nullptr;
    if (field->datatype < PointField::INT8 || field->datatype > PointField::FLOAT64)
      Reject(Format("datatype of field '%s' = %u must be 1 to 8", name.c_str(),
                    unsigned{field->datatype}));
    const int size = sizeOfPointField(field->datatype);
    if (uint64_t{field->offset} + static_cast<uint64_t>(size) > cloud_.point_step)
      Reject(Format("offset of field '%s' = %u leaves no %d bytes within point_step = %u",
                    name.c_str(), field->offset, size, cloud_.point_step));
    return &*field;
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

 private:
  const PointCloud2& cloud_;
  uint64_t row_step_;
};

double ValueOf(const PointField& field, const uint8_t* point) {
  return sensor_msgs::readPointCloud2BufferValue<double>(point + field.offset, field.datatype);
}

/// Least and largest time of the points of a cloud, as in the field.
struct TimeRange {
  double least = std::numeric_limits<double>::infinity(), largest = -least;
  double stamp_s;  ///< of the cloud

  TimeRange(const PointCloud2& message, const std::string& name)
      : stamp_s(message.header.stamp.toSec()) {
    const CheckedCloud cloud(message);
    if (const PointField* field = cloud.Find(name))
      cloud.ForEach([&](const uint8_t* data) {
        const double value = ValueOf(*field, data);
        if (!std::isfinite(value)) return;
        least = std::min(least, value);
        largest = std::max(largest, value);
      });
  }

  double Span() const { return std::max(0.0, largest - least); }
  bool IsWithin(const PointTime& time) const {
    const double from = time.is_since ? 0.0 : stamp_s;
    return least > largest || (std::abs(time.unit_s * least - from) <= kLongestOffset &&
                               std::abs(time.unit_s * largest - from) <= kLongestOffset);
  }
};

/// Median time from a cloud to the next [s].
double PeriodOf(const std::vector<PointCloud2>& clouds) {
  std::vector<double> periods;
  for (size_t k = 1; k < clouds.size(); ++k) {
    const double period = (clouds[k].header.stamp - clouds[k - 1].header.stamp).toSec();
    if (period > 0.0) periods.push_back(period);
  }
  return periods.empty() ? kUsualPeriod : Median(std::move(periods));
}

}  // namespace

PointTime FindPointTime(const std::vector<PointCloud2>& clouds, const std::string& choice) {
  const auto is_chosen = [&](const Unit& unit) { return choice == unit.name; };
  if (choice != "auto" && choice != "none" &&
      std::none_of(std::begin(kUnits), std::end(kUnits), is_chosen))
    Reject("point_time '", choice, "' is unknown; must be auto, none, s, ms, us or ns");
  if (choice == "none" || clouds.empty()) return {};
  const CheckedCloud first(clouds.front());
  const auto name = std::find_if(std::begin(kTimeNames), std::end(kTimeNames),
                                 [&](const char* n) { return first.Find(n) != nullptr; });
  if (name == std::end(kTimeNames)) {
    if (choice == "auto") return {};
    Reject("point_time = ", choice,
           ", but no field of the clouds is called t, time or timestamp; they are ", first.Names());
  }
  std::vector<TimeRange> ranges;
  double span = 0.0;
  for (const PointCloud2& cloud : clouds) {
    ranges.emplace_back(cloud, *name);
    span = std::max(span, ranges.back().Span());
  }
  if (span == 0.0) return {};

  const double period_s = PeriodOf(clouds);
  const auto unit = std::find_if(std::begin(kUnits), std::end(kUnits), [&](const Unit& u) {
    const double fill = u.seconds * span / period_s;
    return is_chosen(u) || (choice == "auto" && fill > kLeastFill && fill < kMostFill);
  });
  if (unit == std::end(kUnits))
    Reject(
        Format("times in field '%s' of the points span %.10g within a cloud while clouds follow "
               "each other by %.10g s, which neither s, ms, us nor ns explain; give point_time",
               *name, span, period_s));
  PointTime time{*name, unit->name, unit->seconds};
  for (const bool is_since : {true, false}) {
    time.is_since = is_since;
    if (std::all_of(ranges.begin(), ranges.end(), [&](const auto& r) { return r.IsWithin(time); }))
      return time;
  }
  Reject(Format(
      "times in field '%s' of the points, from %.10g s on, are neither within %.10g s of the stamp "
      "of their cloud (%.10g s) nor after it by that; point_time none leaves them out",
      *name, unit->seconds * ranges[0].least, kLongestOffset, ranges[0].stamp_s));
}

std::vector<CloudPoint> ReadCloud(const PointCloud2& message, const PointTime& time) {
  const CheckedCloud cloud(message);
  std::array<const PointField*, 3> xyz;
  for (size_t i = 0; i < 3; ++i) {
    const std::string name(1, "xyz"[i]);
    xyz[i] = cloud.Find(name);
    if (!xyz[i] || xyz[i]->datatype < PointField::FLOAT32)  // the last two of them
      Reject("field '", name, "' must be there as float32 or float64; the fields are ",
             cloud.Names());
  }
  const PointField* intensity = cloud.Find("intensity");
  const PointField* own_time = time.field.empty() ? nullptr : cloud.Find(time.field);
  if (!time.field.empty() && !own_time)
    Reject("field '", time.field, "' must be there, as in the first cloud");
  const double epoch_s = time.is_since ? 0.0 : message.header.stamp.toSec();

  std::vector<CloudPoint> points;
  points.reserve(size_t{message.width} * message.height);
  cloud.ForEach([&](const uint8_t* data) {
    CloudPoint point;
    for (int i = 0; i < 3; ++i)
      point.p_S[i] = static_cast<float>(ValueOf(*xyz[static_cast<size_t>(i)], data));
    if (intensity) point.intensity = static_cast<float>(ValueOf(*intensity, data));
    if (own_time && point.p_S.allFinite()) {
      const double after_s = time.unit_s * ValueOf(*own_time, data) - epoch_s;
      if (!(std::abs(after_s) <= kLongestOffset))
        Reject(Format(
            "field '%s' puts a point %.10g s after the stamp of its cloud; must be within %.10g s",
            time.field.c_str(), after_s, kLongestOffset));
      point.time_after_ns = std::llround(1e9 * after_s);
    }
    points.push_back(point);
  });
  return points;
}

bool HasIntensity(const PointCloud2& cloud) {
  return CheckedCloud(cloud).Find("intensity") != nullptr;
}

std::string ToPcd(const std::vector<MapPoint>& points, bool has_intensity) {
  std::string pcd = "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n";
  pcd += has_intensity ? "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
                       : "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n";
  pcd += Format("WIDTH %zu\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS %zu\nDATA binary\n",
                points.size(), points.size());
  const size_t size = (has_intensity ? 4 : 3) * sizeof(float);
  pcd.reserve(pcd.size() + size * points.size());
  for (const MapPoint& point : points)
    pcd.append(reinterpret_cast<const char*>(point.data()), size);
  return pcd;
}

PointCloud2 ToMessage(const std::vector<MapPoint>& points, const std::string& frame) {
  PointCloud2 message;
  message.header.frame_id = frame;
  message.is_dense = 1u;
  sensor_msgs::PointCloud2Modifier modifier(message);
  modifier.setPointCloud2Fields(4, "x", 1, PointField::FLOAT32, "y", 1, PointField::FLOAT32, "z", 1,
                                PointField::FLOAT32, "intensity", 1, PointField::FLOAT32);
  modifier.resize(points.size());
  if (!points.empty()) std::memcpy(message.data.data(), points.data(), message.data.size());
  return message;
}

}  // namespace imu_pose_calib
