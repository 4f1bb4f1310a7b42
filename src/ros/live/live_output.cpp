#include "imu_pose_calib/ros/live/live_output.h"

#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Path.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/CalibrationResult.h"
#include "imu_pose_calib/CalibrationStatus.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

using diagnostic_msgs::DiagnosticStatus;

/// T_WI at the pose T_WM.
geometry_msgs::PoseStamped ToImuPose(const PoseSample& pose, const Rigid3& T_MI,
                                     const std::string& world_frame) {
  const Eigen::Quaterniond q_WM = pose.q_WM.normalized();
  geometry_msgs::PoseStamped msg;
  msg.header.stamp = FromNanoseconds(pose.t_ns);
  msg.header.frame_id = world_frame;
  msg.pose.position = ToPointMsg(pose.p_WM + q_WM * T_MI.p);
  msg.pose.orientation = ToQuaternionMsg(q_WM * T_MI.q);
  return msg;
}

/// Six lines as "rotation    x [######----]  60 %".
std::vector<std::string> Bars(const Excitation& excitation) {
  std::vector<std::string> bars;
  const auto add = [&](const char* motion, const Eigen::Vector3d& shares) {
    for (int axis = 0; axis < 3; ++axis) {
      std::string bar(10, '-');
      std::fill_n(bar.begin(), static_cast<int>(std::floor(10.0 * shares[axis])), '#');
      bars.push_back(
          Format("%-11s %c [%s] %3.0f %%", motion, "xyz"[axis], bar.c_str(), 100.0 * shares[axis]));
    }
  };
  add("rotation", excitation.rotation);
  add("translation", excitation.translation);
  return bars;
}

// --- Markers ---

using visualization_msgs::Marker;
using visualization_msgs::MarkerArray;

struct Color {
  float r, g, b;
};
constexpr Color kAxisColors[] = {{0.9f, 0.2f, 0.2f}, {0.2f, 0.8f, 0.2f}, {0.3f, 0.45f, 1.0f}};
constexpr Color kWhite = {1.0f, 1.0f, 1.0f}, kGray = {0.35f, 0.35f, 0.38f};
constexpr Color kMarker = {0.6f, 0.6f, 0.65f}, kImu = {1.0f, 0.6f, 0.1f};
constexpr Color kGood = {0.3f, 0.85f, 0.35f}, kBad = {1.0f, 0.35f, 0.3f};

/// The ellipsoid of one sigma is too small to be seen.
constexpr double kSigmaScale = 200.0;
/// Older parts of the paths would hide the newer ones [s].
constexpr double kPathSpan = 8.0;
/// The panel stands beside the motion, upright, and is read against the world's y axis.
constexpr double kBarLength = 0.5, kBarHeight = 0.05, kLine = 0.08;  // [m]
/// From the motion to the first bar, and heights of that at which the whole panel is in the view.
constexpr double kPanelDistance = 0.6, kCeiling = 1.9, kFloor = 0.5;  // [m]

/// Collects markers; those of one name have consecutive ids.
class Drawing {
 public:
  Drawing(const std::string& frame, const ros::Time& stamp) {
    header_.frame_id = frame;
    header_.stamp = stamp;
    Marker clear;
    clear.header = header_;
    clear.action = Marker::DELETEALL;
    array_.markers.push_back(clear);
  }

  Marker* Add(const std::string& name, int type, const Color& color, float alpha = 1.0f) {
    Marker marker;
    marker.header = header_;
    marker.ns = name;
    marker.id = static_cast<int>(array_.markers.size());
    marker.type = type;
    marker.color.r = color.r;
    marker.color.g = color.g;
    marker.color.b = color.b;
    marker.color.a = alpha;
    marker.pose.orientation.w = 1.0;
    array_.markers.push_back(marker);
    return &array_.markers.back();
  }

  void Arrow(const std::string& name, const Eigen::Vector3d& from, const Eigen::Vector3d& to,
             double width, const Color& color) {
    Marker* marker = Add(name, Marker::ARROW, color);
    marker->points = {ToPointMsg(from), ToPointMsg(to)};
    marker->scale = ToVector3Msg({width, 2.0 * width, 0.0});
  }

  void Label(const std::string& name, const Eigen::Vector3d& at, double height,
             const std::string& text, const Color& color = kWhite) {
    Marker* marker = Add(name, Marker::TEXT_VIEW_FACING, color);
    marker->pose.position = ToPointMsg(at);
    marker->scale.z = height;
    marker->text = text;
  }

