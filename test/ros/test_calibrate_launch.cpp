// Runs beside calibrate.launch: what it publishes and writes is the truth of the simulated bag.

#include <fcntl.h>
#include <gtest/gtest.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>
#include <sys/stat.h>
#include <tf2_msgs/TFMessage.h>
#include <yaml-cpp/yaml.h>

#include <Eigen/Geometry>
#include <future>

#include "imu_pose_calib/CalibrationResult.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

// About five times the scatter between seeds at the noise of the bag.
constexpr double kTranslation = 2e-3;  // [m]
constexpr double kRotation = 1e-3;     // [rad]
constexpr double kTimeShift = 2e-4;    // [s]
constexpr double kTimeout = 90.0;      // [s]

std::string Param(const std::string& name) {
  std::string value;
  EXPECT_TRUE(ros::param::get("~" + name, value)) << name;
  return value;
}

/// Next message of a latched topic.
template <typename Msg>
boost::shared_ptr<const Msg> Receive(const std::string& topic) {
  ros::NodeHandle node;
  return ros::topic::waitForMessage<Msg>(topic, node, ros::Duration(kTimeout));
}

void ExpectTruth(const geometry_msgs::Transform& transform) {
  const YAML::Node truth = YAML::LoadFile(Param("truth"));
  const auto p = truth["translation"].as<std::vector<double>>();
  const auto q = truth["rotation"].as<std::vector<double>>();
  EXPECT_NEAR(transform.translation.x, p[0], kTranslation);
  EXPECT_NEAR(transform.translation.y, p[1], kTranslation);
  EXPECT_NEAR(transform.translation.z, p[2], kTranslation);
  const auto& r = transform.rotation;
  EXPECT_LT(Eigen::Quaterniond(r.w, r.x, r.y, r.z)
                .angularDistance(Eigen::Quaterniond(q[3], q[0], q[1], q[2])),
            kRotation);
}

TEST(CalibrateLaunch, PublishesTheResult) {
  const auto result = Receive<CalibrationResult>("/imu_pose_calib/result");
  ASSERT_TRUE(result);
  EXPECT_EQ(result->status, CalibrationResult::STATUS_OK) << result->message;
  EXPECT_EQ(result->header.frame_id, "rig");
  EXPECT_EQ(result->child_frame_id, "imu");
  ExpectTruth(result->transform);
  const YAML::Node truth = YAML::LoadFile(Param("truth"));
  EXPECT_NEAR(result->time_shift, truth["time_shift"].as<double>(), kTimeShift);
  EXPECT_NEAR(result->accel_delay, truth["accel_delay"].as<double>(), 5 * kTimeShift);
  EXPECT_GT(result->covariance[0], 0.0);
  EXPECT_NEAR(result->gravity.z, -9.80665, 0.05);
}

TEST(CalibrateLaunch, PublishesTheStaticTransform) {
  const auto tf = Receive<tf2_msgs::TFMessage>("/tf_static");
  ASSERT_TRUE(tf);
  ASSERT_EQ(tf->transforms.size(), 1u);
  EXPECT_EQ(tf->transforms[0].header.frame_id, "rig");
  EXPECT_EQ(tf->transforms[0].child_frame_id, "imu");
  ExpectTruth(tf->transforms[0].transform);
}

/// The file is there before the result is published.
TEST(CalibrateLaunch, WritesTheResultFile) {
  const auto result = Receive<CalibrationResult>("/imu_pose_calib/result");
  ASSERT_TRUE(result);
  const YAML::Node yaml = YAML::LoadFile(Param("output"));
  EXPECT_EQ(yaml["imu_pose_calib"]["status"].as<std::string>(), result->status_text);
  EXPECT_EQ(yaml["frames"]["marker"].as<std::string>(), "rig");
  EXPECT_EQ(yaml["time_shift"].as<double>(), result->time_shift);
  EXPECT_EQ(yaml["transform"]["translation"][0].as<double>(), result->transform.translation.x);
  EXPECT_EQ(yaml["transform"]["rotation"][3].as<double>(), result->transform.rotation.w);
  std::filesystem::path report(Param("output"));
  EXPECT_TRUE(std::filesystem::exists(report.replace_extension(".report.html")));
}

