// Outputs of a run are one transaction: whatever goes wrong, what an earlier run wrote stays as it
// was, and new files are all of one run.

#include <sys/resource.h>
#include <sys/stat.h>
#include <yaml-cpp/yaml.h>

#include <chrono>
#include <cstring>
#include <map>
#include <regex>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

/// What is in a folder: the text of every file by its path, a link by what it leads to.
std::map<std::string, std::string> Contents(const std::filesystem::path& folder) {
  std::map<std::string, std::string> contents;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(folder)) {
    const std::string name = entry.path().lexically_relative(folder).string();
    if (name == "out.txt" || name == "err.txt") continue;
    contents[name] = entry.is_symlink()     ? "-> " + read_symlink(entry.path()).string()
                     : entry.is_directory() ? "folder"
                                            : ReadText(entry.path());
  }
  return contents;
}

// --- OutputFiles ---

using OutputFilesTest = TempDirTest;

TEST_F(OutputFilesTest, AppearTogetherOrNotAtAll) {
  Write("a", "old");
  {
    OutputFiles files;
    files.Write(Path("a"), "new");
    files.MakeFolder(Path("c/d"));
    files.Write(Path("c/d/b"), "new");
    EXPECT_EQ(ReadText(Path("a")), "old");
    EXPECT_FALSE(std::filesystem::exists(Path("c/d/b")));
  }
  EXPECT_EQ(Contents(dir_), (std::map<std::string, std::string>{{"a", "old"}}));
  OutputFiles files;
  files.Write(Path("a"), "new");
  files.MakeFolder(Path("c/d"));
  files.Write(Path("c/d/b"), "new");
  files.Commit();
  EXPECT_EQ(Contents(dir_),
            (std::map<std::string, std::string>{
                {"a", "new"}, {"c", "folder"}, {"c/d", "folder"}, {"c/d/b", "new"}}));
}

TEST_F(OutputFilesTest, AFailureAmidTheCommitTakesAllBack) {
  Write("a", "old");
  OutputFiles files;
  files.Write(Path("a"), "new");
  files.Write(Path("new"), "new");
  files.Write(Path("b"), "new");
  files.Write(Path("z"), "new");
  std::filesystem::create_directory(Path("b"));  // meanwhile
  ExpectError<InputError>([&] { files.Commit(); }, {"/b", "directory"});
  EXPECT_EQ(ReadText(Path("a")), "old");
  EXPECT_TRUE(std::filesystem::is_directory(Path("b")));
  EXPECT_FALSE(std::filesystem::exists(Path("new")));
  EXPECT_FALSE(std::filesystem::exists(Path("z")));
}

TEST_F(OutputFilesTest, LinksStayAndLeadToWhatIsNew) {
  std::filesystem::create_directory(Path("there"));
  Write("there/a", "old");
  std::filesystem::create_symlink("there/a", Path("link"));
  std::filesystem::create_symlink("link", Path("second"));
  std::filesystem::create_symlink("there/missing", Path("dangling"));
  std::filesystem::create_symlink("loop", Path("loop"));
  WriteFile(Path("second"), "new");
  WriteFile(Path("dangling"), "new");
  EXPECT_TRUE(std::filesystem::is_symlink(Path("link")));
  EXPECT_TRUE(std::filesystem::is_symlink(Path("second")));
  EXPECT_EQ(ReadText(Path("there/a")), "new");
  EXPECT_EQ(ReadText(Path("there/missing")), "new");
  ExpectError<InputError>([&] { WriteFile(Path("loop"), "new"); }, {"loop", "symbolic links"});
  ExpectError<InputError>([&] { WriteFile("/dev/null", "new"); }, {"/dev/null", "regular file"});
  OutputFiles files;
  files.Plan("output", Path("there/a"));
  ExpectError<InputError>([&] { files.Plan("report", Path("link")); },
                          {"report and output are both"});
}

TEST_F(OutputFilesTest, ReplaceNeitherWhatIsReadNorEachOther) {
  Write("a", "old");
  std::filesystem::create_symlink("a", Path("link"));
  OutputFiles files;
  files.Keep("chain", Path("a"));
  ExpectError<InputError>([&] { files.Plan("export", Path("link")); },
                          {"export '", "/link' would replace the chain '", "/a'; choose another"});
  ExpectError<InputError>([&] { files.Write(Path("link"), "new"); },
                          {"output '", "/link' would replace the chain"});
  files.Write(Path("b"), "new");
  ExpectError<InputError>([&] { files.Write(Path("c/../b"), "new"); },
                          {"/b' would replace another file of this run; choose another"});
}

