// CSV of motion capture systems, written here from the layouts of their exports.

#include <boost/algorithm/string/replace.hpp>
#include <cmath>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/text_table.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

constexpr double kDegrees = 180.0 / M_PI;

std::string Motive(const std::string& rotation, const std::string& units) {
  const std::string w = rotation == "Quaternion" ? "W," : "";
  const auto row = [&](const char* name, const char* rig, const char* wand, const char* marker) {
    std::string text = std::string(",") + name;
    for (const char* cell : {rig, wand})
      for (int k = 0; k < (w.empty() ? 6 : 7); ++k) text += std::string(",") + cell;
    return text + "," + marker + "," + marker + "," + marker + "\n";
  };
  std::string kinds = ",", axes = "Frame,Time (Seconds)";
  for (int body = 0; body < 2; ++body) {
    kinds += ",Rotation,Rotation,Rotation" + std::string(w.empty() ? "" : ",Rotation") +
             ",Position,Position,Position";
    axes += ",X,Y,Z," + w + "X,Y,Z";
  }
  return "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,120.000000,Export Frame Rate,"
         "120.000000,Capture Start Time,2024-05-31 01.02.03.456 PM,Total Frames in Take,3,"
         "Rotation Type," +
         rotation + ",Length Units," + units + ",Coordinate Space,Global\n\n" +
         row("Type", "Rigid Body", "Rigid Body", "Rigid Body Marker") +
         row("Name", "rig", "wand", "rig:Marker1") + row("ID", "\"A1\"", "B2", "C3") + kinds +
         ",Position,Position,Position\n" + axes + ",X,Y,Z\n";
}

std::string Quaternions() {
  return Motive("Quaternion", "Millimeters") +
         "0,0.000000,0,0,0.6,0.8,1000,2000,-3000,1,0,0,0,1,2,3,9,9,9\r\n"
         "1,0.008333,,,,,,,,1,0,0,0,1,2,3,9,9,9\r\n"
         "2,0.016667,0,0.6,0,0.8,1000,2000,-2500,,,,,,,,9,9,9\r\n";
}

MocapPoses Read(const std::string& text, const std::string& body) {
  std::istringstream in(text);
  return ReadMocapCsv(in, "x.csv", body).value();
}

void ExpectRefusal(const std::string& text, const std::string& body,
                   const std::vector<std::string>& parts) {
  std::istringstream in(text);
  ExpectError<InputError>([&] { ReadMocapCsv(in, "x.csv", body); }, parts);
}

/// The text with one part replaced, which must be there.
std::string With(const std::string& text, const std::string& part, const std::string& other) {
  EXPECT_TRUE(Contains(text, part)) << part;
  return boost::replace_first_copy(text, part, other);
}

TEST(MotiveTest, ReadsABodyByName) {
  const MocapPoses rig = Read(Quaternions(), "rig");
  EXPECT_EQ(rig.body, "rig");
  ASSERT_EQ(rig.poses.size(), 2u);  // the row where it was not seen is a gap
  // date -u -d "2024-05-31 13:02:03.456" +%s.%3N
  EXPECT_EQ(rig.poses[0].t_ns, 1717160523456'000'000);
  EXPECT_EQ(rig.poses[1].t_ns, 1717160523456'000'000 + 16'667'000);
  EXPECT_EQ(rig.poses[0].p_WM, Eigen::Vector3d(1.0, 2.0, -3.0));
  EXPECT_EQ(rig.poses[1].p_WM, Eigen::Vector3d(1.0, 2.0, -2.5));
  EXPECT_EQ(rig.poses[1].q_WM.coeffs(), Eigen::Vector4d(0.0, 0.6, 0.0, 0.8));
  EXPECT_EQ(Read(Quaternions(), "wand").poses.size(), 2u);
  EXPECT_EQ(Read(Quaternions(), "wand").poses[1].p_WM, Eigen::Vector3d(1e-3, 2e-3, 3e-3));
}

