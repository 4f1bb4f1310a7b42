#include <sensor_msgs/point_cloud2_iterator.h>

#include <cmath>
#include <functional>

#include "cloud_util.h"
#include "imu_pose_calib/ros/io/point_cloud.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using sensor_msgs::PointCloud2;
using sensor_msgs::PointField;

constexpr double kStamp = 1600000000.25;  // [s]

std::vector<TestField> Xyz() {
  return {{"x", PointField::FLOAT32, {1.0, 2.0, 3.0}},
          {"y", PointField::FLOAT32, {-1.0, -2.0, -3.0}},
          {"z", PointField::FLOAT32, {0.5, 0.25, 0.125}}};
}

/// Two clouds, 0.1 s apart, whose points have these times.
std::vector<PointCloud2> Timed(const std::string& name, uint8_t type,
                               const std::function<std::vector<double>(double stamp_s)>& times) {
  std::vector<PointCloud2> clouds;
  for (const double stamp : {kStamp, kStamp + 0.1}) {
    std::vector<TestField> fields = Xyz();
    fields.push_back({name, type, times(stamp)});
    clouds.push_back(MakeCloud(stamp, fields));
  }
  return clouds;
}

/// Expects that the points are 0, 50 and 99.5 ms after their stamps.
void ExpectTimes(const std::vector<PointCloud2>& clouds, const std::string& field) {
  const PointTime time = FindPointTime(clouds, "auto");
  EXPECT_EQ(time.field, field);
  for (const PointCloud2& cloud : clouds) {
    const std::vector<CloudPoint> points = ReadCloud(cloud, time);
    ASSERT_EQ(points.size(), 3u);
    EXPECT_NEAR(1e-9 * static_cast<double>(points[0].time_after_ns), 0.0, 1e-6);
    EXPECT_NEAR(1e-9 * static_cast<double>(points[1].time_after_ns), 0.05, 1e-6);
    EXPECT_NEAR(1e-9 * static_cast<double>(points[2].time_after_ns), 0.0995, 1e-6);
  }
}

TEST(PointTime, IsFoundAsDriversWriteIt) {
  const auto relative = [](double unit) {
    return [unit](double) { return std::vector<double>{0.0, 0.05 / unit, 0.0995 / unit}; };
  };
  const auto absolute = [](double unit) {
    return [unit](double stamp) {
      return std::vector<double>{stamp / unit, (stamp + 0.05) / unit, (stamp + 0.0995) / unit};
    };
  };
  ExpectTimes(Timed("time", PointField::FLOAT32, relative(1.0)), "time");             // Velodyne
  ExpectTimes(Timed("t", PointField::UINT32, relative(1e-9)), "t");                   // Ouster
  ExpectTimes(Timed("timestamp", PointField::FLOAT64, absolute(1.0)), "timestamp");   // Hesai
  ExpectTimes(Timed("timestamp", PointField::FLOAT64, absolute(1e-9)), "timestamp");  // Livox
  ExpectTimes(Timed("offset_time", PointField::UINT32, relative(1e-9)), "offset_time");
  ExpectTimes(Timed("time", PointField::FLOAT32, relative(1e-6)), "time");
  ExpectTimes(Timed("time_offset", PointField::FLOAT32, relative(1e-3)), "time_offset");
}

TEST(PointTime, MayBeBeforeTheStamp) {
  const auto clouds = Timed("time", PointField::FLOAT32, [](double) {
    return std::vector<double>{-0.09, -0.04, 0.0};
  });
  const auto points = ReadCloud(clouds[0], FindPointTime(clouds, "auto"));
  EXPECT_NEAR(static_cast<double>(points[0].time_after_ns), -0.09e9, 10.0);
}

TEST(PointTime, IsNoneWithoutAField) {
  const std::vector<PointCloud2> clouds = {MakeCloud(kStamp, Xyz())};
  EXPECT_EQ(FindPointTime(clouds, "auto").field, "");
  EXPECT_EQ(ReadCloud(clouds[0], {})[2].time_after_ns, 0);
  ExpectError<InputError>([&] { FindPointTime(clouds, "us"); }, {"point_time = us", "x, y, z"});
}

TEST(PointTime, IsNoneWhereAllAreTheSame) {
  const auto clouds = Timed("time", PointField::FLOAT32, [](double) {
    return std::vector<double>{0.0, 0.0, 0.0};
  });
  EXPECT_EQ(FindPointTime(clouds, "auto").field, "");
}

TEST(PointTime, IsRefusedWhereItCannotBeTold) {
  const auto exposed = Timed("t", PointField::UINT32, [](double) {
    return std::vector<double>{0.0, 1.0, 1000.0};  // 1 us or 1 ms or 1 s of 0.1 s
  });
  ExpectError<InputError>([&] { FindPointTime(exposed, "auto"); },
                          {"'t'", "span 1000", "0.0999999", "point_time"});
  EXPECT_EQ(FindPointTime(exposed, "us").unit_s, 1e-6);
  EXPECT_EQ(FindPointTime(exposed, "none").field, "");
  const auto elsewhere = Timed("t", PointField::FLOAT64, [](double) {
    return std::vector<double>{5000.0, 5000.05, 5000.1};
  });
  ExpectError<InputError>([&] { FindPointTime(elsewhere, "auto"); },
                          {"'t'", "5000 s", "1600000000", "none"});
  ExpectError<InputError>([&] { FindPointTime(elsewhere, "fortnight"); },
                          {"point_time 'fortnight'", "auto, none, s, ms, us or ns"});
}