// --- calibrate_bag ---

/// Each is refused before anything is calibrated.
const char* const kMistakes[] = {
    "x.bag --imu-topic /nope",
    "x.bag --pose-topic /nope",
    "x.bag --pose-topic /imu",
    "x.bag --imu-topic /mocap/pose",
    "x.bag --gyro-topic /imu",
    "x.bag --tf-parent world",
    "x.bag --body rig",
    "x.bag --method foo",
    "x.bag --duration -5",
    "x.bag --duration five",
    "x.bag --start 1000",
    "x.bag --start -1",
    "x.bag --config nope.yaml",
    "x.bag --config bad.yaml",
    "x.bag --config wide.yaml",
    "x.bag --config folder",
    "x.bag --imu-yaml nope.yaml",
    "x.bag --imu-yaml noise.yaml",
    "x.bag --trajectory q.xyz",
    "x.bag --trajectory no/dir.tum",
    "x.bag --trajectory-format foo",
    "x.bag --trajectory-rate -1",
    "x.bag --trajectory-clock foo",
    "x.bag --trajectory x.bag",
    "x.bag --export foo",
    "x.bag --report r.txt",
    "x.bag --report no/such/r.html",
    "x.bag --output no/such/y.yaml",
    "x.bag --output folder",
    "x.bag --output x.bag",
    "x.bag --output /dev/full",
    "x.bag --imu-yaml x.calibration.kalibr.imu0.yaml --export kalibr",
    "x.bag --trajectory x.calibration.urdf --trajectory-format tum --export urdf",
    "x.bag --marker-frame a --imu-frame a",
    "x.bag --imu-frame 'a b'",
    "x.bag --no-such-option",
    "x.bag nope.bag",
    "nope.bag --output x.calibration.yaml",
    "mine.txt",
    "--poses mine.txt --imu mine.txt",
};

class OutputsTest : public ExecutableTest {
 protected:
  static constexpr char kAll[] =
      "--report x.calibration.report.html --export tf,urdf,kalibr --trajectory x.tum";

  void SetUp() override {
    ExecutableTest::SetUp();
    SimulatorOptions options;
    options.duration_s = 12.0;
    WriteBag(Path("x.bag"), Simulate(options), {});
  }
  /// The results of a good run.
  void CalibrateAll() {
    const Outcome outcome = Calibrate(std::string("x.bag ") + kAll);
    ASSERT_EQ(outcome.status, 0) << outcome.err;
  }
  std::string RunId() const {
    return YAML::LoadFile(Path("x.calibration.yaml"))["imu_pose_calib"]["run_id"].as<std::string>();
  }
};

TEST_F(OutputsTest, EveryFileNamesItsRun) {
  const Outcome outcome =
      Calibrate("x.bag --report r.html --export all --trajectory truth --output o.yaml");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const YAML::Node head = YAML::LoadFile(Path("o.yaml"))["imu_pose_calib"];
  const auto id = head["run_id"].as<std::string>();
  EXPECT_TRUE(std::regex_match(id, std::regex("\\d{8}T\\d{6}-[0-9a-f]{8}"))) << id;
  EXPECT_EQ(head["files"].as<std::vector<std::string>>(),
            (std::vector<std::string>{"r.html", "truth"}));
  size_t count = 0;
  for (const auto& [name, text] : Contents(dir_)) {
    if (name == "x.bag" || text == "folder" || Contains(name, ".csv")) continue;
    EXPECT_TRUE(Contains(text, id)) << name;
    ++count;
  }
  EXPECT_GT(count, 25u);
  for (const char* file : {"t.tum", "t.bag", "r.pdf"}) {
    const std::string option = Contains(file, "pdf") ? " --report " : " --trajectory ";
    ASSERT_EQ(Calibrate("x.bag" + option + file).status, 0);
    EXPECT_TRUE(Contains(ReadText(Path(file)), RunId())) << file;
  }
}

