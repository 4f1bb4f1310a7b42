#include <cmath>
#include <limits>

#include "imu_pose_calib/ros/io/text_table.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

std::vector<PoseSample> Poses(const std::string& text) {
  std::istringstream in(text);
  return ReadPoseTable(in, "p.txt");
}

ImuData Imu(const std::string& text) {
  std::istringstream in(text);
  ImuData data;
  ReadImuTable(in, "i.csv", &data);
  return data;
}

std::vector<ImuSample> Gyro(const std::string& text) {
  std::istringstream in(text);
  return ReadSensorTable(in, "g.csv", /*is_accel=*/false);
}

void ExpectBadPoses(const std::string& text, std::vector<std::string> parts) {
  parts.emplace_back("'p.txt': ");
  ExpectError<InputError>([&] { Poses(text); }, parts);
}

void ExpectBadImu(const std::string& text, std::vector<std::string> parts) {
  parts.emplace_back("'i.csv': ");
  ExpectError<InputError>([&] { Imu(text); }, parts);
}

void ExpectPose(const PoseSample& pose, int64_t t_ns) {
  EXPECT_EQ(pose.t_ns, t_ns);
  EXPECT_EQ(pose.p_WM, Eigen::Vector3d(1.0, 2.0, 3.0));
  EXPECT_EQ(pose.q_WM.coeffs(), Eigen::Vector4d(0.1, 0.2, 0.3, 0.9));
}

// --- Layouts ---