  void Frame(const std::string& name, const Rigid3& T_WX, double length) {
    for (int axis = 0; axis < 3; ++axis)
      Arrow(name, T_WX.p, T_WX.p + T_WX.q * (length * Eigen::Vector3d::Unit(axis)), 0.06 * length,
            kAxisColors[axis]);
    Label(name, T_WX.p + T_WX.q * Eigen::Vector3d(1.1 * length, 0.0, 0.0), 0.05, name);
  }

  MarkerArray Take() { return std::move(array_); }

 private:
  std_msgs::Header header_;
  MarkerArray array_;
};

Rigid3 ToRigid3(const PoseSample& pose) { return {pose.q_WM.normalized(), pose.p_WM}; }

void DrawPath(const std::string& name, const Scene& scene, const Rigid3& T_MX, const Color& color,
              Drawing* drawing) {
  std::vector<geometry_msgs::Point> points;
  for (const PoseSample& pose : scene.path)
    if (1e-9 * static_cast<double>(scene.path.back().t_ns - pose.t_ns) < kPathSpan)
      points.push_back(ToPointMsg((ToRigid3(pose) * T_MX).p));
  if (points.size() < 2) return;  // rviz takes no shorter line
  Marker* line = drawing->Add(name, Marker::LINE_STRIP, color, 0.8f);
  line->scale.x = 0.004;
  line->points = points;
}

/// The lever arm of an IMU and the ellipsoid of its sigma, which lies along the marker axes.
void DrawLeverArm(const ImuCalibration& imu, const Rigid3& T_WM, Drawing* drawing) {
  const Rigid3 T_WI = T_WM * imu.T_MI;
  Marker* arm = drawing->Add("lever arm", Marker::LINE_LIST, kImu);
  arm->scale.x = 0.006;
  arm->points = {ToPointMsg(T_WM.p), ToPointMsg(T_WI.p)};

  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(
      Eigen::Matrix3d(imu.covariance.topLeftCorner<3, 3>()));
  Eigen::Matrix3d axes = eigen.eigenvectors();
  if (axes.determinant() < 0.0) axes.col(0) *= -1.0;
  const Eigen::Vector3d size = 2.0 * kSigmaScale * eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt();
  Marker* ellipsoid = drawing->Add("sigma", Marker::SPHERE, kImu, 0.35f);
  ellipsoid->pose.position = ToPointMsg(T_WI.p);
  ellipsoid->pose.orientation = ToQuaternionMsg(T_WM.q * Eigen::Quaterniond(axes));
  ellipsoid->scale = ToVector3Msg(size);
}

void DrawBar(const std::string& label, double share, const Color& color,
             const Eigen::Vector3d& left, Drawing* drawing) {
  const double filled = std::max(0.002, share * kBarLength);
  const auto box = [&](double from, double length, double depth, const Color& c, float alpha) {
    Marker* marker = drawing->Add("bars", Marker::CUBE, c, alpha);
    marker->pose.position = ToPointMsg(left + Eigen::Vector3d(from + 0.5 * length, 0.0, 0.0));
    marker->scale = ToVector3Msg({length, depth, kBarHeight});
  };
  box(0.0, filled, 0.02, color, 1.0f);
  box(filled, kBarLength - filled + 0.001, 0.01, kGray, 0.6f);
  drawing->Label("bars", left - Eigen::Vector3d(0.13, 0.0, 0.0), 0.06, label);
}

/// `text` in lines of at most 48 characters.
std::string InLines(const std::string& text) {
  std::string wrapped;
  size_t column = 0, begin = 0;
  while (begin < text.size()) {
    const size_t end = std::min(text.find(' ', begin), text.size());
    if (column > 0) {
      const bool fits = column + 1 + end - begin <= 48;
      wrapped += fits ? ' ' : '\n';
      column = fits ? column + 1 : 0;
    }
    wrapped += text.substr(begin, end - begin);
    column += end - begin;
    begin = end + 1;
  }
  return wrapped;
}

/// Where the first bar goes: above the poses or, where the view of rviz/calibration.rviz would not
/// show it any more, below them.
Eigen::Vector3d PanelPosition(const std::deque<PoseSample>& path) {
  Eigen::AlignedBox3d box(Eigen::Vector3d::Zero());
  if (!path.empty()) box.setEmpty();
  for (const PoseSample& pose : path) box.extend(pose.p_WM);
  Eigen::Vector3d position = box.center();
  position.z() = box.max().z() + kPanelDistance;
  if (position.z() > kCeiling) position.z() = std::max(box.min().z() - kPanelDistance, kFloor);
  return position;
}

