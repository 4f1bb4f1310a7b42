// The report: the numbers that are drawn, and the page as a user opens it.

#include <yaml-cpp/yaml.h>

#include <array>
#include <regex>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/tables.h"
#include "imu_pose_calib/ros/offline/calibration_report.h"
#include "imu_pose_calib/ros/offline/summary.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

class ReportTest : public ExecutableTest {
 protected:
  static SimulatorOptions Handheld() {
    SimulatorOptions options;
    options.duration_s = 12.0;
    return options;
  }
  /// The ids of headings and tables of a page.
  static bool HasSection(const std::string& page, const std::string& id) {
    return Contains(page, "id=\"" + id + "\"");
  }
  /// Works without a network, with the one script at its end.
  static void ExpectSelfContained(const std::string& page) {
    EXPECT_FALSE(std::regex_search(page, std::regex(R"((src|href)\s*=\s*["'](?!#))")));
    EXPECT_FALSE(std::regex_search(page, std::regex(R"(url\((?!#)|@import|<link|<iframe)")));
    EXPECT_FALSE(std::regex_search(page, std::regex(R"(\son[a-z]+\s*=|http[s]?://)")));
    EXPECT_FALSE(std::regex_search(
        page, std::regex(R"(fetch|XMLHttp|WebSocket|import\(|eval|sendBeacon|localStorage)")));
    EXPECT_EQ(page.find("<script>"), page.rfind("<script"));
    EXPECT_NE(page.find("<script>"), std::string::npos);
  }
  /// The lines of the list at the top in their order: verdict, id of the figure, text.
  static std::vector<std::array<std::string, 3>> Judged(const std::string& page) {
    std::vector<std::array<std::string, 3>> lines;
    const std::regex line(R"re(>(\w+)</span><a href="#([\w-]+)">[^<]*</a>: (.*?)</i></li>)re");
    for (std::sregex_iterator it(page.begin(), page.end(), line), end; it != end; ++it)
      lines.push_back({(*it)[1], (*it)[2], (*it)[3]});
    return lines;
  }
  static std::string VerdictOf(const std::string& page, const std::string& id) {
    for (const auto& line : Judged(page))
      if (line[1] == id) return line[0];
    return "none";
  }
};

TEST_F(ReportTest, NumpyReadsTheTables) {
  NumpyTable<double> table(4);
  table.AddRow(1.0 / 3.0, Eigen::Vector3d(1, -2, 3e300));
  table.AddRow(-0.5, Eigen::Vector3d(4, 5, 6));
  table.Write(Path("x.npy"));
  EXPECT_EQ(ReadText(Path("x.npy")).size() % 64, 0u);  // header and rows
  NumpyTable<float> singles(1);
  singles.Write(Path("y.npy"));
  const Outcome outcome = Run("/usr/bin/python3", Write("check.py", R"(
import numpy as np
x, y = np.load('x.npy'), np.load('y.npy')
assert x.dtype == np.float64 and x.tolist() == [[1 / 3, 1, -2, 3e300], [-0.5, 4, 5, 6]]
assert y.dtype == np.float32 and y.shape == (0, 1)
)"));
  EXPECT_EQ(outcome.status, 0) << outcome.err;
}

/// What the scripts predict from the motion of the solve: measured samples to their noise, which is
/// what the residuals of the solve are. And sigmas that shrink to those of the result: of an even
/// motion, four times the data tell twice as exactly, roughly.
constexpr char kCheckSeries[] = R"(
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np
import report_series as series
from report_axes import Report, residuals

report = Report('.')
zoom = series.predicted(report, 0, 0, 'zoom')
assert len(zoom) == 501
for name, columns, sigma in (('gyro', slice(1, 4), float(sys.argv[2])), ('accel', slice(4, 7), float(sys.argv[3]))):
    t, values = series.recorded(report, 0, 0, name)
    used, r, _ = residuals(report, 0, name, 0)
    near = (t >= zoom[0, 0]) & (t < zoom[-1, 0])
    assert near.sum() > 196
    rest = values[near] - series.each_axis(t[near], zoom[:, 0], zoom[:, columns])
    k = np.searchsorted(used, t[near] - 1e-4)
    assert np.abs(used[k] - t[near]).max() < 1e-5
    assert np.linalg.norm(r[k] - rest, axis=1).max() < 0.3 * sigma
    assert abs(np.sqrt(np.mean(rest ** 2)) / sigma - 1) < 0.15

growth = series.growth(report, 0, 0)
transform = report.result['transform']
assert growth[-1, 0] == 1
assert np.allclose(growth[-1, 1:7], transform['translation_std'] + transform['rotation_std'], 1e-9, 0)
assert np.diff(growth[:, 1:], axis=0).max() <= 1e-12
assert 1.4 < growth[9, 1] / growth[-1, 1] < 4
)";

TEST_F(ReportTest, MeasuredLessPredictedAreTheResiduals) {
  SimulatorOptions truth = Handheld();
  truth.time_shift_s = -1000.5;
  truth.accel_delay_s = 0.004;
  const std::vector<SessionData> sessions = {Simulate(truth)};
  const CalibrationOptions options;
  const Calibration result = imu_pose_calib::Calibrate(options, sessions);
  ASSERT_TRUE(result.IsUsable()) << result.message;
  WriteReportData({options, sessions, std::vector<RecordingInfo>(1), result}, dir_.string());
  const Outcome outcome =
      Run("/usr/bin/python3",
          Write("check.py", kCheckSeries) + " " IMU_POSE_CALIB_SOURCE_DIR "/scripts " +
              std::to_string(truth.gyro_std) + " " + std::to_string(truth.accel_std));
  EXPECT_EQ(outcome.status, 0) << outcome.err;

  const YAML::Node report = YAML::LoadFile(Path("report.yaml"));
  EXPECT_EQ(report["status"].as<std::string>(), "ok");
  EXPECT_EQ(report["sessions"][0]["streams"][1]["count"].as<size_t>(),
            sessions[0].imus[0].gyro.size());
  EXPECT_NEAR(report["sessions"][0]["sensors"][2]["rms"].as<double>(), truth.gyro_std, 1e-3);
  EXPECT_EQ(YAML::LoadFile(Path("result.yaml"))["time_shift"].as<double>(),
            result.sessions[0].imus[0].time_shift);
}

/// Pose sensors have figures and rows of their own, with an IMU and without.
TEST_F(ReportTest, DrawsPoseSensors) {
  SimulatorOptions truth = Handheld();
  truth.duration_s = 20.0;
  truth.pose_sensors.resize(2);
  truth.pose_sensors[1].drift = 0.02;
  truth.pose_sensors[1].jumps = 1;
  RecordingInfo info;
  info.pose_sensors = {{"/camera", "camera", "map"}, {"/odometry", "lidar", "odom"}};
  for (const bool has_imu : {true, false}) {
    std::vector<SessionData> sessions = {Simulate(truth)};
    if (!has_imu) {
      sessions[0].imus.clear();
      info.imus.clear();
    }
    const Calibration result = imu_pose_calib::Calibrate({}, sessions);
    ASSERT_TRUE(result.IsUsable()) << result.message;
    const std::string page = DrawReport({{}, sessions, {info}, result}, Path("r.html"));
    EXPECT_EQ(HasSection(page, "signals"), has_imu);
    EXPECT_TRUE(HasSection(page, "pose_sensor"));
    EXPECT_TRUE(Contains(page, "Pose sensor 1, lidar"));
    EXPECT_TRUE(Contains(page, "<td>translation of sensor0 [mm]</td>"));
    const auto judged = Judged(page);
    const auto line = std::find_if(judged.begin(), judged.end(),
                                   [](const auto& it) { return it[1] == "pose_sensor-2"; });
    ASSERT_NE(line, judged.end());
    EXPECT_EQ((*line)[0], "good");
    EXPECT_TRUE(Contains((*line)[2], "ok; noise ")) << (*line)[2];
    EXPECT_TRUE(Contains((*line)[2], "; jumps: 1")) << (*line)[2];
    ExpectSelfContained(page);
  }
}

TEST_F(ReportTest, DrawsEverythingIntoOnePage) {
  WriteBag(Path("x.bag"), Simulate(Handheld()), {});
  const Outcome outcome = Calibrate("x.bag --report r.html");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");  // no progress: no terminal
  EXPECT_TRUE(Contains(outcome.out, "\nWritten to x.calibration.yaml\n           r.html\n"))
      << outcome.out;
  const std::string page = ReadText(Path("r.html"));
  EXPECT_EQ(page.compare(0, 15, "<!DOCTYPE html>"), 0);
  for (const char* id : {"verdict",   "table",      "judged",     "residual_table", "warnings",
                         "streams",   "making",     "signals",    "residuals",      "distributions",
                         "spectra",   "time_shift", "stamps",     "biases",         "growth",
                         "lever_arm", "excitation", "trajectory", "error_bounds",   "settings"})
    EXPECT_TRUE(HasSection(page, id)) << id;
  const std::regex figure("<svg ");
  EXPECT_EQ(
      std::distance(std::sregex_iterator(page.begin(), page.end(), figure), std::sregex_iterator()),
      12);
  EXPECT_EQ(Judged(page).size(), 13u);  // and the halves
  EXPECT_TRUE(Contains(page, "x_marker = R x_imu + p"));
  EXPECT_TRUE(Contains(page, "<th>sigma of this recording</th>"));
  // One sigma of the rotation: that about the imu axes.
  EXPECT_TRUE(std::regex_search(
      page, std::regex(R"(<td>roll, pitch, yaw \[deg\]</td><td>[^<]*</td><td></td>)")));
  EXPECT_TRUE(Contains(page, "x, y, z, w; sigma about the imu axes"));
  EXPECT_TRUE(Contains(page, "calibrate_bag x.bag --report r.html (in "));
  ASSERT_EQ(std::system(("sha256sum '" + Path("x.bag") + "' > '" + Path("sum") + "'").c_str()), 0);
  EXPECT_TRUE(Contains(page, "sha256 " + ReadText(Path("sum")).substr(0, 64) + "</td>"));
  EXPECT_TRUE(Contains(page, "robust_loss_scale: 5.0"));
  EXPECT_TRUE(Contains(page, std::string("imu_pose_calib ") + kVersion));
  ExpectSelfContained(page);
  EXPECT_LT(page.size(), 2'000'000u);
}

/// What each effect disturbs is what the page names, before what it does not disturb.
TEST_F(ReportTest, JudgesEachFigure) {
  const auto draw = [&](const SimulatorOptions& truth) {
    WriteBag(Path("x.bag"), Simulate(truth), {});
    EXPECT_EQ(Calibrate("x.bag --report r.html --quiet").status, 0);
    return ReadText(Path("r.html"));
  };
  SimulatorOptions truth = Handheld();
  truth.duration_s = 30.0;
  std::string page = draw(truth);
  for (const auto& [verdict, id, text] : Judged(page)) EXPECT_EQ(verdict, "good") << id << text;
  EXPECT_FALSE(Contains(page, "Harmless"));

  SimulatorOptions shaken = truth;
  shaken.effects.shocks = 100.0;
  page = draw(shaken);
  EXPECT_EQ(VerdictOf(page, "residuals"), "bad");
  EXPECT_NE(VerdictOf(page, "distributions"), "good");
  EXPECT_EQ(VerdictOf(page, "stamps"), "good");
  EXPECT_NE(Judged(page).front()[0], "good");
  EXPECT_EQ(Judged(page).back()[0], "good");

  SimulatorOptions lossy = truth;
  lossy.effects.imu_stream.drops = 30.0;
  EXPECT_EQ(VerdictOf(draw(lossy), "stamps"), "look");
  SimulatorOptions slow = truth;
  slow.effects.slow_errors = 0.004;
  EXPECT_NE(VerdictOf(draw(slow), "spectra"), "good");
}

TEST_F(ReportTest, DrawsSeveralSessionsAndWritesPdf) {
  SimulatorOptions second = Handheld();
  second.seed = 9;
  WriteBag(Path("x.bag"), Simulate(Handheld()), {});
  WriteBag(Path("y.bag"), Simulate(second), {});
  Outcome outcome = Calibrate("x.bag y.bag --report r.html --quiet");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "");
  const std::string page = ReadText(Path("r.html"));
  EXPECT_TRUE(HasSection(page, "signals"));
  EXPECT_TRUE(HasSection(page, "signals-2"));
  EXPECT_TRUE(Contains(page, "what each session says alone"));
  EXPECT_TRUE(Contains(page, "of 2 recordings and how they agree"));
  EXPECT_EQ(VerdictOf(page, "table"), "good");
  EXPECT_TRUE(Contains(page, "Agreement of the recordings"));
  ExpectSelfContained(page);

  outcome = Calibrate("x.bag --method gp --report r.pdf --quiet");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const std::string pdf = ReadText(Path("r.pdf"));
  EXPECT_EQ(pdf.compare(0, 5, "%PDF-"), 0);
  const std::regex size(R"(/MediaBox \[ 0 0 (\S+) (\S+) \])");
  size_t sheets = 0;
  for (std::sregex_iterator it(pdf.begin(), pdf.end(), size), end; it != end; ++it, ++sheets) {
    EXPECT_NEAR(std::stod((*it)[1]), 595.3, 0.5);  // A4
    EXPECT_NEAR(std::stod((*it)[2]), 841.9, 0.5);
  }
  EXPECT_GT(sheets, 3u);
  EXPECT_LT(sheets, 10u);
}

TEST_F(ReportTest, ComparesResultsOnAPage) {
  SimulatorOptions second = Handheld(), other = second;
  second.seed = 9;
  other.seed = 10;
  other.T_MI.p.x() += 0.02;
  for (const auto& [name, truth] :
       {std::pair("a", Handheld()), std::pair("b", second), std::pair("c", other)}) {
    WriteBag(Path(std::string(name) + ".bag"), Simulate(truth), {});
    ASSERT_EQ(Calibrate(std::string(name) + ".bag --quiet").status, 0);
  }
  const std::string a = "a.calibration.yaml b.calibration.yaml ";
  Outcome outcome = Run("compare_calibrations", a + "--report r.html");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(Contains(outcome.out, "\nWritten to r.html\n")) << outcome.out;
  std::string page = ReadText(Path("r.html"));
  for (const char* id :
       {"table", "from_others", "scatter", "translation", "rotation", "clocks", "noise", "making"})
    EXPECT_TRUE(HasSection(page, id)) << id;
  EXPECT_TRUE(Contains(page, "<b>AGREE</b>"));
  EXPECT_EQ(VerdictOf(page, "translation"), "good");
  ExpectSelfContained(page);

  outcome = Run("compare_calibrations", a + "c.calibration.yaml --report r.html");
  EXPECT_EQ(outcome.status, 2);
  page = ReadText(Path("r.html"));
  EXPECT_TRUE(Contains(page, "<b>DIFFER</b>"));
  EXPECT_EQ(Judged(page).front()[0] + Judged(page).front()[1], "badtranslation");
  EXPECT_EQ(VerdictOf(page, "rotation"), "good");

  outcome = Run("compare_calibrations",
                "a.calibration.yaml --reference '0.05 -0.03 0.08 0.5 -0.5 0.5 0.5' --report r.pdf");
  EXPECT_EQ(ReadText(Path("r.pdf")).compare(0, 5, "%PDF-"), 0);
  outcome = Run("compare_calibrations", a + "--report r.txt");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "report 'r.txt' must end in .html or .pdf")) << outcome.err;
}

TEST_F(ReportTest, ShowsWhyARecordingIsRefused) {
  SimulatorOptions planar = Handheld();
  planar.motion = Motion::kPlanar;
  WriteBag(Path("x.bag"), Simulate(planar), {});
  ExpectFailure("x.bag --report r.html", 2, {"turns about one axis only"});
  std::string page = ReadText(Path("r.html"));
  for (const char* id : {"verdict", "streams", "recorded", "stamps", "missing", "settings"})
    EXPECT_TRUE(HasSection(page, id)) << id;
  EXPECT_FALSE(HasSection(page, "table"));
  EXPECT_TRUE(Contains(page, "<b>REFUSED</b> the marker turns about one axis only, marker z"));
  EXPECT_FALSE(Contains(page, "No warnings"));
  EXPECT_EQ(Judged(page).front()[0] + Judged(page).front()[1], "badmissing");
  ExpectSelfContained(page);

  // Refused after the solve: the figures of the solve are there, and no result.
  WriteBag(Path("y.bag"), Simulate(Handheld()), {});
  Write("c.yaml", "weak_translation_std: 1.0e-7\n");
  std::filesystem::remove(Path("r.html"));
  const Outcome outcome = Calibrate("y.bag --config c.yaml --report r.html");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_FALSE(std::filesystem::exists(Path("y.calibration.yaml")));
  page = ReadText(Path("r.html"));
  EXPECT_TRUE(Contains(page, "<b>REFUSED</b>"));
  EXPECT_TRUE(HasSection(page, "residuals"));
  EXPECT_TRUE(Contains(page, "are not to be used"));

  // What an earlier run wrote stays.
  EXPECT_EQ(Calibrate("missing.bag --report r.html").status, 1);
  EXPECT_EQ(ReadText(Path("r.html")), page);
}

TEST_F(ReportTest, IsRefusedBeforeTheSolve) {
  WriteBag(Path("x.bag"), Simulate(Handheld()), {});
  ExpectFailure("x.bag --report no/such/r.html", 1,
                {"report 'no/such/r.html' cannot be written: No such file or directory"});
  ExpectFailure("x.bag --report r.txt", 1, {"report 'r.txt' must end in .html or .pdf"});
  ExpectFailure("x.bag --output r.html --report r.html", 1, {"report and output are both"});
  Write("c.html", "knot_spacing_s: 0.03\n");
  ExpectFailure("x.bag --config c.html --report c.html", 1,
                {"report 'c.html' would replace the config"});
}

/// Without a Python that has matplotlib: PYTHONPATH holds one that cannot be imported.
TEST_F(ReportTest, SaysThatMatplotlibIsMissing) {
  std::filesystem::create_directory(Path("matplotlib"));
  Write("matplotlib/__init__.py", "raise ImportError('No module named matplotlib')\n");
  WriteBag(Path("x.bag"), Simulate(Handheld()), {});
  ASSERT_EQ(setenv("PYTHONPATH", dir_.c_str(), 1), 0);
  const Outcome outcome = Calibrate("x.bag --report r.html --quiet");
  unsetenv("PYTHONPATH");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "No module named matplotlib: apt install python3-matplotlib"))
      << outcome.err;
  EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
  EXPECT_TRUE(std::filesystem::exists(Path("x.calibration.yaml")));
}