TEST(PoseTable, HasTumOrderWithoutHeader) {
  const auto poses = Poses("# ground truth trajectory\n1.5 1 2 3 0.1 0.2 0.3 0.9\n");
  ASSERT_EQ(poses.size(), 1u);
  ExpectPose(poses[0], 1'500'000'000);
}

TEST(PoseTable, TakesAnySeparatorWithBlanksAround) {
  for (const char* line : {"1.5,1,2,3,0.1,0.2,0.3,0.9", "1.5;1;2;3;0.1;0.2;0.3;0.9",
                           "1.5\t1\t2\t3\t0.1\t0.2\t0.3\t0.9", "  1.5   1 2\t 3 0.1 0.2 0.3 0.9  ",
                           " 1.5 , 1, 2 ,3,0.1,0.2,0.3,\t0.9\r"})
    ExpectPose(Poses(line).at(0), 1'500'000'000);
}

TEST(PoseTable, FollowsTheHeaderInAnyOrder) {
  for (const char* header : {"qw,qz,qy,qx,z,y,x,time", "#qw,qz,qy,qx,z,y,x,time",
                             "# Q_W, Q_Z, Q_Y, Q_X, pos_z, pos_y, pos_x, Timestamp [s]",
                             "# poses of the marker\n# qw,qz,qy,qx,z,y,x,t\n# as exported"})
    ExpectPose(Poses(std::string(header) + "\n0.9,0.3,0.2,0.1,3,2,1,1.5\n").at(0), 1'500'000'000);
}

TEST(PoseTable, ReadsAslVicon) {
  const auto poses = Poses(
      "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],"
      "q_RS_z []\r\n"
      "1403636579763555527,1,2,3,0.9,0.1,0.2,0.3\r\n");
  ASSERT_EQ(poses.size(), 1u);
  ExpectPose(poses[0], 1'403'636'579'763'555'527);
}

TEST(PoseTable, ReadsAslGroundTruthWithItsExtraColumns) {
  const auto poses = Poses(
      "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
      "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
      "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
      "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
      "1403715524912143104,1,2,3,0.9,0.1,0.2,0.3,7,7,7,8,8,8,9,9,9\n");
  ASSERT_EQ(poses.size(), 1u);
  ExpectPose(poses[0], 1'403'715'524'912'143'104);
}

TEST(PoseTable, ReadsTrajectoriesOfOpenVins) {
  const std::string header = "# timestamp(s) tx ty tz qx qy qz qw",
                    sigmas = " Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33",
                    line = "1413394881.55555 1 2 3 0.1 0.2 0.3 0.9";
  ExpectPose(Poses(header + "\n" + line).at(0), 1'413'394'881'555'550'000);
  ExpectPose(Poses(header + sigmas + "\n" + line + " 7 7 7 7 7 7 8 8 8 8 8 8").at(0),
             1'413'394'881'555'550'000);
  // Its states are no poses: the rotation comes first.
  ExpectBadPoses("# timestamp(s) q p v bg ba\n1.5 0.1 0.2 0.3 0.9 1 2 3 4 4 4 5 5 5 6 6 6\n",
                 {"line 2 ", "17 columns"});
}

TEST(PoseTable, SkipsByteOrderMarkCommentsAndEmptyLines) {
  const auto poses = Poses(
      "\xEF\xBB\xBFtime [s] x [m] y [m] z [m] qx qy qz qw\n\n"
      "1.5 1 2 3 0.1 0.2 0.3 0.9\n# lost here\n   \n2.5 1 2 3 0.1 0.2 0.3 0.9");
  ASSERT_EQ(poses.size(), 2u);
  ExpectPose(poses[0], 1'500'000'000);
  ExpectPose(poses[1], 2'500'000'000);
}

TEST(ImuTable, HasGyroscopeFirstWithoutHeader) {
  const ImuData data = Imu("0.5,1,2,3,4,5,6\n0.6,1,2,3,4,5,7\n");
  ASSERT_EQ(data.gyro.size(), 2u);
  ASSERT_EQ(data.accel.size(), 2u);
  EXPECT_EQ(data.gyro[0].t_ns, 500'000'000);
  EXPECT_EQ(data.gyro[0].value, Eigen::Vector3d(1, 2, 3));
  EXPECT_EQ(data.accel[1].t_ns, 600'000'000);
  EXPECT_EQ(data.accel[1].value, Eigen::Vector3d(4, 5, 7));
}

TEST(ImuTable, FollowsTheHeader) {
  const ImuData data = Imu("t [ms];temp;ax;ay;az;wx;wy;wz\n0.5;warm;4;5;6;1;2;3\n");
  EXPECT_EQ(data.gyro.at(0).t_ns, 500'000);
  EXPECT_EQ(data.gyro[0].value, Eigen::Vector3d(1, 2, 3));
  EXPECT_EQ(data.accel[0].value, Eigen::Vector3d(4, 5, 6));
}

TEST(SensorTable, HasThreeValues) {
  for (const char* text : {"0.5 1 2 3\n", "t,z,y,x\n0.5,3,2,1\n", "t,ax,gz,gy,gx\n0.5,9,3,2,1\n"}) {
    const auto gyro = Gyro(text);
    EXPECT_EQ(gyro.at(0).t_ns, 500'000'000);
    EXPECT_EQ(gyro[0].value, Eigen::Vector3d(1, 2, 3)) << text;
  }
}

// --- Values ---

TEST(Stamps, AreExactToTheNanosecond) {
  const auto stamp = [](const std::string& text) { return Gyro(text + " 1 2 3").at(0).t_ns; };
  EXPECT_EQ(stamp("1403636579.763555527"), 1'403'636'579'763'555'527);
  EXPECT_EQ(stamp("1403636579763555527"), 1'403'636'579'763'555'527);
  EXPECT_EQ(stamp("1.403636579763555527e+09"), 1'403'636'579'763'555'527);
  EXPECT_EQ(stamp("1403636579.7635555274"), 1'403'636'579'763'555'527);
  EXPECT_EQ(stamp("1403636579.7635555276"), 1'403'636'579'763'555'528);
  EXPECT_EQ(stamp("-0.000000001"), -1);
  EXPECT_EQ(stamp("+.5"), 500'000'000);
  EXPECT_EQ(stamp("5."), 5'000'000'000);
  EXPECT_EQ(stamp("1000000000000000.0e-6"), 1'000'000'000'000'000'000);
}

TEST(Stamps, HaveTheUnitOfTheHeader) {
  const auto stamp = [](const std::string& unit, const std::string& text) {
    return Gyro("t [" + unit + "],x,y,z\n" + text + ",1,2,3").at(0).t_ns;
  };
  EXPECT_EQ(stamp("ns", "17"), 17);
  EXPECT_EQ(stamp("us", "17"), 17'000);
  EXPECT_EQ(stamp("ms", "17.25"), 17'250'000);
  EXPECT_EQ(stamp("s", "1403636579.763555527"), 1'403'636'579'763'555'527);
}

TEST(Values, AreTheNearestDoubles) {
  const auto gyro = Gyro("1 0.1 -1.7976931348623157e308 4.9406564584124654e-324");
  EXPECT_EQ(gyro[0].value[0], 0.1);
  EXPECT_EQ(gyro[0].value[1], -std::numeric_limits<double>::max());
  EXPECT_EQ(gyro[0].value[2], std::numeric_limits<double>::denorm_min());
}

/// Conditioning drops and counts them.
TEST(Values, MayBeNanOrInfinite) {
  const auto gyro = Gyro("1 nan NaN -inf\n1.5 1 2 3\n");
  ASSERT_EQ(gyro.size(), 2u);
  EXPECT_TRUE(std::isnan(gyro[0].value[0]) && std::isnan(gyro[0].value[1]));
  EXPECT_EQ(gyro[0].value[2], -std::numeric_limits<double>::infinity());
}

/// Conditioning sorts them.
TEST(Values, MayComeInAnyOrder) {
  const auto gyro = Gyro("2 1 2 3\n1 1 2 3\n1 1 2 3\n");
  ASSERT_EQ(gyro.size(), 3u);
  EXPECT_EQ(gyro[0].t_ns, 2'000'000'000);
}

// --- Bad tables ---

const char kPose[] = "1 1 2 3 0.1 0.2 0.3 0.9\n";

TEST(BadTable, Empty) {
  ExpectBadPoses("", {"no samples"});
  ExpectBadPoses("# nothing\n\n", {"no samples"});
  ExpectBadPoses("timestamp,tx,ty,tz,qx,qy,qz,qw\n", {"no samples"});
}

TEST(BadTable, WrongNumberOfColumns) {
  ExpectBadPoses("1 1 2 3 0.1 0.2 0.3\n",
                 {"line 1 has 7 columns, must have 8: timestamp tx ty tz qx qy qz qw"});
  ExpectBadPoses(std::string(kPose) + "\n2 1 2 3 0.1 0.2 0.3 0.9 5\n", {"line 3 has 9 columns"});
  ExpectBadImu("t,gx,gy,gz,ax,ay,az\n1,2,3,4,5,6,7\n1,2,3,4,5,6,7,\n",
               {"line 3 has 8 columns, must have 7 as the header"});
  ExpectBadImu("1\n", {"line 1 has 1 columns, must have 7"});
}

TEST(BadTable, NotANumber) {
  ExpectBadPoses(std::string(kPose) + "2 1 2 3 0.1 0.2x 0.3 0.9\n",
                 {"line 2 column qy is '0.2x', must be a number"});
  ExpectBadPoses(std::string(kPose) + "soon 1 2 3 0.1 0.2 0.3 0.9\n",
                 {"line 2 column timestamp is 'soon', must be a number"});
  ExpectBadImu("1;2;3;4;5,5;6;7\n", {"line 1 column ax is '5,5', must be a number"});
  ExpectBadImu("0x10,2,3,4,5,6,7\n", {"line 1", "'0x10"});
}

TEST(BadTable, NamesTheColumnAsTheHeaderDoes) {
  ExpectBadImu(
      "#timestamp [ns],w_RS_S_x,w_RS_S_y,w_RS_S_z,a_RS_S_x,a_RS_S_y,a_RS_S_z\n1,2,3,4,5,up,7\n",
      {"line 2 column a_RS_S_y is 'up', must be a number"});
}

TEST(BadTable, MissingValue) {
  ExpectBadImu("1,2,,4,5,6,7\n", {"line 1 column gy is empty, must be a number", "nan"});
  ExpectBadImu("t,gx,gy,gz,ax,ay,az\n,2,3,4,5,6,7\n", {"line 2 column t is empty"});
}

TEST(BadTable, NumberOutOfRange) {
  ExpectBadImu("1,2,3,4,5,6,1e400\n", {"line 1 column az is '1e400', must be a number within"});
}

TEST(BadTable, StampThatIsNoTime) {
  ExpectBadPoses(std::string(kPose) + "nan 1 2 3 0.1 0.2 0.3 0.9\n",
                 {"line 2 column timestamp is 'nan', must be a number"});
  ExpectBadPoses("t [s],x,y,z,qx,qy,qz,qw\n1403636579763555527,1,2,3,0.1,0.2,0.3,0.9\n",
                 {"line 2 column t is '1403636579763555527'", "within 4600000000.0 s of 0"});
  ExpectBadPoses("-1e300 1 2 3 0.1 0.2 0.3 0.9\n", {"line 1 column timestamp is '-1e300'"});
  ExpectBadPoses("0e+092070270634 1 2 3 0.1 0.2 0.3 0.9\n",
                 {"line 1 column timestamp is '0e+092070270634', must be a number"});
  ExpectBadPoses("9300000000000000000 1 2 3 0.1 0.2 0.3 0.9\n", {"timestamp", "ns of 0"});
}

TEST(BadTable, UnitOfTimeMissingOrUnknown) {
  ExpectBadImu("t [h],gx,gy,gz,ax,ay,az\n1,2,3,4,5,6,7\n",
               {"line 1", "stamps in 'h', must be s, ms, us or ns"});
  ExpectBadImu("1000,2,3,4,5,6,7\n6000,2,3,4,5,6,7\n",
               {"as seconds, the stamps are 5000.0 s apart", "timestamp [us]"});
  ExpectBadImu("1600000000000000,2,3,4,5,6,7\n1600000000000500,2,3,4,5,6,7\n",
               {"as nanoseconds, the stamps are 5.0", "e-07 s apart", "timestamp [us]"});
}

TEST(BadTable, HeaderWithoutANeededColumn) {
  ExpectBadImu("t,gx,gy,gz,ax,ay,oops\n1,2,3,4,5,6,7\n",
               {"line 1 is no header", "no column az", "timestamp gx gy gz ax ay az"});
  ExpectBadPoses("# timestamp tx ty tz rx ry rz rw\n1 1 2 3 0.1 0.2 0.3 0.9\n",
                 {"line 1", "no column qx"});
  ExpectBadPoses("gx,gy\n" + std::string(kPose), {"line 1 is no header", "no column timestamp"});
}

/// Its order is not that of TUM: it must not be overlooked.
TEST(BadTable, CommentOfUnknownNamesForEveryColumn) {
  ExpectBadPoses("#stamp,px_m,py_m,pz_m,rot_w,rot_x,rot_y,rot_z\n1,1,2,3,0.9,0.1,0.2,0.3\n",
                 {"line 1 is no header", "no column tx"});
}

TEST(BadTable, HeaderWithAColumnTwice) {
  ExpectBadImu("t,time,gx,gy,gz,ax,ay,az\n1,1,2,3,4,5,6,7\n",
               {"line 1", "column timestamp twice, as 't' and 'time'"});
}

TEST(BadTable, BinaryOrEndlessLine) {
  ExpectBadPoses(std::string("\0\1\2\3", 4), {"line 1 is not text"});
  ExpectBadPoses("\x7F\x45LF\x02\x01 \xFF\xFE\n", {"line 1 is no header: '.ELF.. ..'"});
  ExpectBadPoses(kPose + std::string(2'000'000, '1'), {"line 2 has more than", "not a table"});
}

}  // namespace
}  // namespace imu_pose_calib
