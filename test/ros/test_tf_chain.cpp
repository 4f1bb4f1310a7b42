#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <limits>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/tf_chain.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

constexpr double kCache = 100.0;  // [s]

geometry_msgs::TransformStamped Link(const std::string& parent, const std::string& child, double t,
                                     double x, double angle = 0.0) {
  geometry_msgs::TransformStamped link;
  link.header.stamp = ros::Time(t);
  link.header.frame_id = parent;
  link.child_frame_id = child;
  link.transform.translation.x = x;
  link.transform.rotation.z = std::sin(0.5 * angle);
  link.transform.rotation.w = std::cos(0.5 * angle);
  return link;
}

tf2_msgs::TFMessage Message(const std::vector<geometry_msgs::TransformStamped>& links) {
  tf2_msgs::TFMessage message;
  message.transforms = links;
  return message;
}

/// Stamps [s] and x [m] of the poses.
std::vector<std::pair<double, double>> Summary(const std::vector<PoseSample>& poses) {
  std::vector<std::pair<double, double>> summary;
  for (const PoseSample& pose : poses)
    summary.emplace_back(1e-9 * static_cast<double>(pose.t_ns), pose.p_WM.x());
  return summary;
}

using Poses = std::vector<std::pair<double, double>>;

TEST(TfChain, GivesThePosesOfOneLink) {
  TfChain chain("/world", "marker", kCache);
  chain.Add(Message({Link("world", "/marker", 1.0, 1.0)}), false);
  chain.Add(Message({Link("world", "/marker", 2.0, 4.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{1.0, 1.0}, {2.0, 4.0}}));
  chain.Add(Message({Link("world", "/marker", 3.0, 5.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{3.0, 5.0}}));
  EXPECT_TRUE(chain.TakePoses().empty());
  EXPECT_EQ(chain.Problem(), "");
}

TEST(TfChain, ComposesLinksUpAndDownTheTree) {
  // hand <- arm <- base -> world: the hand in the world
  TfChain chain("world", "hand", kCache);
  chain.Add(Message({Link("base", "world", 0.0, 0.0, M_PI / 2)}), true);
  chain.Add(Message({Link("base", "arm", 1.0, 2.0, M_PI / 2), Link("arm", "hand", 1.0, 1.0)}),
            false);
  chain.Add(Message({Link("base", "arm", 2.0, 3.0, M_PI / 2), Link("arm", "hand", 2.0, 1.5)}),
            false);
  const std::vector<PoseSample> poses = chain.TakePoses();
  ASSERT_EQ(poses.size(), 2u);
  // hand in base: (3, 1.5), turned by 90 deg; base in world: turned by -90 deg
  EXPECT_LT((poses[1].p_WM - Eigen::Vector3d(1.5, -3.0, 0.0)).norm(), 1e-12);
  EXPECT_LT(poses[1].q_WM.angularDistance(Eigen::Quaterniond::Identity()), 1e-12);
}

TEST(TfChain, InterpolatesTheLinksThatDidNotMove) {
  TfChain chain("a", "c", kCache);
  chain.Add(Message({Link("a", "b", 1.0, 0.0), Link("b", "c", 1.0, 0.0)}), false);
  chain.Add(Message({Link("b", "c", 2.0, 1.0)}), false);
  chain.Add(Message({Link("b", "c", 3.0, 2.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{1.0, 0.0}}));  // a -> b is not known yet
  chain.Add(Message({Link("a", "b", 4.0, 30.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{2.0, 11.0}, {3.0, 22.0}}));
  chain.Add(Message({Link("b", "c", 4.0, 3.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{4.0, 33.0}}));
}

TEST(TfChain, TakesOnlyStampsAtWhichEveryLinkIsKnown) {
  TfChain chain("a", "c", kCache);
  for (int k = 0; k < 10; ++k) chain.Add(Message({Link("b", "c", 1.0 + k, k)}), false);
  chain.Add(Message({Link("a", "b", 3.5, 0.0)}), false);
  chain.Add(Message({Link("a", "b", 5.5, 0.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{4.0, 3.0}, {5.0, 4.0}}));
}

TEST(TfChain, RepeatedLinksBringNoPoses) {
  TfChain chain("a", "c", kCache);
  for (int k = 0; k < 4; ++k) {
    chain.Add(Message({Link("a", "b", 1.5 + k, 7.0)}), false);
    chain.Add(Message({Link("b", "c", 2.0 + k, k)}), false);
  }
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{2.0, 7.0}, {3.0, 8.0}, {4.0, 9.0}}));
}

TEST(TfChain, KeepsPosesOfAFrozenTracker) {
  TfChain chain("world", "marker", kCache);
  for (const double x : {1.0, 2.0}) chain.Add(Message({Link("world", "marker", x, x)}), false);
  for (int k = 0; k < 3; ++k) chain.Add(Message({Link("world", "marker", 3.0 + k, 2.0)}), false);
  EXPECT_EQ(chain.TakePoses().size(), 5u);
}

TEST(TfChain, SaysWhichPosesAreUnusable) {
  TfChain chain("a", "c", kCache);
  for (int k = 0; k < 3; ++k) {
    auto first = Link("a", "b", 1.0 + k, k), second = Link("b", "c", 1.0 + k, k);
    if (k == 1) first.transform.translation.y = std::nan("");
    chain.Add(Message({first, second}), false);
  }
  const std::vector<PoseSample> poses = chain.TakePoses();
  ASSERT_EQ(poses.size(), 3u);
  EXPECT_TRUE(poses[0].p_WM.allFinite());
  EXPECT_EQ(poses[1].t_ns, 2000000000);
  EXPECT_FALSE(poses[1].p_WM.allFinite());
  EXPECT_TRUE(poses[2].p_WM.allFinite());
}

TEST(TfChain, AStampBeyondTheTimesOfRosIsNoPose) {
  TfChain chain("world", "marker", kCache);
  geometry_msgs::TransformStamped link = Link("world", "marker", 1.0, 1.0), late = link;
  late.header.stamp.sec = std::numeric_limits<uint32_t>::max();
  late.header.stamp.nsec = 2'000'000'000;  // as a message may say
  for (int k = 0; k < 2; ++k) chain.Add(Message({late, link}), false);
  late.header.stamp = ros::TIME_MAX - ros::Duration(0.5 * kCache);  // to which tf2 adds the cache
  chain.Add(Message({late, Link("world", "marker", 1.5, 2.0), late}), false);
  chain.Add(Message({Link("world", "marker", 2.0, 4.0)}), false);
  EXPECT_EQ(Summary(chain.TakePoses()), (Poses{{1.0, 1.0}, {1.5, 2.0}, {2.0, 4.0}}));
}

TEST(TfChain, KeepsTheOrderOfReversedStamps) {
  TfChain chain("world", "marker", kCache);
  std::vector<double> stamps;
  for (const double t : {5.0, 6.0, 3.0, 7.0}) {
    chain.Add(Message({Link("world", "marker", t, t)}), false);
    for (const auto& [stamp, x] : Summary(chain.TakePoses())) stamps.push_back(stamp);
  }
  EXPECT_EQ(stamps, (std::vector<double>{5.0, 6.0, 3.0, 7.0}));
}

TEST(TfChain, KeepsNanosecondsOverLongRecordings) {
  TfChain chain("world", "marker", 3600.0);
  size_t count = 0;
  for (uint32_t k = 0; k < 20000; ++k) {
    auto link = Link("world", "marker", 0.0, k);
    link.header.stamp = ros::Time(1600000000 + k / 10, 123456789);
    if (k % 10 == 0) chain.Add(Message({link}), false);
    for (const PoseSample& pose : chain.TakePoses()) {
      EXPECT_EQ(pose.t_ns % 1000000000, 123456789);
      ++count;
    }
  }
  EXPECT_EQ(count, 2000u);
}

/// Most updates that a chain of two links keeps while a -> b moves at 100 Hz.
template <typename Others>
size_t MostPending(const Others& others) {
  TfChain chain("a", "c", 2.0);
  size_t most = 0;
  for (int k = 0; k < 3000; ++k) {
    chain.Add(Message({Link("a", "b", 1.0 + 0.01 * k, k)}), false);
    chain.Add(Message(others(k)), false);
    chain.TakePoses();
    most = std::max(most, chain.Pending());
  }
  return most;
}

using Links = std::vector<geometry_msgs::TransformStamped>;

/// Whatever the other links do, no more is kept than the cache can tell poses of.
TEST(TfChain, KeepsNoMoreUpdatesThanTheCache) {
  EXPECT_LT(MostPending([](int k) { return Links{Link("b", "c", 1.0 + 0.01 * k, k)}; }), 5u);
  EXPECT_LE(MostPending([](int) { return Links(); }), 201u) << "not connected";
  EXPECT_LE(MostPending(
                [](int k) { return k > 100 ? Links() : Links{Link("b", "c", 1.0 + 0.01 * k, k)}; }),
            201u)
      << "b -> c stalls";
  EXPECT_LE(MostPending([](int k) { return Links{Link("b", "c", 5.0, k)}; }), 202u)
      << "the stamps of b -> c stall";
  EXPECT_LE(MostPending([](int k) {
              return Links{Link("b", "c", 1.0 + 0.01 * k, k), Link("x", "y", 1.0 + 0.01 * k, k)};
            }),
            205u)
      << "x -> y is not part of the chain";
  const auto lost = [](double t) {
    auto link = Link("b", "c", t, 0.0);
    link.transform.translation.x = std::nan("");
    return link;
  };
  EXPECT_LE(MostPending([&](int k) {
              return Links{k < 100 ? Link("b", "c", 1.0 + 0.01 * k, k) : lost(1.0 + 0.01 * k)};
            }),
            402u)
      << "b -> c is lost for good";
  EXPECT_LE(MostPending([&](int k) { return Links{lost(1.0 + 0.01 * k)}; }), 201u)
      << "b -> c has never been seen";
}

/// A stall that is longer than the cache costs no more than the poses meanwhile.
TEST(TfChain, GoesOnAfterAStall) {
  TfChain chain("a", "c", 2.0);
  size_t count = 0;
  for (int k = 0; k < 3000; ++k) {
    chain.Add(Message({Link("a", "b", 1.0 + 0.01 * k, k)}), false);
    if (k < 1000 || k >= 2000) chain.Add(Message({Link("b", "c", 1.0 + 0.01 * k, k)}), false);
    for (const PoseSample& pose : chain.TakePoses()) count += pose.p_WM.allFinite();
  }
  EXPECT_GE(count, 2000u);
}

void ExpectProblem(const TfChain& chain, const std::vector<std::string>& parts) {
  for (const std::string& part : parts)
    EXPECT_TRUE(Contains(chain.Problem(), part)) << chain.Problem();
}

TEST(TfChain, NamesWhatIsMissing) {
  const auto fill = [](TfChain* chain) {
    chain->Add(Message({Link("base", "camera", 0.0, 1.0)}), true);
    for (int k = 0; k < 3; ++k)
      chain->Add(Message({Link("world", "base", 1.0 + k, k), Link("map", "odom", 1.0 + k, 0.0)}),
                 false);
  };
  TfChain missing("earth", "base", kCache);
  ExpectProblem(missing, {"tf_parent 'earth' is not in tf, which has: nothing"});
  fill(&missing);
  ExpectProblem(missing, {"'earth'", "world -> base, base -> camera (fixed), map -> odom"});
  TfChain unconnected("map", "camera", kCache);
  fill(&unconnected);
  EXPECT_TRUE(unconnected.TakePoses().empty());
  ExpectProblem(unconnected, {"tf_parent 'map' and tf_child 'camera' are not connected"});
  TfChain fixed("base", "camera", kCache);
  fill(&fixed);
  EXPECT_TRUE(fixed.TakePoses().empty());
  ExpectProblem(fixed, {"fixed to each other"});
  TfChain same("base", "base", kCache);
  fill(&same);
  ExpectProblem(same, {"fixed to each other"});
  TfChain resting("map", "odom", kCache);
  fill(&resting);
  EXPECT_TRUE(resting.TakePoses().empty());
  ExpectProblem(resting, {"do not move against each other"});
}

TEST(TfChain, ShowsNamesWithoutControlCharacters) {
  TfChain chain("world", "marker", kCache);
  chain.Add(Message({Link("\x1b[2J", "\xff", 1.0, 1.0)}), false);
  ExpectProblem(chain, {"which has: \\x1b[2J -> \\xff"});
}

TEST(TfChain, SurvivesLoops) {
  TfChain chain("a", "d", kCache);
  chain.Add(Message({Link("a", "b", 1.0, 1.0), Link("b", "a", 1.0, 1.0), Link("c", "d", 1.0, 1.0)}),
            false);
  EXPECT_TRUE(chain.TakePoses().empty());
  ExpectProblem(chain, {"not connected"});
  TfChain inside("a", "b", kCache);
  for (int k = 0; k < 3; ++k)
    inside.Add(Message({Link("a", "b", 1.0 + k, k), Link("b", "a", 1.0 + k, k)}), false);
  inside.TakePoses();
}

}  // namespace
}  // namespace imu_pose_calib