/// `script` of util-linux gives the command a terminal.
TEST_F(ReportTest, TellsOfItsStagesOnATerminal) {
  WriteBag(Path("x.bag"), Simulate(Handheld()), {});
  const auto run = [&](const std::string& options) {
    const std::string command = "cd '" + dir_.string() + "' && script -qec \"" +
                                IMU_POSE_CALIB_BIN_DIR + "/calibrate_bag x.bag " + options +
                                " > out.txt\" tty.txt > /dev/null";
    EXPECT_EQ(std::system(command.c_str()), 0);
    return ReadText(Path("tty.txt"));
  };
  const std::string lines = run("--report r.html");
  for (const char* stage :
       {"recording  ", "data and start  ", "trajectory and calibration", "report  "})
    EXPECT_TRUE(Contains(lines, stage)) << stage << "\n" << lines;
  EXPECT_TRUE(std::regex_search(
      lines, std::regex(R"(trajectory and calibration +\d+\.\d s  \d+ iterations)")))
      << lines;
  EXPECT_EQ(ReadText(Path("out.txt")).compare(0, 4, "OK: "), 0);
  EXPECT_FALSE(Contains(run("--quiet"), "recording  "));
}

TEST(Progress, ListsWhatWasWritten) {
  EXPECT_EQ(WrittenTo({"a.yaml", "b\x1b.html"}), "\nWritten to a.yaml\n           b\\x1b.html\n");
  EXPECT_EQ(WrittenTo({}), "");
}

TEST(Progress, TellsOfEveryStageFromBeginningToEnd) {
  std::vector<std::string> stages;
  SimulatorOptions truth;
  truth.duration_s = 12.0;
  const Calibration result = Calibrate(
      {}, {Simulate(truth)}, [&](const std::string& stage, std::optional<int> iterations) {
        stages.push_back((iterations ? "end " : "begin ") + stage);
        if (stage == "trajectory and calibration") {
          EXPECT_NE(iterations, std::optional<int>(0));
        }
      });
  EXPECT_EQ(stages, (std::vector<std::string>{
                        "begin data and start", "end data and start",
                        "begin trajectory and calibration", "end trajectory and calibration",
                        "begin sigmas and verdict", "end sigmas and verdict"}));
}

}  // namespace
}  // namespace imu_pose_calib
