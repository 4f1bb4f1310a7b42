#include "imu_pose_calib/ros/live/markers.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <utility>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

using visualization_msgs::Marker;
using visualization_msgs::MarkerArray;

struct Color {
  float r, g, b, a = 1.0f;
};
constexpr Color kAxisColors[] = {{0.9f, 0.2f, 0.2f}, {0.2f, 0.8f, 0.2f}, {0.3f, 0.45f, 1.0f}};
constexpr Color kWhite = {1.0f, 1.0f, 1.0f}, kGray = {0.35f, 0.35f, 0.38f, 0.6f};
constexpr Color kMarker = {0.6f, 0.6f, 0.65f, 0.8f}, kImu = {1.0f, 0.6f, 0.1f};
constexpr Color kImuPath = {kImu.r, kImu.g, kImu.b, 0.8f};
constexpr Color kSigma = {kImu.r, kImu.g, kImu.b, 0.35f};
constexpr Color kGood = {0.3f, 0.85f, 0.35f}, kBad = {1.0f, 0.35f, 0.3f};
/// By the constants of CalibrationStatus: waiting, collecting, solving, converged, degraded, saved.
constexpr Color kPhaseColors[] = {kBad, kWhite, kWhite, kGood, kBad, kGood};

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
  explicit Drawing(const std_msgs::Header& header) : header_(header) {
    Marker clear;
    clear.header = header_;
    clear.action = Marker::DELETEALL;
    array_.markers.push_back(clear);
  }

  Marker* Add(const std::string& name, int type, const Color& color, const Eigen::Vector3d& scale,
              const Rigid3& T_WX = {}) {
    Marker marker;
    marker.header = header_;
    marker.ns = name;
    marker.id = static_cast<int>(array_.markers.size());
    marker.type = type;
    marker.color.r = color.r;
    marker.color.g = color.g;
    marker.color.b = color.b;
    marker.color.a = color.a;
    marker.scale = ToVector3Msg(scale);
    marker.pose = ToPoseMsg(T_WX);
    array_.markers.push_back(marker);
    return &array_.markers.back();
  }

  void Arrow(const std::string& name, const Eigen::Vector3d& from, const Eigen::Vector3d& to,
             double width, const Color& color) {
    Add(name, Marker::ARROW, color, {width, 2.0 * width, 0.0})->points = {ToPointMsg(from),
                                                                          ToPointMsg(to)};
  }

  void Label(const std::string& name, const Eigen::Vector3d& at, double height,
             const std::string& text, const Color& color = kWhite) {
    Add(name, Marker::TEXT_VIEW_FACING, color, {0.0, 0.0, height},
        {Eigen::Quaterniond::Identity(), at})
        ->text = text;
  }

  void Frame(const std::string& name, const Rigid3& T_WX, double length) {
    for (int axis = 0; axis < 3; ++axis)
      Arrow(name, T_WX.p, T_WX.p + T_WX.q * (length * Eigen::Vector3d::Unit(axis)), 0.06 * length,
            kAxisColors[axis]);
    Label(name, T_WX.p + T_WX.q * Eigen::Vector3d(1.1 * length, 0.0, 0.0), 0.05, name);
  }

  MarkerArray Take() { return std::move(array_); }

 private:
  const std_msgs::Header header_;
  MarkerArray array_;
};

Rigid3 ToRigid3(const PoseSample& pose) { return {pose.q_WM.normalized(), pose.p_WM}; }

void DrawPath(const std::string& name, const std::deque<PoseSample>& path, const Rigid3& T_MX,
              const Color& color, Drawing* drawing) {
  std::vector<geometry_msgs::Point> points;
  for (const PoseSample& pose : path)
    if (Seconds(path.back().t_ns - pose.t_ns) < kPathSpan)
      points.push_back(ToPointMsg((ToRigid3(pose) * T_MX).p));
  if (points.size() < 2) return;  // rviz takes no shorter line
  drawing->Add(name, Marker::LINE_STRIP, color, {0.004, 0.0, 0.0})->points = points;
}

