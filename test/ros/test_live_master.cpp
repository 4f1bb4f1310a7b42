// The live node while the ROS master, which this test starts, does not answer.

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <ros/ros.h>
#include <sys/socket.h>

#include <atomic>
#include <thread>

#include "live_util.h"

namespace imu_pose_calib {
namespace {

constexpr double kShort = 30.0;  // [s]

/// A port that nobody listens on.
std::string FreePort() {
  const int handle = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t size = sizeof(address);
  bind(handle, reinterpret_cast<sockaddr*>(&address), size);
  getsockname(handle, reinterpret_cast<sockaddr*>(&address), &size);
  close(handle);
  return std::to_string(ntohs(address.sin_port));
}

TEST(LiveMaster, ServicesAndStatusAnswerWhileTheMasterDoesNot) {
  const std::string port = FreePort();
  setenv("ROS_MASTER_URI", ("http://localhost:" + port).c_str(), 1);
  Process master({"rosmaster", "--core", "-p", port});
  int argc = 0;
  ros::init(argc, nullptr, "test_live_master");
  ASSERT_TRUE(WaitFor([] { return ros::master::check(); }, kShort));

  Node node("orphan", {"_imu_topic:=/imu", "_pose_topic:=/mocap/pose"});
  ASSERT_TRUE(
      WaitFor([&] { return Contains(node.status.message, "nobody has published it"); }, kShort))
      << node.status;
  ros::NodeHandle handle;
  // Those who are connected already need no master.
  ros::ServiceClient reset =
      handle.serviceClient<std_srvs::Trigger>(node.prefix() + "reset", /*persistent=*/true);
  ASSERT_TRUE(reset.isValid());

  master.Send(SIGSTOP);
  EXPECT_TRUE(WaitFor(
      [&] { return Contains(node.status.message, "the ROS master does not answer"); }, kShort))
      << node.status;
  const ros::Time stamp = node.status.header.stamp;
  EXPECT_TRUE(
      WaitFor([&] { return node.status.header.stamp > stamp + ros::Duration(1.0); }, kShort))
      << "the status has stopped";
  // A call that hangs ends with the node.
  std::atomic<bool> answered{false};
  std::thread hangman([&] {
    for (int k = 0; k < 100 && !answered; ++k) ros::WallDuration(0.1).sleep();
    if (!answered) node.Kill();
  });
  std_srvs::Trigger trigger;
  answered = reset.call(trigger);
  hangman.join();
  EXPECT_TRUE(answered);
  EXPECT_TRUE(trigger.response.success);

  master.Send(SIGCONT);
  EXPECT_TRUE(
      WaitFor([&] { return Contains(node.status.message, "nobody has published it"); }, kShort))
      << node.status;
}

}  // namespace
}  // namespace imu_pose_calib