TEST_F(OutputsTest, NamesWhatAnEarlierRunLeftBeside) {
  CalibrateAll();
  const Outcome outcome = Calibrate("x.bag --start 1");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const size_t place = outcome.out.find("older, of another run: ");
  ASSERT_NE(place, std::string::npos) << outcome.out;
  for (const char* name : {"x.calibration.report.html", "x.calibration.tf.launch",
                           "x.calibration.urdf", "x.calibration.kalibr.imu0.yaml", "x.tum"}) {
    EXPECT_TRUE(Contains(outcome.out.substr(place), name)) << name << outcome.out;
    EXPECT_FALSE(Contains(ReadText(Path(name)), RunId())) << name;
  }
  EXPECT_FALSE(Contains(outcome.out.substr(place), "x.calibration.yaml"));
  CalibrateAll();  // all are replaced
  EXPECT_TRUE(Contains(ReadText(Path("x.calibration.urdf")), RunId()));
  EXPECT_FALSE(Contains(ReadText(Path("out.txt")), "older"));
}

TEST_F(OutputsTest, UsageErrorsTouchNothing) {
  CalibrateAll();
  Write("bad.yaml", "foo: 1\n");
  Write("wide.yaml", "max_iterations: -3\n");
  Write("noise.yaml", "gyroscope_noise_density: -1\n");
  Write("mine.txt", "mine");
  std::filesystem::create_directory(Path("folder"));
  const auto before = Contents(dir_);
  const std::string all = kAll;
  for (const std::string options : kMistakes) {
    // What is given again comes last, and counts.
    const bool has_all = options.find("--report") == std::string::npos &&
                         options.find("--export") == std::string::npos &&
                         options.find("--trajectory") == std::string::npos;
    const Outcome outcome = Calibrate(options + (has_all ? " " + all : ""));
    EXPECT_EQ(outcome.status, 1) << options;
    EXPECT_EQ(outcome.out, "") << options;
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
    EXPECT_EQ(Contents(dir_), before) << options;
  }
  EXPECT_TRUE(
      Contains(Calibrate("x.bag --imu-yaml x.calibration.kalibr.imu0.yaml --export all").err,
               "export 'x.calibration.kalibr.imu0.yaml' would replace the imu_yaml"));
  EXPECT_FALSE(Contains(Calibrate("x.bag --config bad.yaml").err, "did you mean"));
  const std::string text = Calibrate("x.bag --imu-topic /nope").err;
  EXPECT_TRUE(std::regex_search(
      text, std::regex("still there, of an earlier run: .*x\\.calibration\\.tf\\.launch, .*"
                       "x\\.tum \\(20\\d\\d-\\d\\d-\\d\\d \\d\\d:\\d\\d UTC\\)")))
      << text;
}

TEST_F(OutputsTest, RefusedDataTouchNothing) {
  CalibrateAll();
  auto expected = Contents(dir_);
  Outcome outcome = Calibrate(std::string("x.bag --duration 4 ") + kAll);
  EXPECT_EQ(outcome.status, 2);
  EXPECT_TRUE(Contains(outcome.err, "; report: x.calibration.report.refused.html; still there, of"))
      << outcome.err;
  const auto after = Contents(dir_);
  const std::string page = after.at("x.calibration.report.refused.html");
  EXPECT_TRUE(Contains(page, "<b>REFUSED</b>"));
  EXPECT_FALSE(Contains(page, "No warnings."));
  expected["x.calibration.report.refused.html"] = page;
  EXPECT_EQ(after, expected);

  outcome = Calibrate("x.bag --duration 4 --output y.yaml --report y.html");
  EXPECT_TRUE(Contains(outcome.err, "; report: y.html\n")) << outcome.err;
  EXPECT_FALSE(std::filesystem::exists(Path("y.yaml")));
}

TEST_F(OutputsTest, APipeIsRefusedAtOnce) {
  ASSERT_EQ(mkfifo(Path("pipe").c_str(), 0600), 0);
  const Outcome outcome = Run(
      "/usr/bin/env", "timeout 60 " IMU_POSE_CALIB_BIN_DIR "/calibrate_bag x.bag --output pipe");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "output 'pipe' is no regular file")) << outcome.err;
}