/// The lever arm of an IMU and the ellipsoid of its sigma, which lies along the marker axes.
void DrawLeverArm(const ImuCalibration& imu, const Rigid3& T_WM, Drawing* drawing) {
  const Eigen::Vector3d p_WI = (T_WM * imu.T_MI).p;
  drawing->Add("lever arm", Marker::LINE_LIST, kImu, {0.006, 0.0, 0.0})->points = {
      ToPointMsg(T_WM.p), ToPointMsg(p_WI)};

  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(
      Eigen::Matrix3d(imu.covariance.topLeftCorner<3, 3>()));
  Eigen::Matrix3d axes = eigen.eigenvectors();
  if (axes.determinant() < 0.0) axes.col(0) *= -1.0;
  drawing->Add("sigma", Marker::SPHERE, kSigma,
               2.0 * kSigmaScale * eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt(),
               {T_WM.q * Eigen::Quaterniond(axes), p_WI});
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

/// Bars, verdict and result.
void DrawPanel(const LiveCalibration& live, const CalibrationStatus& status, Drawing* drawing) {
  const Eigen::Vector3d middle = PanelPosition(live.path());  // of the first bar
  const Vector6d shares = live.Excitation();
  for (int i = 0; i < 6; ++i) {
    const Eigen::Vector3d left =
        middle - Eigen::Vector3d(0.5 * kBarLength, 0.0, (i < 3 ? i : i + 0.4) * kLine);
    const double filled = std::max(0.002, shares[i] * kBarLength);
    const auto box = [&](double from, double length, double depth, const Color& color) {
      drawing->Add(
          "bars", Marker::CUBE, color, {length, depth, kBarHeight},
          {Eigen::Quaterniond::Identity(), left + Eigen::Vector3d(from + 0.5 * length, 0.0, 0.0)});
    };
    box(0.0, filled, 0.02, kAxisColors[i % 3]);
    box(filled, kBarLength - filled + 0.001, 0.01, kGray);
    drawing->Label("bars", left - Eigen::Vector3d(0.13, 0.0, 0.0), 0.06,
                   Format("%s %c", i < 3 ? "turn" : "move", "xyz"[i % 3]));
  }

  const auto above = [&](double x, double z) -> Eigen::Vector3d {
    return middle + Eigen::Vector3d(x, 0.0, z);
  };
  drawing->Label("verdict", above(0.0, 4.6 * kLine), 0.12, status.phase_text,
                 kPhaseColors[status.phase]);
  std::string message = Wrap("", status.message, 48);
  message.pop_back();  // the end of the last line
  drawing->Label("verdict", above(0.0, 2.2 * kLine), 0.05, message);
  if (!live.result()) return;
  drawing->Label("verdict", above(1.4 * kBarLength, -2.5 * kLine), 0.06,
                 Format("p = [%s] mm\ntime shift = %.4f s\nellipsoid: sigma x %.0f",
                        List(1e3 * live.result()->imus[0].T_MI.p, "%.1f").c_str(),
                        live.result()->sessions[0].imus[0].time_shift, kSigmaScale),
                 kImu);
}

}  // namespace

MarkerArray Draw(const LiveCalibration& live, const CalibrationStatus& status,
                 const std::string& world_frame) {
  const auto& result = live.result();
  Drawing drawing(MakeHeader(status.header.stamp, world_frame));
  drawing.Frame("world", Rigid3(), 0.3);
  DrawPanel(live, status, &drawing);
  if (!live.pose()) return drawing.Take();

  const Rigid3 T_WM = ToRigid3(*live.pose());
  drawing.Frame("marker", T_WM, 0.2);
  DrawPath("marker path", live.path(), Rigid3(), kMarker, &drawing);
  if (!result) return drawing.Take();
  for (const ImuCalibration& imu : result->imus) {
    drawing.Frame("imu", T_WM * imu.T_MI, 0.12);
    DrawPath("imu path", live.path(), imu.T_MI, kImuPath, &drawing);
    DrawLeverArm(imu, T_WM, &drawing);
  }
  const Eigen::Vector3d top = T_WM.p + Eigen::Vector3d(-0.3, 0.0, 0.0);
  drawing.Arrow("gravity", top, top + 0.03 * result->sessions[0].g_W, 0.012, kWhite);
  drawing.Label("gravity", top, 0.04, "gravity");
  return drawing.Take();
}

}  // namespace imu_pose_calib
