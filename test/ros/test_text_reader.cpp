#include <cmath>

#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

class TextFiles : public TempDirTest {
 protected:
  void SetUp() override {
    TempDirTest::SetUp();
    data_ = Simulate(ShortSimulation());
  }

  RecordingRequest Tables() const {
    RecordingRequest request;
    request.poses = Path("x.poses.txt");
    request.imu = Path("x.imu.csv");
    return request;
  }
  RecordingRequest Folder(const std::string& name) const {
    RecordingRequest request;
    request.paths = {Path(name)};
    return request;
  }
  static void ExpectRefusal(const RecordingRequest& request,
                            const std::vector<std::string>& parts) {
    ExpectError<InputError>([&] { ReadText(request); }, parts);
  }
  void ExpectData(const SessionData& data) const {
    ASSERT_EQ(data.poses.size(), data_.poses.size());
    ASSERT_EQ(data.imus[0].gyro.size(), data_.imus[0].gyro.size());
    ASSERT_EQ(data.imus[0].accel.size(), data_.imus[0].accel.size());
    for (size_t k = 0; k < data.poses.size(); ++k) {
      ASSERT_EQ(data.poses[k].t_ns, data_.poses[k].t_ns);
      ASSERT_EQ(data.poses[k].p_WM, data_.poses[k].p_WM);
      ASSERT_EQ(data.poses[k].q_WM.coeffs(), data_.poses[k].q_WM.coeffs());
    }
    ExpectSamples(data.imus[0].gyro, data_.imus[0].gyro);
    ExpectSamples(data.imus[0].accel, data_.imus[0].accel);
  }

  SessionData data_;

 private:
  static void ExpectSamples(const std::vector<ImuSample>& a, const std::vector<ImuSample>& b) {
    for (size_t k = 0; k < a.size(); ++k) {
      ASSERT_EQ(a[k].t_ns, b[k].t_ns);
      ASSERT_EQ(a[k].value, b[k].value);
    }
  }
};

TEST_F(TextFiles, AslFolderGivesBackTheData) {
  WriteAslFolder(Path("a"), data_);
  const Recording recording = ReadText(Folder("a"));
  ExpectData(recording.data);
  EXPECT_EQ(recording.info.bag, "");
  EXPECT_EQ(recording.info.pose_topic, Path("a/mocap0/data.csv"));
  EXPECT_EQ(recording.info.imus[0].imu_topic, Path("a/imu0/data.csv"));
  EXPECT_EQ(recording.info.world_frame, "world");
  EXPECT_EQ(recording.info.marker_frame, "marker");
  EXPECT_EQ(recording.info.imus[0].imu_frame, "imu");
}

TEST_F(TextFiles, AslFolderMayHoldMav0) {
  WriteAslFolder(Path("a/mav0"), data_);
  ExpectData(ReadText(Folder("a")).data);
  ExpectData(ReadText(Folder("a/")).data);
  ExpectData(ReadText(Folder("a/mav0")).data);
}

TEST_F(TextFiles, TablesGiveBackTheData) {
  for (PoseSample& pose : data_.poses) pose.t_ns -= 2'000'000'000'000'000'001;  // before 1970
  WriteTables(Path("x"), data_, false);
  ExpectData(ReadText(Tables()).data);
}

TEST_F(TextFiles, SplitTablesGiveBackTheData) {
  data_.imus[0].accel.pop_back();
  WriteTables(Path("x"), data_, true);
  RecordingRequest request = Tables();
  request.imu.clear();
  request.gyro = Path("x.gyro.csv");
  request.accel = Path("x.accel.csv");
  const Recording recording = ReadText(request);
  ExpectData(recording.data);
  EXPECT_EQ(recording.info.imus[0].imu_topic, "");
  EXPECT_EQ(recording.info.imus[0].gyro_topic, Path("x.gyro.csv"));
  EXPECT_EQ(recording.info.imus[0].accel_topic, Path("x.accel.csv"));
}

TEST_F(TextFiles, OneFileForBothNeedsTheSameStamps) {
  data_.imus[0].accel.pop_back();
  ExpectError<InputError>([&] { WriteTables(Path("x"), data_, false); }, {"accelerometer"});
  ExpectError<InputError>([&] { WriteAslFolder(Path("a"), data_); }, {"accelerometer"});
}