/// Under `timeout`, which sends the signal after that many seconds.
TEST_F(OutputsTest, InterruptsTouchNothingOrComeLate) {
  const auto start = std::chrono::steady_clock::now();
  CalibrateAll();
  const std::chrono::duration<double> whole = std::chrono::steady_clock::now() - start;
  std::filesystem::create_directory(Path("tmp"));
  size_t interrupted = 0;
  auto before = Contents(dir_);
  constexpr int kMoments = 18;
  for (int moment = 0; moment < kMoments; ++moment) {
    const std::string signal = moment % 2 == 0 ? "INT" : "TERM";
    const std::string delay = std::to_string(0.02 + 1.1 * whole.count() * moment / kMoments);
    SCOPED_TRACE(signal + " after " + delay + " s");
    const std::string old_id = RunId();
    const Outcome outcome =
        Run("/usr/bin/env", "TMPDIR='" + Path("tmp") + "' timeout -s " + signal + " " + delay +
                                " " + IMU_POSE_CALIB_BIN_DIR + "/calibrate_bag x.bag " + kAll);
    const auto after = Contents(dir_);
    if (RunId() == old_id) {
      ++interrupted;
      EXPECT_EQ(after, before);
      EXPECT_EQ(outcome.status, 124);
    } else {  // it had been written: all of it
      ASSERT_EQ(after.size(), before.size());
      for (const auto& [name, text] : after)
        EXPECT_TRUE(name == "x.bag" || name == "tmp" || Contains(text, RunId())) << name;
    }
    before = after;
  }
  EXPECT_GT(interrupted, 8u);
}

/// As a full disk: files cannot grow beyond so many blocks of 512 or 1024 bytes.
TEST_F(OutputsTest, ADiskThatIsFullTouchesNothing) {
  CalibrateAll();
  const auto before = Contents(dir_);
  for (const char* options :
       {"0 x.tum", "4 x.tum", "16 x.tum", "100 x.tum", "16 t.bag", "300 t.bag"}) {
    SCOPED_TRACE(options);
    const std::string blocks(options, std::strchr(options, ' '));
    // The shell's own output goes through a pipe, which has no such bound.
    const Outcome outcome = Run(
        "/bin/bash", "-c 'trap \"\" XFSZ; (ulimit -f " + blocks + "; exec " +
                         IMU_POSE_CALIB_BIN_DIR + "/calibrate_bag x.bag --export tf --trajectory" +
                         std::strchr(options, ' ') + ") 2>&1 | cat; exit ${PIPESTATUS[0]}'");
    EXPECT_EQ(outcome.status, 1);
    EXPECT_TRUE(Contains(outcome.out, "cannot be written: ")) << outcome.out;
    EXPECT_TRUE(Contains(outcome.out, "run_id: ")) << outcome.out;  // the result is not lost
    EXPECT_EQ(Contents(dir_), before);
  }
}

TEST_F(OutputsTest, OutputsOntoLinksAreWrittenThrough) {
  std::filesystem::create_directory(Path("there"));
  Write("there/mine.yaml", "mine");
  std::filesystem::create_symlink("there/mine.yaml", Path("x.calibration.yaml"));
  std::filesystem::create_symlink("there/r.html", Path("r.html"));
  std::filesystem::create_symlink("there/t.tum", Path("t.tum"));
  EXPECT_EQ(Calibrate("x.bag --imu-topic /nope --report r.html --trajectory t.tum").status, 1);
  EXPECT_EQ(ReadText(Path("there/mine.yaml")), "mine");
  ASSERT_EQ(Calibrate("x.bag --report r.html --trajectory t.tum").status, 0);
  for (const char* name : {"x.calibration.yaml", "r.html", "t.tum"}) {
    EXPECT_TRUE(std::filesystem::is_symlink(Path(name))) << name;
    EXPECT_TRUE(Contains(ReadText(Path(name)), RunId())) << name;
  }
  size_t count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(Path("there")))
    count += entry.exists() ? 1 : 0;
  EXPECT_EQ(count, 3u);
}

TEST_F(OutputsTest, SayOnAScreenWhatMattersMost) {
  const Outcome brief = Calibrate(std::string("x.bag ") + kAll);
  EXPECT_LE(std::count(brief.out.begin(), brief.out.end(), '\n'), 25) << brief.out;
  for (const char* part :
       {"OK: ", "translation [mm]", "dropped: no samples", "static_transform_publisher",
        "Written to x.calibration.yaml", "x.calibration.report.html",
        "note: the imu axes of kalibr are those of the accelerometer, by 0."})
    EXPECT_TRUE(Contains(brief.out, part)) << part << "\n" << brief.out;
  const Outcome verbose = Calibrate(std::string("x.bag --verbose ") + kAll);
  EXPECT_TRUE(Contains(verbose.out, "Gravity and mean biases")) << verbose.out;
  EXPECT_TRUE(Contains(verbose.out, "x.calibration.urdf")) << verbose.out;
}

}  // namespace
}  // namespace imu_pose_calib