/// Bars, verdict and result, `middle` being that of the first bar.
void DrawPanel(const Scene& scene, const Eigen::Vector3d& middle, Drawing* drawing) {
  constexpr const char* kAxes[] = {"x", "y", "z"};
  Eigen::Vector3d left = middle - Eigen::Vector3d(0.5 * kBarLength, 0.0, 0.0);
  const auto bars = [&](const std::string& motion, const Eigen::Vector3d& shares) {
    for (int axis = 0; axis < 3; ++axis) {
      DrawBar(motion + kAxes[axis], shares[axis], kAxisColors[axis], left, drawing);
      left.z() -= kLine;
    }
    left.z() -= 0.4 * kLine;
  };
  bars("turn ", scene.status.excitation.rotation);
  bars("move ", scene.status.excitation.translation);

  const Phase phase = scene.status.phase;
  const bool is_good = phase == Phase::kConverged || phase == Phase::kSaved;
  const bool is_bad = phase == Phase::kDegraded || phase == Phase::kWaiting;
  drawing->Label("verdict", middle + Eigen::Vector3d(0.0, 0.0, 4.6 * kLine), 0.12, ToString(phase),
                 is_good  ? kGood
                 : is_bad ? kBad
                          : kWhite);
  drawing->Label("verdict", middle + Eigen::Vector3d(0.0, 0.0, 2.2 * kLine), 0.05,
                 InLines(scene.status.message));
  if (!scene.result) return;
  drawing->Label("verdict", middle + Eigen::Vector3d(1.4 * kBarLength, 0.0, -2.5 * kLine), 0.06,
                 Format("p = [%s] mm\ntime shift = %.4f s\nellipsoid: sigma x %.0f",
                        List(1e3 * scene.result->imus[0].T_MI.p, "%.1f").c_str(),
                        scene.result->sessions[0].imus[0].time_shift, kSigmaScale),
                 kImu);
}

}  // namespace

MarkerArray Draw(const Scene& scene, const ros::Time& stamp) {
  Drawing drawing(scene.world_frame, stamp);
  drawing.Frame("world", Rigid3(), 0.3);
  DrawPanel(scene, PanelPosition(scene.path), &drawing);
  if (!scene.pose) return drawing.Take();

  const Rigid3 T_WM = ToRigid3(*scene.pose);
  drawing.Frame("marker", T_WM, 0.2);
  DrawPath("marker path", scene, Rigid3(), kMarker, &drawing);
  if (!scene.result) return drawing.Take();
  for (const ImuCalibration& imu : scene.result->imus) {
    drawing.Frame("imu", T_WM * imu.T_MI, 0.12);
    DrawPath("imu path", scene, imu.T_MI, kImu, &drawing);
    DrawLeverArm(imu, T_WM, &drawing);
  }
  const Eigen::Vector3d top = T_WM.p + Eigen::Vector3d(-0.3, 0.0, 0.0);
  drawing.Arrow("gravity", top, top + 0.03 * scene.result->sessions[0].g_W, 0.012, kWhite);
  drawing.Label("gravity", top, 0.04, "gravity");
  return drawing.Take();
}

LiveOutput::LiveOutput(const ros::NodeHandle& node, const LiveCalibration* live)
    : node_(node), live_(live), diagnostics_(ros::NodeHandle(), node) {
  status_publisher_ = node_.advertise<CalibrationStatus>("status", 10);
  result_publisher_ = node_.advertise<CalibrationResult>("result", 1, true);
  pose_publisher_ = node_.advertise<geometry_msgs::PoseStamped>("imu_pose", 100);
  path_publisher_ = node_.advertise<nav_msgs::Path>("imu_path", 1);
  marker_publisher_ = node_.advertise<MarkerArray>("markers", 1);
  diagnostics_.setHardwareID("none");
  diagnostics_.add("calibration", this, &LiveOutput::Diagnose);
}