TEST(ReadCloud, ReadsEveryTypeAndPadding) {
  PointCloud2 cloud = MakeCloud(kStamp, {{"intensity", PointField::UINT8, {7.0, 255.0}},
                                         {"z", PointField::FLOAT64, {0.5, 0.25}},
                                         {"ring", PointField::UINT16, {1.0, 2.0}},
                                         {"x", PointField::FLOAT32, {1.0, std::nan("")}},
                                         {"y", PointField::FLOAT32, {-1.0, -2.0}}});
  EXPECT_TRUE(HasIntensity(cloud));
  // The same as two rows of one point each with three bytes behind.
  cloud.height = 2;
  cloud.width = 1;
  cloud.row_step = cloud.point_step + 3;
  cloud.data.insert(cloud.data.begin() + cloud.point_step, 3, 0xff);
  cloud.data.insert(cloud.data.end(), 3, 0xff);
  const std::vector<CloudPoint> points = ReadCloud(cloud, {});
  ASSERT_EQ(points.size(), 2u);
  EXPECT_EQ(points[0].p_S, Eigen::Vector3f(1.0f, -1.0f, 0.5f));
  EXPECT_EQ(points[0].intensity, 7.0f);
  EXPECT_FALSE(points[1].p_S.allFinite());
  EXPECT_EQ(points[1].intensity, 255.0f);
}

TEST(ReadCloud, RefusesDamage) {
  const PointCloud2 good = MakeCloud(kStamp, Xyz());
  const auto refused = [&](const std::function<void(PointCloud2*)>& damage,
                           const std::vector<std::string>& parts) {
    PointCloud2 cloud = good;
    damage(&cloud);
    ExpectError<InputError>([&] { ReadCloud(cloud, {}); }, parts);
  };
  refused([](auto* c) { c->is_bigendian = 1u; }, {"is_bigendian"});
  refused([](auto* c) { c->data.pop_back(); }, {"size of data = 35", "36"});
  refused([](auto* c) { c->width = 0xffffffffu; }, {"size of data = 36", "51539607540"});
  refused([](auto* c) { c->height = 2; }, {"size of data = 36", "72"});
  refused(
      [](auto* c) {
        c->height = 0xffffffffu;
        c->row_step = 0xffffffffu;
      },
      {"size of data"});
  refused(
      [](auto* c) {
        c->height = 2;
        c->row_step = 35;
      },
      {"row_step = 35", "at least 36"});
  refused(
      [](auto* c) {
        c->point_step = 0;
        c->data.clear();
      },
      {"point_step = 0"});
  refused([](auto* c) { c->fields[2].offset = 9; }, {"'z'", "9", "point_step = 12"});
  refused([](auto* c) { c->fields[2].offset = 0xffffffffu; }, {"'z'", "4294967295"});
  refused([](auto* c) { c->fields[0].datatype = 9; }, {"'x'", "9", "1 to 8"});
  refused([](auto* c) { c->fields[0].datatype = PointField::INT32; }, {"'x'", "float32"});
  refused([](auto* c) { c->fields[1].name = "why"; }, {"'y'", "x, why, z"});
  PointCloud2 empty = good;
  empty.width = 0;
  empty.height = 0xffffffffu;
  empty.row_step = 0;
  empty.data.clear();
  EXPECT_TRUE(ReadCloud(empty, {}).empty());
}

TEST(ReadCloud, RefusesTimesFarFromTheStamp) {
  auto clouds = Timed("time", PointField::FLOAT32, [](double) {
    return std::vector<double>{0.0, 0.05, 0.1};
  });
  const PointTime time = FindPointTime(clouds, "auto");
  const float late = 1.5f;
  std::memcpy(clouds[1].data.data() + 16 + 12, &late, sizeof(late));
  ExpectError<InputError>([&] { ReadCloud(clouds[1], time); }, {"'time'", "1.5 s", "within 1 s"});
  ExpectError<InputError>([&] { ReadCloud(MakeCloud(kStamp, Xyz()), time); }, {"'time'", "first"});
}

TEST(Pcd, IsReadBack) {
  const std::vector<MapPoint> map = {{1.0f, -2.0f, 3.5f, 10.0f}, {0.1f, 0.2f, -0.3f, 20.0f}};
  const PcdFile with(ToPcd(map, true)), without(ToPcd(map, false));
  EXPECT_EQ(with.header.at("FIELDS"), (std::vector<std::string>{"x", "y", "z", "intensity"}));
  EXPECT_EQ(without.header.at("FIELDS"), (std::vector<std::string>{"x", "y", "z"}));
  EXPECT_EQ(with.points[1], (std::vector<float>{0.1f, 0.2f, -0.3f, 20.0f}));
  EXPECT_EQ(without.points[0], (std::vector<float>{1.0f, -2.0f, 3.5f}));
  EXPECT_TRUE(PcdFile(ToPcd({}, true)).points.empty());
}

TEST(Message, IsReadBack) {
  const std::vector<MapPoint> map = {{1.0f, -2.0f, 3.5f, 10.0f}, {0.1f, 0.2f, -0.3f, 20.0f}};
  const PointCloud2 message = ToMessage(map, "world");
  EXPECT_EQ(message.header.frame_id, "world");
  EXPECT_EQ(message.width, 2u);
  sensor_msgs::PointCloud2ConstIterator<float> x(message, "x"), intensity(message, "intensity");
  EXPECT_EQ(x[2], 3.5f);
  ++x, ++intensity;
  EXPECT_EQ(x[1], 0.2f);
  EXPECT_EQ(*intensity, 20.0f);
}

}  // namespace
}  // namespace imu_pose_calib
