#pragma once

#include <geometry_msgs/TransformStamped.h>
#include <ros/ros.h>
#include <tf2_msgs/TFMessage.h>
#include <topic_tools/shape_shifter.h>

#include <deque>
#include <functional>
#include <future>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/tf_chain.h"
#include "imu_pose_calib/ros/live/live_calibration.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// Listens to the topics of the live node: hands samples to a LiveCalibration and keeps what the
/// messages say about frames. A topic need not exist yet; when it is not named, it is the one topic
/// of its types. No message is dropped on this side.
///
/// `mutex` guards the LiveCalibration and this. The callbacks of the topics lock it; everything
/// public is called with it held. The master is asked on a thread of its own and without the mutex,
/// since it may be away: the end of the object waits for that.
class LiveInput {
 public:
  /// Topics, tf and frames are those of `request`. `on_pose` is called, with the mutex held, for
  /// each valid pose.
  LiveInput(const ros::NodeHandle& node, const OfflineRequest& request, std::mutex* mutex,
            LiveCalibration* live, const std::function<void(const PoseSample&)>& on_pose);
  LiveInput(const LiveInput&) = delete;
  LiveInput& operator=(const LiveInput&) = delete;

  /// Forgets frames and what was dropped when the LiveCalibration has forgotten its data. Each
  /// message does so, too.
  void ForgetAfterReset();
  /// Topics, and frames as they are published.
  RecordingInfo Info() const;
  /// The link in tf, from elsewhere, of a frame to another parent than the marker; null: none.
  const geometry_msgs::TransformStamped* OtherParent(const std::string& frame) const;
  /// What was dropped, as a sentence; empty: nothing.
  std::string Dropped() const;
  /// Has the topics looked for that have brought nothing yet, and says what was the matter with
  /// them last time.
  std::string Look();
  bool IsLooking() const;

 private:
  using Message = ros::MessageEvent<const topic_tools::ShapeShifter>;
  using TfEvent = ros::MessageEvent<const tf2_msgs::TFMessage>;
  using Links = std::map<std::string, geometry_msgs::TransformStamped>;  ///< by child
  /// Reads a message of a topic; returns what it lacks, empty for nothing.
  using Read = std::function<std::string(const Message&)>;

  struct Topic {
    std::string parameter;  ///< that names it
    std::string* name;      ///< empty until it is named or found
    std::vector<std::string> types;
    Read read;
    bool is_named = !name->empty();
    bool has_data = false;
    std::string problem = {};         ///< of the last message
    std::string state = {};           ///< why nothing has come in, as the last look found
    ros::Subscriber subscriber = {};  ///< of the thread that looks
    ros::SteadyTime start = ros::SteadyTime::now();

    bool Accepts(const std::string& type) const;
    /// The one topic of these types, but for `others`; or else an empty name and why in `state`.
    std::string Find(const ros::master::V_TopicInfo& published,
                     const std::vector<std::string>& others);
    std::string Inspect(const ros::master::V_TopicInfo& published) const;
  };
  /// Of the marker, or of a pose sensor.
  struct Poses {
    PoseSensorInfo info;  ///< frames of the messages
    std::optional<TfFrames> tf;
    std::optional<TfChain> chain;
    size_t foreign = 0;  ///< of other frames, dropped

    /// All but the static transforms: they are not sent again.
    void Forget(const Links& fixed_links);
  };

  void ListenToPoses(const std::string& parameter, const std::string& name,
                     const std::optional<TfFrames>& tf);
  /// To `name` or, when it is empty, to what is found; `*topic` tells which.
  void Listen(const std::string& parameter, const std::string& name, std::string* topic,
              const std::vector<std::string>& types, const Read& read);
  void Subscribe(Topic* topic);
  void OnMessage(const Message& message, Topic* topic);
  /// A message of the gyroscope or the accelerometer of an IMU, or of both.
  std::string OnImu(const Message& message, size_t imu, bool is_gyro, bool is_accel);
  void OnPose(const Message& message, size_t source);
  void OnTransforms(const TfEvent& event, bool fixed);
  void AddPose(const PoseSample& recorded, const ros::Time& now, size_t source);
  /// Source of poses, with names for frames that messages leave without.
  PoseSensorInfo Named(size_t source, const std::string& world_frame,
                       const std::string& frame) const;
  /// Looks for the topics that have brought nothing; false when the master does not answer.
  bool AskMaster();

  ros::NodeHandle node_;
  const OfflineRequest request_;
  std::mutex* const mutex_;
  LiveCalibration* const live_;
  const std::function<void(const PoseSample&)> on_pose_;

  std::deque<Poses> poses_;  ///< the marker, then the pose sensors
  std::vector<ImuInfo> imus_;
  Links fixed_links_, links_;  ///< of /tf_static and of /tf, as others than this node say
  size_t resets_ = 0;          ///< of live_, to which all of this belongs

  std::deque<Topic> topics_;
  std::vector<ros::Subscriber> tf_;

  ros::SteadyTime look_start_;
  bool master_answers_ = true;
  std::future<bool> look_;  ///< AskMaster(); the last member: it uses others
};

}  // namespace imu_pose_calib