void LiveOutput::PublishStatus(const LiveView& view) {
  const LiveStatus& status = view.status;
  CalibrationStatus msg;
  msg.header.stamp = view.stamp;
  msg.phase = static_cast<uint8_t>(status.phase);
  msg.phase_text = ToString(status.phase);
  msg.message = status.message;
  msg.buffered =
      std::min({status.poses.buffered_s, status.gyro.buffered_s, status.accel.buffered_s});
  msg.pose_rate = status.poses.rate_hz;
  msg.gyro_rate = status.gyro.rate_hz;
  msg.accel_rate = status.accel.rate_hz;
  msg.pose_count = status.poses.received;
  msg.gyro_count = status.gyro.received;
  msg.accel_count = status.accel.received;
  msg.rotation_excitation = ToVector3Msg(status.excitation.rotation);
  msg.translation_excitation = ToVector3Msg(status.excitation.translation);
  msg.bars = Bars(status.excitation);
  msg.solves = static_cast<uint32_t>(status.solves);
  msg.solve_time = view.solve_time;
  if (live_->result()) {
    const LargestStd std_dev = MaxStd(*live_->result());
    msg.rotation_std = std_dev.rotation;
    msg.translation_std = std_dev.translation;
    msg.time_shift_std = std_dev.time_shift;
    msg.warnings = live_->result()->warnings;
  }
  status_publisher_.publish(msg);
}

void LiveOutput::PublishDiagnostics(const LiveStatus& status) {
  diagnosed_ = status;
  diagnostics_.force_update();
}

void LiveOutput::Diagnose(diagnostic_updater::DiagnosticStatusWrapper& wrapper) {
  const bool bad = diagnosed_.phase == Phase::kWaiting || diagnosed_.phase == Phase::kDegraded;
  wrapper.summary(bad ? DiagnosticStatus::WARN : DiagnosticStatus::OK,
                  std::string(ToString(diagnosed_.phase)) + ": " + diagnosed_.message);
  const auto stream = [&](const std::string& name, const StreamStatus& status) {
    wrapper.addf(name + " rate", "%.1f Hz", status.rate_hz);
    wrapper.addf(name + " delay", "%.4f s", status.delay_s);
    wrapper.add(name + " received", status.received);
  };
  stream("pose", diagnosed_.poses);
  stream("gyro", diagnosed_.gyro);
  stream("accel", diagnosed_.accel);
  wrapper.add("verdict", live_->result() ? live_->result()->message : "none yet");
  if (!live_->result()) return;
  for (const std::string& warning : live_->result()->warnings) wrapper.add("warning", warning);
}

void LiveOutput::PublishMarkers(const LiveView& view) {
  if (marker_publisher_.getNumSubscribers() == 0) return;
  const Scene scene{view.info.world_frame, view.status,
                    live_->result() ? &*live_->result() : nullptr,
                    live_->pose() ? &*live_->pose() : nullptr, live_->path()};
  marker_publisher_.publish(Draw(scene, view.stamp));
}

void LiveOutput::PublishPath(const LiveView& view) {
  if (!live_->result() || path_publisher_.getNumSubscribers() == 0) return;
  nav_msgs::Path path;
  path.header.stamp = view.stamp;
  path.header.frame_id = view.info.world_frame;
  for (const PoseSample& pose : live_->path())
    path.poses.push_back(ToImuPose(pose, live_->result()->imus[0].T_MI, view.info.world_frame));
  path_publisher_.publish(path);
}

void LiveOutput::PublishPose(const PoseSample& pose, const RecordingInfo& info) {
  if (!live_->result() || pose_publisher_.getNumSubscribers() == 0) return;
  pose_publisher_.publish(ToImuPose(pose, live_->result()->imus[0].T_MI, info.world_frame));
}

void LiveOutput::PublishResult(const RecordingInfo& info, const std::string& foreign_frame,
                               const std::string& other_parent) {
  const ros::Time now = ros::Time::now();
  result_publisher_.publish(ToMsg(*live_->result(), info, now));
  std::vector<geometry_msgs::TransformStamped> transforms;
  for (const auto& transform : ToTransforms(*live_->result(), info, now)) {
    if (transform.child_frame_id != info.marker_frame) {
      transforms.push_back(transform);
      continue;
    }
    ROS_ERROR(
        "No transform is published: the marker and the imu frame are both called '%s'; set "
        "marker_frame or imu_frame",
        info.marker_frame.c_str());
  }
  broadcaster_.sendTransform(transforms);
  if (!other_parent.empty())
    ROS_WARN("tf has two parents of '%s': '%s' from elsewhere and '%s' from here; set imu_frame",
             foreign_frame.c_str(), other_parent.c_str(), info.marker_frame.c_str());
}

}  // namespace imu_pose_calib