std::string Directory() { return std::filesystem::path(Param("truth")).parent_path().string(); }

struct Outcome {
  int status = -1;
  std::string err;
};

/// Runs another node beside the launched one.
Outcome RunNode(const std::string& name, const std::string& parameters) {
  const std::string err = Directory() + "/" + name + ".err.txt";
  const int status = std::system(("'" IMU_POSE_CALIB_BIN_DIR "/calibrate_node' __name:=" + name +
                                  " " + parameters + " 2> '" + err + "'")
                                     .c_str());
  return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, ReadText(err)};
}

void ExpectFailure(const Outcome& outcome, int status, const std::string& part) {
  EXPECT_EQ(outcome.status, status);
  EXPECT_TRUE(Contains(outcome.err, "[FATAL]")) << outcome.err;
  EXPECT_TRUE(Contains(outcome.err, part)) << outcome.err;
}

TEST(CalibrateNode, FailsWithTheStatusOfCalibrateBag) {
  ExpectFailure(RunNode("missing_bag", "_bag:=/no/such.bag"), 1, "/no/such.bag");
  ExpectFailure(RunNode("wrong_type", "_bag:=x.bag _start:=soon"), 1, "/wrong_type/start");
  ExpectFailure(RunNode("degenerate", "_bag:='" + Directory() + "/static.bag'"), 2, "turn");
}

/// With nothing to offer yet, an interrupt ends it at once.
TEST(CalibrateNode, ReadsBeforeItJoinsTheGraph) {
  const std::string pipe = Directory() + "/poses.pipe";
  std::filesystem::remove(pipe);
  ASSERT_EQ(mkfifo(pipe.c_str(), 0600), 0);
  auto outcome = std::async(std::launch::async, [&] {
    return RunNode("early", "_poses:='" + pipe + "' _imu:='" + Directory() + "/text.imu.csv'");
  });
  int poses = -1;  // opens as soon as the node reads from the other end
  for (int k = 0; k < 1000 && poses < 0; ++k) {
    ros::WallDuration(0.01).sleep();
    poses = open(pipe.c_str(), O_WRONLY | O_NONBLOCK);
  }
  ASSERT_GE(poses, 0);
  ros::V_string nodes;
  EXPECT_TRUE(ros::master::getNodes(nodes));
  EXPECT_EQ(std::count(nodes.begin(), nodes.end(), "/imu_pose_calib"), 1);
  EXPECT_EQ(std::count(nodes.begin(), nodes.end(), "/early"), 0);
  close(poses);
  ExpectFailure(outcome.get(), 1, "poses.pipe");
}

TEST(CalibrateNode, ForgetsTheParametersOfItsCommandLine) {
  ExpectFailure(RunNode("forgetful", "_bag:=/no/such.bag _start:=1.0"), 1, "/no/such.bag");
  EXPECT_FALSE(ros::param::has("/forgetful/bag"));
  EXPECT_FALSE(ros::param::has("/forgetful/start"));
  ExpectFailure(RunNode("forgetful", "_bag:=x.bag _start:=soon"), 1, "/forgetful/start");
  EXPECT_FALSE(ros::param::has("/forgetful/bag"));
  // what somebody else has set is not the node's to delete
  ros::param::set("/forgetful/bag", "/no/other.bag");
  ExpectFailure(RunNode("forgetful", "_start:=1.0"), 1, "/no/other.bag");
  EXPECT_TRUE(ros::param::has("/forgetful/bag"));
  EXPECT_FALSE(ros::param::has("/forgetful/start"));
}

TEST(LiveLaunch, ForgetsTheParametersOfAnEarlierLaunch) {
  ros::param::set("/second/imu_pose_calib/bag", "/no/such.bag");
  const int status = std::system(
      "ROS_NAMESPACE=second timeout -s INT 5 roslaunch imu_pose_calib live.launch > /dev/null "
      "2>&1");
  ASSERT_TRUE(WIFEXITED(status));
  EXPECT_EQ(WEXITSTATUS(status), 124) << "it ended before it was told to";
  EXPECT_FALSE(ros::param::has("/second/imu_pose_calib/bag"));
  EXPECT_TRUE(ros::param::has("/second/imu_pose_calib/window"));
}

