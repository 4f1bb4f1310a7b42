#include "imu_pose_calib/ros/live/topic_source.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>

namespace imu_pose_calib {
namespace {

/// Types without their packages.
std::string ShortNames(std::vector<std::string> types) {
  for (std::string& type : types) type.erase(0, type.find('/') + 1);
  return boost::join(types, ", ");
}

/// What nodes of this package publish is no input.
bool IsOurs(const std::string& topic) { return boost::algorithm::ends_with(topic, "/imu_pose"); }

}  // namespace

TopicSource::TopicSource(const ros::NodeHandle& node, const std::string& parameter,
                         const std::string& topic, const std::vector<std::string>& types,
                         const Callback& callback)
    : node_(node),
      parameter_(parameter),
      is_named_(!topic.empty()),
      types_(types),
      callback_(callback) {
  if (is_named_) Subscribe(ros::names::resolve(topic));
}

void TopicSource::Subscribe(const std::string& topic) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    topic_ = topic;
  }
  subscriber_ = node_.subscribe<topic_tools::ShapeShifter>(
      topic,
      0,  // a queue without bound
      Callback([this](const Message& message) { OnMessage(message); }), ros::VoidConstPtr(),
      ros::TransportHints().tcpNoDelay());
}

void TopicSource::OnMessage(const Message& message) {
  const std::string& type = message.getMessage()->getDataType();
  std::string problem;
  if (Accepts(type)) {
    try {
      callback_(message);
      ++count_;
      return;
    } catch (const ros::Exception& error) {
      problem = "has another definition of " + type + " than this computer (" + error.what() + ")";
    }
  } else {
    problem = "is " + type + ", must be " + boost::join(types_, " or ");
  }
  const std::lock_guard<std::mutex> lock(mutex_);
  problem_ = problem;
}

bool TopicSource::Accepts(const std::string& type) const {
  return std::find(types_.begin(), types_.end(), type) != types_.end();
}

std::string TopicSource::topic() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return topic_;
}

std::string TopicSource::State() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return state_;
}

void TopicSource::Look(const ros::master::V_TopicInfo& published) {
  std::string state;
  if (!is_named_ && count_ == 0) {
    const std::string found = Find(published, &state);
    if (!found.empty() && found != topic()) Subscribe(found);
  }
  if (state.empty()) state = Inspect(published);
  const std::lock_guard<std::mutex> lock(mutex_);
  state_ = state;
}

std::string TopicSource::Find(const ros::master::V_TopicInfo& published, std::string* state) const {
  std::vector<std::string> found;
  for (const ros::master::TopicInfo& info : published)
    if (Accepts(info.datatype) && !IsOurs(info.name)) found.push_back(info.name);
  if (found.size() == 1) return found.front();
  const std::string types = boost::join(types_, " or ");
  *state = found.empty() ? "no topic of type " + types + " is published"
                         : "several topics of type " + types + ": " + boost::join(found, ", ") +
                               "; choose with " + parameter_;
  return "";
}

std::string TopicSource::Inspect(const ros::master::V_TopicInfo& published) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!problem_.empty()) return topic_ + " " + problem_;
  const auto info = std::find_if(published.begin(), published.end(),
                                 [&](const auto& candidate) { return candidate.name == topic_; });
  const int seconds = static_cast<int>((ros::SteadyTime::now() - start_).toSec());
  const std::string waited = " for " + std::to_string(seconds) + " s";
  if (info == published.end())
    return topic_ + " (" + ShortNames(types_) + "): nobody has published it" + waited;
  if (!Accepts(info->datatype))
    return topic_ + " is " + info->datatype + ", must be " + boost::join(types_, " or ");
  return topic_ + " (" + info->datatype +
         ", publishers connected: " + std::to_string(subscriber_.getNumPublishers()) +
         "): no message" + waited;
}

}  // namespace imu_pose_calib