TEST(MotiveTest, TakesUnitsAndStartFromTheHeader) {
  const std::string text = Quaternions();
  const auto x = [&](const std::string& units) {
    return Read(With(text, "Millimeters", units), "rig").poses[0].p_WM.x();
  };
  EXPECT_EQ(x("Meters"), 1000.0);
  EXPECT_EQ(x("Centimeters"), 10.0);
  EXPECT_EQ(x("Millimeters"), 1.0);
  const auto start = [&](const std::string& time) {
    return Read(With(text, "2024-05-31 01.02.03.456 PM", time), "rig").poses[0].t_ns;
  };
  EXPECT_EQ(start("1970-01-02 12.00.01.000 AM"), 86401'000'000'000);
  EXPECT_EQ(start("1970-01-02 12.00.00.250 PM"), 129600'250'000'000);
  EXPECT_EQ(start("1970-01-02 13.00.00.000"), 133200'000'000'000);
  EXPECT_EQ(start(""), 0);
}

/// Rotation matrix about an axis of x, y, z.
Eigen::Matrix3d About(int axis, double degrees) {
  const double c = std::cos(degrees / kDegrees), s = std::sin(degrees / kDegrees);
  const int j = (axis + 1) % 3, k = (axis + 2) % 3;
  Eigen::Matrix3d R = Eigen::Matrix3d::Identity();
  R(j, j) = R(k, k) = c;
  R(k, j) = s;
  R(j, k) = -s;
  return R;
}

TEST(MotiveTest, EulerAnglesTurnAboutAxesThatTurnAlong) {
  const std::string values = "0,0.0,10,20,30,1,2,3,1,2,3,4,5,6,9,9,9\n";
  const Eigen::Matrix3d X = About(0, 10), Y = About(1, 20), Z = About(2, 30);
  for (const auto& [order, R] : {std::pair<std::string, Eigen::Matrix3d>{"XYZ", X * Y * Z},
                                 {"ZYX", Z * Y * X},
                                 {"YXZ", Y * X * Z}}) {
    const PoseSample pose = Read(Motive(order, "Meters") + values, "rig").poses[0];
    EXPECT_TRUE(pose.q_WM.toRotationMatrix().isApprox(R, 1e-12)) << order;
    EXPECT_EQ(pose.p_WM, Eigen::Vector3d(1, 2, 3));
  }
}

TEST(MotiveTest, RefusesNamingThePlace) {
  const std::string text = Quaternions();
  ExpectRefusal(text, "", {"'x.csv'", "several bodies: rig, wand; choose with body"});
  ExpectRefusal(text, "drone", {"no body 'drone'; it has: rig, wand"});
  ExpectRefusal(With(text, "-3000", "oops"), "rig",
                {"line 8 column 9 is 'oops', must be a number"});
  ExpectRefusal(With(text, "0.016667,0,", "0.016667,,"), "rig", {"line 10 column 3 is empty"});
  ExpectRefusal(With(text, "0.008333", "x"), "rig", {"line 9 column 2 is 'x'"});
  ExpectRefusal(With(text, "Millimeters", "Feet"), "rig", {"line 1", "Length Units 'Feet'"});
  ExpectRefusal(With(text, "Global", "Local"), "rig", {"line 1", "Coordinate Space 'Local'"});
  ExpectRefusal(With(text, "Quaternion", "Matrix"), "rig", {"Rotation Type is 'Matrix'"});
  ExpectRefusal(With(text, "-05-31", "-13-31"), "rig", {"Capture Start Time", "must be like"});
  ExpectRefusal(With(text, "01.02.03", "01.72.03"), "rig", {"Capture Start Time"});
  ExpectRefusal(With(text, ",X,Y,Z,W,X", ",X,Y,Q,W,X"), "rig", {"line 7", "XYZW of the Rotation"});
  ExpectRefusal(With(text, "Frame,Time", "Frames,Time"), "rig", {"no row that begins with Frame"});
  ExpectRefusal(With(text, ",Name,", ",Nom,"), "rig", {"no row of Name"});
  ExpectRefusal(Motive("Quaternion", "Meters"), "rig", {"holds no pose of 'rig'"});
}

/// A Vicon export with trajectories before the segments.
std::string Vicon(const std::string& axes, const std::string& units, const std::string& rows) {
  const int width = Contains(axes, "RW") ? 7 : 6;
  return "Trajectories\n100\n,,m1,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n1,0,1,2,3\n\n"
         "Segments\n200\n,,Global Angle rig:rig" +
         std::string(static_cast<size_t>(width), ',') + "arm:hand\nFrame,Sub Frame," + axes + "," +
         axes + "\n,," + units + "," + units + "\n" + rows + "\n";
}

TEST(ViconTest, ReadsHelicalAngles) {
  const std::string text = Vicon("RX,RY,RZ,TX,TY,TZ", "deg,deg,deg,mm,mm,mm",
                                 "1,0,0,0,90,1000,2000,3000,0,0,0,0,0,0\n2,0,,,,,,,0,0,0,4,5,6\n"
                                 "3,0,60,60,60,1000,2000,3000,0,0,0,0,0,0\n");
  const MocapPoses rig = Read(text, "rig");
  EXPECT_EQ(rig.body, "rig");
  ASSERT_EQ(rig.poses.size(), 2u);
  EXPECT_EQ(rig.poses[0].t_ns, 5'000'000);
  EXPECT_EQ(rig.poses[1].t_ns, 15'000'000);
  EXPECT_EQ(rig.poses[0].p_WM, Eigen::Vector3d(1, 2, 3));
  EXPECT_TRUE(rig.poses[0].q_WM.toRotationMatrix().isApprox(About(2, 90), 1e-12));
  // About the diagonal by 60 sqrt(3) degrees.
  const double half = 30.0 * std::sqrt(3.0) / kDegrees;
  EXPECT_NEAR(rig.poses[1].q_WM.w(), std::cos(half), 1e-12);
  EXPECT_NEAR(rig.poses[1].q_WM.y(), std::sin(half) / std::sqrt(3.0), 1e-12);
  EXPECT_EQ(Read(text, "arm:hand").poses.size(), 3u);
  const std::string rad = boost::replace_all_copy(text, "deg", "rad");
  EXPECT_NEAR(Read(rad, "rig").poses[0].q_WM.w(), std::cos(45.0), 1e-12);
  ExpectRefusal(text, "", {"several bodies: arm:hand, rig; choose with body"});
}

TEST(ViconTest, ReadsQuaternions) {
  const std::string rows = "7,0,0,0,0.6,0.8,10,20,30,0,0,0,1,0,0,0\n";
  const std::string text = boost::replace_first_copy(
      Vicon("RX,RY,RZ,RW,TX,TY,TZ", ",,,,m,m,m", rows), "Segments", "Objects");
  const PoseSample pose = Read(text, "rig:rig").poses.at(0);
  EXPECT_EQ(pose.q_WM.coeffs(), Eigen::Vector4d(0.0, 0.0, 0.6, 0.8));
  EXPECT_EQ(pose.p_WM, Eigen::Vector3d(10, 20, 30));
  EXPECT_EQ(pose.t_ns, 35'000'000);
}

TEST(ViconTest, RefusesNamingThePlace) {
  const std::string text =
      Vicon("RX,RY,RZ,TX,TY,TZ", "deg,deg,deg,mm,mm,mm", "1,0,0,0,0,1,2,3,0,0,0,0,0,0\n");
  ExpectRefusal(With(text, "Segments\n200", "Segments\nfast"), "rig",
                {"line 9 column 1 is 'fast'"});
  ExpectRefusal(With(text, "Segments", "Other"), "rig", {"no part Segments or Objects"});
  ExpectRefusal(With(text, "1,0,0,0,0,1,2,3", "1,0,0,0,0,1,two,3"), "rig",
                {"line 13 column 7 is 'two', must be a number"});
  ExpectRefusal(With(text, "1,0,0,0,0,1,2,3", "1,4,0,0,0,1,2,3"), "rig", {"column 2 is '4'"});
  ExpectRefusal(With(text, "deg,deg,deg,mm", "grad,deg,deg,mm"), "rig", {"line 12", "'grad'"});
  ExpectRefusal(With(text, "deg,mm,mm,mm", "deg,inch,mm,mm"), "rig", {"line 12", "'inch'"});
  ExpectRefusal(With(text, "RX,RY,RZ", "RX,RQ,RZ"), "rig", {"line 12", "no column RY"});
  ExpectRefusal("Segments\n200\n", "", {"ends before the names of the bodies"});
}

class MocapFileTest : public TempDirTest {};

/// Poses of the simulator in a world whose y axis is up, exported by Motive.
TEST_F(MocapFileTest, CalibratesFromAWorldWithYUp) {
  SimulatorOptions options;
  options.duration_s = 10.0;
  const SessionData data = Simulate(options);
  WriteTables(Path("x"), data, false);
  // x and z as they are turned by -90 degrees about x: z_W becomes y.
  const Eigen::Quaterniond q_YZ(Eigen::AngleAxisd(-M_PI / 2, Eigen::Vector3d::UnitX()));
  std::ofstream file(Path("take.csv"));
  file << Motive("Quaternion", "Millimeters");
  file.precision(17);
  for (size_t k = 0; k < data.poses.size(); ++k) {
    const Eigen::Quaterniond q = q_YZ * data.poses[k].q_WM;
    const Eigen::Vector3d p = 1e3 * (q_YZ * data.poses[k].p_WM);
    file << k << "," << 1e-9 * static_cast<double>(data.poses[k].t_ns - data.poses[0].t_ns) << ","
         << q.x() << "," << q.y() << "," << q.z() << "," << q.w() << "," << p.x() << "," << p.y()
         << "," << p.z() << ",,,,,,,,9,9,9\n";
  }
  file.close();
  RecordingRequest request;
  request.poses = Path("x.poses.txt");
  request.imu = Path("x.imu.csv");
  const Calibration expected = Calibrate(CalibrationOptions(), ReadText(request).data);
  request.poses = Path("take.csv");
  ExpectError<InputError>([&] { ReadText(request); }, {"rig, wand; choose with body"});
  request.body = "rig";
  const Recording recording = ReadText(request);
  EXPECT_EQ(recording.info.marker_frame, "rig");
  const Calibration turned = Calibrate(CalibrationOptions(), recording.data);
  const Rigid3 &a = expected.imus[0].T_MI, &b = turned.imus[0].T_MI;
  EXPECT_LT((a.p - b.p).norm(), 1e-5);
  EXPECT_LT(a.q.angularDistance(b.q), 1e-6);
  const Eigen::Vector3d g_Y = turned.sessions[0].g_W;
  EXPECT_LT((q_YZ * expected.sessions[0].g_W - g_Y).norm(), 1e-4);
  EXPECT_LT(g_Y.y(), -9.7);
  const double start = 1717160523.456 - 1e-9 * static_cast<double>(data.poses[0].t_ns);
  EXPECT_NEAR(turned.sessions[0].imus[0].time_shift,
              expected.sessions[0].imus[0].time_shift + start, 1e-5);

  request.poses = Path("x.poses.txt");
  ExpectError<InputError>([&] { ReadText(request); },
                          {"body 'rig' is given", "no CSV of Motive or Vicon"});
}

}  // namespace
}  // namespace imu_pose_calib