TEST_F(TextFiles, SpanIsThatOfABag) {
  for (ImuSample& s : data_.imus[0].gyro) s.t_ns += 500'000'000;
  for (ImuSample& s : data_.imus[0].accel) s.t_ns += 500'000'000;
  WriteBag(Path("x.bag"), data_, {});
  WriteTables(Path("x"), data_, false);
  RecordingRequest bag;
  bag.paths = {Path("x.bag")};
  RecordingRequest request = Tables();
  bag.start_s = request.start_s = 0.75;
  bag.duration_s = request.duration_s = 1.5;
  data_ = ReadBag(bag).data;
  EXPECT_LT(data_.poses.size(), 200u);
  ExpectData(ReadText(request).data);
}

TEST_F(TextFiles, SpanOfForeignClocksCountsFromEachStart) {
  for (PoseSample& pose : data_.poses) pose.t_ns += 1'000'000'000'000'000;
  WriteTables(Path("x"), data_, false);
  RecordingRequest request = Tables();
  request.start_s = 1.0;
  request.duration_s = 1.0;
  const SessionData data = ReadText(request).data;
  EXPECT_EQ(data.poses.front().t_ns, data_.poses.front().t_ns + 1'000'000'000);
  EXPECT_EQ(data.poses.size(), 101u);
  EXPECT_EQ(data.imus[0].gyro.front().t_ns, data_.imus[0].gyro.front().t_ns + 1'000'000'000);
  EXPECT_EQ(data.imus[0].gyro.size(), 201u);
}

TEST_F(TextFiles, RefusesASpanThatIsNone) {
  WriteTables(Path("x"), data_, false);
  RecordingRequest request = Tables();
  request.start_s = 1e30;
  ExpectRefusal(request, {"start = ", "beyond the end"});
  request.start_s = -1.0;
  ExpectRefusal(request, {"start = -1 s must be at least 0 s"});
  request.start_s = 0.0;
  request.duration_s = std::nan("");
  ExpectRefusal(request, {"duration", "must be at least 0 s"});
}

TEST_F(TextFiles, RefusesFilesThatCannotBeRead) {
  WriteTables(Path("x"), data_, false);
  RecordingRequest request = Tables();
  request.imu = Path("missing.csv");
  ExpectRefusal(request, {"missing.csv", "No such file"});
  request.imu = dir_.string();
  ExpectRefusal(request, {dir_.string(), "is a directory, must be a file"});
  request.imu = Write("empty.csv", "");
  ExpectRefusal(request, {"empty.csv", "no samples"});
}

TEST_F(TextFiles, RefusesIncompleteRequests) {
  RecordingRequest request;
  ExpectRefusal(request, {"poses is missing"});
  request.poses = "p";
  ExpectRefusal(request, {"imu is missing"});
  request.gyro = "g";
  ExpectRefusal(request, {"gyro and accel belong together: accel is missing"});
  request.accel = "a";
  request.imu = "i";
  ExpectRefusal(request, {"either imu, or gyro and accel"});
}

TEST_F(TextFiles, RefusesAFolderWithoutTheData) {
  ExpectRefusal(Folder("missing"), {"missing", "No such file"});
  std::filesystem::create_directories(Path("a/cam0"));
  Write("a/cam0/data.csv", "#timestamp [ns],filename\n1,1.png\n");
  ExpectRefusal(Folder("a"),
                {"no SENSOR/data.csv", "the columns of poses; name the file with poses"});
}

TEST_F(TextFiles, RefusesSeveralCandidatesUntilOneIsNamed) {
  WriteAslFolder(Path("a"), data_);
  std::filesystem::create_directories(Path("a/vicon0"));
  std::filesystem::create_directories(Path("a/imu1"));
  std::filesystem::copy(Path("a/mocap0/data.csv"), Path("a/vicon0/data.csv"));
  ExpectRefusal(Folder("a"), {"several files of poses", "a/mocap0/data.csv, ",
                              "a/vicon0/data.csv; choose with "
                              "poses"});
  RecordingRequest request = Folder("a");
  request.poses = Path("a/vicon0/data.csv");
  ExpectData(ReadText(request).data);

  std::filesystem::copy(Path("a/imu0/data.csv"), Path("a/imu1/data.csv"));
  ExpectRefusal(request, {"several files of an IMU", "choose with imu, or gyro and accel"});
  request.imu = Path("a/imu1/data.csv");
  ExpectData(ReadText(request).data);
}

}  // namespace
}  // namespace imu_pose_calib