TEST(CalibrateNode, CalibratesFromTextFiles) {
  const std::string text = Directory() + "/text", output = text + ".result.yaml";
  std::filesystem::remove(output);
  const Outcome outcome = RunNode("text", "_exit:=true _output:='" + output + "' _poses:='" + text +
                                              ".poses.txt' _imu:='" + text + ".imu.csv'");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(YAML::LoadFile(output)["data"]["pose_topic"].as<std::string>(), text + ".poses.txt");
}

TEST(CalibrateLaunch, TakesTextFilesInPlaceOfTheSample) {
  const std::string path = Directory() + "/params.yaml";
  const auto param = [&](const std::string& arguments, const std::string& name) {
    const std::string command = "roslaunch --dump-params imu_pose_calib calibrate.launch " +
                                arguments + " > '" + path + "'";
    EXPECT_EQ(std::system(command.c_str()), 0);
    return YAML::LoadFile(path)["/imu_pose_calib/" + name].as<std::string>();
  };
  EXPECT_TRUE(Contains(param("", "bag"), "/data/estimator_own_clocks.bag"));
  EXPECT_EQ(param("poses:=/p.txt imu:=/i.csv", "bag"), "");
  EXPECT_EQ(param("poses:=/p.txt imu:=/i.csv", "imu"), "/i.csv");
  EXPECT_EQ(param("bag:=/folder poses:=/p.txt", "bag"), "/folder");
}

TEST(CalibrateNode, LeavesWhenWrittenWithExit) {
  const std::string output = Directory() + "/exit.result.yaml";
  std::filesystem::remove(output);
  const Outcome outcome = RunNode("leaving", "_exit:=true _export:='evo tf' _output:='" + output +
                                                 "' _bag:='" + Directory() + "/launch.bag'");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(std::filesystem::exists(output));
  EXPECT_TRUE(std::filesystem::exists(Directory() + "/exit.result.evo.json"));
  EXPECT_TRUE(std::filesystem::exists(Directory() + "/exit.result.tf.launch"));
}

TEST(CalibrateNode, ReadsTfFromSeveralBags) {
  SimulatorOptions simulator;
  simulator.duration_s = 15.0;
  SessionData imu = Simulate(simulator), poses;
  std::swap(imu.poses, poses.poses);
  const std::string bags = Directory() + "/imu.bag " + Directory() + "/tf.bag";
  WriteBag(Directory() + "/imu.bag", imu, {});
  WriteBag(Directory() + "/tf.bag", poses, {false, "tf"});
  const std::string output = Directory() + "/tf.result.yaml";
  std::filesystem::remove(output);
  const Outcome outcome = RunNode(
      "several", "_exit:=true _tf_parent:=world _tf_child:=marker _record_time:=false _output:='" +
                     output + "' _bag:='" + bags + "'");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(YAML::LoadFile(output)["data"]["bag"].as<std::string>(), bags);
}

TEST(EvaluateLaunch, TakesPathsWithBlanks) {
  const std::string path = Directory() + "/evaluate.txt";
  const std::string command = "roslaunch imu_pose_calib evaluate.launch out:='" + Directory() +
                              "/a b' bag:='/no such.bag' experiments:=pose_noize > '" + path +
                              "' 2>&1";
  ASSERT_NE(std::system(command.c_str()), -1);
  const std::string text = ReadText(path);
  EXPECT_TRUE(Contains(text, "did you mean 'pose_noise'?")) << text;
}

TEST(AggregateCloudsLaunch, OffersBothMaps) {
  for (const char* topic : {"/aggregate_clouds/map", "/aggregate_clouds/uncalibrated"}) {
    const auto map =
        ros::topic::waitForMessage<sensor_msgs::PointCloud2>(topic, ros::Duration(60.0));
    ASSERT_TRUE(map) << topic;
    EXPECT_EQ(map->header.frame_id, "world");
    EXPECT_GT(map->width, 10000u);
  }
  EXPECT_TRUE(std::filesystem::exists(Directory() + "/clouds.map.pcd"));
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, "test_calibrate_launch");
  ros::NodeHandle keep_alive;
  return RUN_ALL_TESTS();
}
