// compare_calibrations and export_calibration as a user runs them.

#include <yaml-cpp/yaml.h>

#include <boost/algorithm/string/replace.hpp>

#include "export_parsers.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/exports/exports.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "run_executable.h"
#include "stored_example.h"

namespace imu_pose_calib {
namespace {

TEST(ComparisonScriptsTest, Hold) {
  EXPECT_EQ(
      std::system("/usr/bin/python3 '" IMU_POSE_CALIB_SOURCE_DIR "/test/ros/test_comparison.py'"),
      0);
}

class CompareTest : public ExecutableTest {
 protected:
  Outcome Compare(const std::string& arguments) const {
    return Run("compare_calibrations", arguments);
  }

  /// A result file whose transform and clock are off the example's.
  void WriteResult(const std::string& name, const Eigen::Vector3d& moved = Eigen::Vector3d::Zero(),
                   const Eigen::Vector3d& turned = Eigen::Vector3d::Zero(), double shifted = 0.0,
                   const std::string& bag = "") const {
    Calibration result = ExampleResult(ImuModel::kCalibrated, 1);
    Rigid3& T_MI = result.imus[0].T_MI;
    T_MI = {(T_MI.q * Exp(turned)).normalized(), T_MI.p + moved};
    result.sessions[0].imus[0].time_shift += shifted;
    RecordingInfo info = ExampleInfo(1);
    info.bag = bag.empty() ? name + ".bag" : bag;
    Write(name, ToYaml(result, {info}, ExampleOptions()));
  }

  void ExpectDiffer(const Outcome& outcome, const std::vector<std::string>& parts) const {
    EXPECT_EQ(outcome.status, 2) << outcome.out << outcome.err;
    EXPECT_TRUE(Contains(outcome.err, "compare_calibrations: error: differ: ")) << outcome.err;
    EXPECT_EQ(outcome.out.compare(0, 6, "DIFFER"), 0) << outcome.out;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.out, part)) << "'" << part << "' is missing in " << outcome.out;
  }
  void ExpectAgree(const Outcome& outcome, const std::vector<std::string>& parts) const {
    EXPECT_EQ(outcome.status, 0) << outcome.out << outcome.err;
    EXPECT_EQ(outcome.out.compare(0, 5, "AGREE"), 0) << outcome.out;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.out, part)) << "'" << part << "' is missing in " << outcome.out;
  }
  void ExpectRefused(const std::string& arguments, const std::vector<std::string>& parts) const {
    const Outcome outcome = Compare(arguments);
    EXPECT_EQ(outcome.status, 1) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.err, part)) << "'" << part << "' is missing in " << outcome.err;
  }
};

// Sigmas of the example: 1, 2, 3 mm; 0.1, 0.2, 0.3 mrad; time shift 0.01 ms.

TEST_F(CompareTest, TwoThatAgree) {
  WriteResult("a.yaml");
  WriteResult("b.yaml", {0.001, 0.0, 0.0}, {0.0, 0.0004, 0.0});
  ExpectAgree(Compare("a.yaml b.yaml"),
              {"most apart: rotation y, 0.02292 deg, 1.4 sigma (bound: 5)", "result 1: a.yaml",
               "weak: sigma of p_MI is 12 mm",
               "translation x                1.0000 mm      1.4142 mm   0.7 sigma",
               "together: 1.000 mm, 0.0229 deg; chi-square 2.5 with 7 degrees of freedom",
               "time shifts are not compared"});
}

TEST_F(CompareTest, TwoThatDiffer) {
  WriteResult("a.yaml");
  WriteResult("b.yaml", {0.0, 0.0, -0.050});
  ExpectDiffer(Compare("a.yaml b.yaml"), {"translation z, -50 mm, 11.8 sigma", "-50.0000 mm"});
  const Outcome quiet = Compare("a.yaml b.yaml --quiet");
  EXPECT_EQ(quiet.status, 2);
  EXPECT_EQ(quiet.out, "");
}

TEST_F(CompareTest, TimeShiftsCountWhereTheClocksAreTheSame) {
  WriteResult("a.yaml");
  WriteResult("b.yaml", Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), 0.002);
  ExpectAgree(Compare("a.yaml b.yaml"), {"time shifts are not compared"});
  ExpectDiffer(Compare("a.yaml b.yaml --same-clocks"), {"time shift, 2 ms, 141.4 sigma"});
  WriteResult("a.yaml", Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), 0.0, "one.bag");
  WriteResult("b.yaml", Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), 0.002, "one.bag");
  ExpectDiffer(Compare("a.yaml b.yaml"), {"time shift, 2 ms, 141.4 sigma"});
}

TEST_F(CompareTest, ManyGiveATableOfRepeatability) {
  for (int i = 0; i < 4; ++i)
    WriteResult("r" + std::to_string(i) + ".yaml", {0.001 * (i % 2), 0.0, 0.0});
  ExpectAgree(Compare("r0.yaml r1.yaml r2.yaml r3.yaml"),
              {"chi2 / dof", "1.0 / 9 = 0.11", "from the others", "result 4"});
  EXPECT_FALSE(Contains(Compare("r0.yaml r1.yaml r2.yaml r3.yaml").out, "more scatter"));
  WriteResult("odd.yaml", Eigen::Vector3d::Zero(), {0.005, 0.0, 0.0});
  ExpectDiffer(Compare("r0.yaml odd.yaml r2.yaml r3.yaml"),
               {"more scatter than the sigmas say: rotation 14.4 times\n",
                "result 2, rotation x, 0.2865 deg", "result 2             0.333 mm   0.2865 deg"});
}

// --- References ---

/// x y z qx qy qz qw
std::string Numbers(const Rigid3& T) {
  char text[200];
  std::snprintf(text, sizeof(text), "%.12f %.12f %.12f %.12f %.12f %.12f %.12f", T.p.x(), T.p.y(),
                T.p.z(), T.q.x(), T.q.y(), T.q.z(), T.q.w());
  return text;
}

Rigid3 ExampleT() { return ExampleResult(ImuModel::kCalibrated, 1).imus[0].T_MI; }

TEST_F(CompareTest, ReferenceByHand) {
  WriteResult("a.yaml");
  Rigid3 reference = ExampleT();
  ExpectAgree(Compare("a.yaml --reference '" + Numbers(reference) + "'"), {"less reference"});
  // The inverse, and a transform off by 40 mm along x: with the sign of result less reference.
  ExpectDiffer(Compare("a.yaml --reference '" + Numbers(reference.Inverse()) + "'"), {});
  reference.p.x() -= 0.040;
  const std::string given = "--reference '" + Numbers(reference) + "'";
  ExpectDiffer(Compare(given + " a.yaml"), {"translation x, 40 mm, 40.0 sigma"});
  ExpectAgree(Compare("a.yaml " + given + " --reference-std '30 0.5'"), {"1.3 sigma"});
  // A first number that is negative is no option.
  ExpectDiffer(Compare("a.yaml --reference '-1 0 0 0 0 0 1'"), {});
}

TEST_F(CompareTest, ReferenceFiles) {
  WriteResult("a.yaml");
  const Rigid3 T = ExampleT();
  std::vector<std::string> n = Words(Numbers(T));
  const std::string keys = "x: " + n[0] + "\ny: " + n[1] + "\nz: " + n[2] + "\nqx: " + n[3] +
                           "\nqy: " + n[4] + "\nqz: " + n[5] + "\nqw: " + n[6] + "\n";
  Write("keys.yaml", keys);
  Write("handeye.yaml", "transformation: {" + boost::replace_all_copy(keys, "\n", ", ") + "}\n");
  Write("lists.yaml", "translation: [" + n[0] + ", " + n[1] + ", " + n[2] + "]\nrotation: [" +
                          n[3] + ", " + n[4] + ", " + n[5] + ", " + n[6] + "]\n");
  std::ostringstream matrix;
  matrix.precision(15);
  matrix << "matrix:\n";
  for (Eigen::Index i = 0; i < 4; ++i)
    matrix << "- [" << T.Matrix()(i, 0) << ", " << T.Matrix()(i, 1) << ", " << T.Matrix()(i, 2)
           << ", " << T.Matrix()(i, 3) << "]\n";
  Write("matrix.yaml", matrix.str());
  ASSERT_EQ(Run("export_calibration", "a.yaml --export evo").status, 0);
  for (const std::string file :
       {"keys.yaml", "handeye.yaml", "lists.yaml", "matrix.yaml", "a.yaml", "a.evo.json"})
    ExpectAgree(Compare("a.yaml --reference " + file), {"together: 0.000 mm, 0.0000 deg"});
  Write("other.yaml", "a: 1\n");
  ExpectRefused("a.yaml --reference other.yaml", {"--reference 'other.yaml': must hold x y z"});
  Write("scaled.yaml", "matrix: [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]\n");
  ExpectRefused("a.yaml --reference scaled.yaml", {"matrix must be a rotation and a translation"});
}

/// Kalibr's camchain-imucam.yaml of two cameras.
std::string Camchain(const Rigid3& T_cam0_imu, const Rigid3& T_cam1_imu, bool inverse = false) {
  std::ostringstream text;
  text.precision(15);
  int k = 0;
  for (const Rigid3& T_cam_imu : {T_cam0_imu, T_cam1_imu}) {
    const Eigen::Matrix4d T = (inverse ? T_cam_imu.Inverse() : T_cam_imu).Matrix();
    text << "cam" << k++ << ":\n  " << (inverse ? "T_imu_cam" : "T_cam_imu") << ":\n";
    for (Eigen::Index i = 0; i < 4; ++i)
      text << "  - [" << T(i, 0) << ", " << T(i, 1) << ", " << T(i, 2) << ", " << T(i, 3) << "]\n";
    text << "  camera_model: pinhole\n  intrinsics: [400.0, 400.0, 320.0, 240.0]\n"
         << "  timeshift_cam_imu: 0.01\n";
  }
  return text.str();
}

TEST_F(CompareTest, ChainOfTwoTransforms) {
  WriteResult("a.yaml");
  const Rigid3 T_cam0_imu = {Exp(Eigen::Vector3d(1.1, 0.3, -0.8)), {0.05, -0.02, 0.01}};
  const Rigid3 T_cam1_imu = {Exp(Eigen::Vector3d(1.2, 0.1, -0.7)), {-0.06, -0.03, 0.02}};
  Write("camchain.yaml", Camchain(T_cam0_imu, T_cam1_imu));
  Write("openvins.yaml", "%YAML:1.0\n" + Camchain(T_cam0_imu, T_cam1_imu, true));
  const std::string cam0 = "'" + Numbers(ExampleT() * T_cam0_imu.Inverse()) + "' ";
  const std::string cam1 = "'" + Numbers(ExampleT() * T_cam1_imu.Inverse()) + "' ";
  for (const std::string chain : {"camchain.yaml", "openvins.yaml"}) {
    ExpectAgree(Compare("a.yaml --chain " + cam0 + chain),
                {"reference: marker -> cam0 -> imu", "together: 0.000 mm, 0.0000 deg"});
    ExpectAgree(Compare("a.yaml --cam cam1 --chain " + cam1 + chain), {"marker -> cam1 -> imu"});
    ExpectDiffer(Compare("a.yaml --chain " + cam1 + chain), {});
  }
  // Results may follow the two words of --chain.
  WriteResult("b.yaml");
  ExpectAgree(Compare("--chain " + cam0 + "camchain.yaml a.yaml b.yaml"),
              {"result 2: b.yaml", "less reference"});
  ExpectRefused("a.yaml --chain " + cam0 + "camchain.yaml --cam cam7", {"'cam7' is not in"});
  Write("cameras.yaml", "cam0:\n  camera_model: pinhole\n");
  ExpectRefused("a.yaml --chain " + cam0 + "cameras.yaml", {"cameras.yaml", "has no T_cam_imu"});
}

TEST_F(CompareTest, ChainIsWrittenAsFrames) {
  WriteResult("a.yaml", {0.001, 0.0, 0.0});
  const Rigid3 T_cam0_imu = {Exp(Eigen::Vector3d(1.1, 0.3, -0.8)), {0.05, -0.02, 0.01}};
  const Rigid3 T_cam1_imu = {Exp(Eigen::Vector3d(1.2, 0.1, -0.7)), {-0.06, -0.03, 0.02}};
  Write("camchain.yaml", Camchain(T_cam0_imu, T_cam1_imu));
  const Outcome outcome = Compare("a.yaml --chain '" + Numbers(ExampleT() * T_cam0_imu.Inverse()) +
                                  "' camchain.yaml --chain-output rig");
  ExpectAgree(outcome, {"Written to rig.urdf\nWritten to rig.tf.launch\n"});
  for (const std::vector<Link>& links :
       {UrdfLinks(ReadText(Path("rig.urdf"))), LaunchLinks(ReadText(Path("rig.tf.launch")))}) {
    ASSERT_EQ(links.size(), 3u);
    EXPECT_EQ(links[0].parent, "rig/marker");
    EXPECT_EQ(links[0].child, "imu_0_link");
    Rigid3 T_MI = ExampleT();
    T_MI.p.x() += 0.001;  // of the result, not of the chain
    EXPECT_TRUE(links[0].T.isApprox(T_MI.Matrix(), 1e-9));
    EXPECT_EQ(links[2].parent, "imu_0_link");
    EXPECT_EQ(links[2].child, "cam1");
    EXPECT_TRUE((T_cam0_imu.Matrix() * links[1].T).isIdentity(1e-9));
    EXPECT_TRUE((T_cam1_imu.Matrix() * links[2].T).isIdentity(1e-9));
  }
}

TEST_F(CompareTest, RefusesWhatCannotBeCompared) {
  WriteResult("a.yaml");
  ExpectRefused("", {"give the results to compare"});
  ExpectRefused("a.yaml", {"one result needs something to compare it with"});
  ExpectRefused("a.yaml none.yaml", {"result 'none.yaml': cannot be read"});
  ExpectRefused("a.yaml --reference '1 2 3'", {"--reference '1 2 3' must be 7 numbers, not 3"});
  ExpectRefused("a.yaml --reference '1 2 3 0 0 0 x'", {"'x' is not a finite number"});
  ExpectRefused("a.yaml --reference '1 2 3 0 0 0 2'", {"must be a unit quaternion", "norm is 2"});
  ExpectRefused("a.yaml a.yaml --imu 1", {"--imu 1: 'a.yaml' has 1 imus"});
  ExpectRefused("a.yaml --chain '0 0 0 0 0 0 1'", {"--chain needs"});
  ExpectRefused("a.yaml a.yaml --chain-output rig", {"--chain-output needs --chain"});
  ExpectRefused("a.yaml a.yaml --fleet text", {"--fleet needs --report"});
  ExpectRefused("a.yaml --reference a.yaml --reference-std '-1 0'", {"must not be negative"});
}

// --- export_calibration and calibrate_bag --export ---

TEST_F(CompareTest, ExportsFromTheResultAreThoseOfTheCalibration) {
  ASSERT_EQ(Run("simulate_bag", "x.bag --duration 15 --imus 2 --time-shift 0.05").status, 0);
  const Outcome outcome =
      Calibrate("x.bag --imu-topic /imu --imu-topic /imu1 --export kalibr,px4 --quiet");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const Outcome later =
      Run("export_calibration", "x.calibration.yaml --export kalibr,px4,urdf --output-dir later");
  ASSERT_EQ(later.status, 0) << later.err;
  const StoredResult stored = LoadResult(Path("x.calibration.yaml"));
  for (const std::string name : {"kalibr", "px4"})
    for (const ExportFile& file : Export(stored, name)) {
      EXPECT_EQ(ReadText(Path("x.calibration." + file.ending)), file.text);
      EXPECT_EQ(ReadText(Path("later/x.calibration." + file.ending)), file.text);
      EXPECT_TRUE(Contains(later.out, "Written to later/x.calibration." + file.ending + "\n"));
    }
  EXPECT_FALSE(std::filesystem::exists(Path("x.calibration.urdf")));
  // Both IMUs, from the truth of the simulation.
  const std::vector<Link> links = UrdfLinks(ReadText(Path("later/x.calibration.urdf")));
  ASSERT_EQ(links.size(), 2u);
  const SimulatorOptions first;
  EXPECT_LT((links[0].T - first.T_MI.Matrix()).norm(), 3e-3);
  EXPECT_LT((links[1].T - FurtherImu(first, 1).T_MI.Matrix()).norm(), 3e-3);
}

TEST_F(CompareTest, UnknownExportsAreRefusedBeforeAnythingIsDone) {
  Write("x.calibration.yaml", std::string(kResultHeader) + "\n");
  const Outcome outcome = Calibrate("x.bag --export kalibr,rviz");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "export 'rviz' is unknown; must be among kalibr, openvins"))
      << outcome.err;
  EXPECT_TRUE(std::filesystem::exists(Path("x.calibration.yaml")));
  for (const std::string arguments :
       {"", "x.calibration.yaml", "x.calibration.yaml --export rviz", "none.yaml --export evo",
        "x.calibration.yaml --export evo --chain camchain.yaml"}) {
    const Outcome refused = Run("export_calibration", arguments);
    EXPECT_EQ(refused.status, 1) << arguments;
    EXPECT_EQ(refused.out, "");
    EXPECT_EQ(std::count(refused.err.begin(), refused.err.end(), '\n'), 1) << refused.err;
  }
}

TEST_F(CompareTest, ExportsDoNotReplaceTheChainTheyAreOf) {
  WriteResult("a.yaml");
  ASSERT_EQ(Run("export_calibration", "a.yaml --export kalibr").status, 0);
  const std::string chain = ReadText(Path("a.kalibr.camchain-imucam.yaml"));
  const Outcome outcome =
      Run("export_calibration",
          "a.yaml --export kalibr --chain a.kalibr.camchain-imucam.yaml --chain-output pre");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "would replace the chain 'a.kalibr.camchain")) << outcome.err;
  EXPECT_EQ(ReadText(Path("a.kalibr.camchain-imucam.yaml")), chain);
  EXPECT_FALSE(std::filesystem::exists(Path("pre.urdf")));
}

TEST_F(CompareTest, Px4TakesTheAxesOfTheBody) {
  WriteResult("a.yaml");
  ASSERT_EQ(Run("export_calibration", "a.yaml --export px4 --body-imu '1 0 0 0'").status, 0);
  const Eigen::Quaterniond q_body_imu(0.0, 1.0, 0.0, 0.0);
  EXPECT_EQ(ReadText(Path("a.px4.params")),
            Export(LoadResult(Path("a.yaml")), "px4", {q_body_imu})[0].text);
  EXPECT_EQ(Run("export_calibration", "a.yaml --export px4 --body-imu '1 0 0'").status, 1);
}

TEST_F(CompareTest, PartsOfOneRecordingAreComparedWithTheirTimeShifts) {
  ASSERT_EQ(Run("simulate_bag", "x.bag --duration 30 --seed 3").status, 0);
  ASSERT_EQ(Calibrate("x.bag --duration 16 --output a.yaml --quiet").status, 0);
  ASSERT_EQ(Calibrate("x.bag --start 14 --output b.yaml --quiet").status, 0);
  ExpectAgree(Compare("a.yaml b.yaml"), {"time shift", "chi-square", "with 8 degrees of freedom"});
}

TEST_F(CompareTest, SaysWhatDependentResultsDoNotShow) {
  const Eigen::Vector3d zero = Eigen::Vector3d::Zero();
  WriteResult("a.yaml", zero, zero, 0.0, "one.bag");
  WriteResult("b.yaml", zero, zero, 0.0, "one.bag");
  WriteResult("c.yaml", zero, zero, 0.0, "two.bag");
  EXPECT_TRUE(Contains(Compare("a.yaml b.yaml").out, "note: results 1 and 2 are of the same"));
  EXPECT_FALSE(Contains(Compare("a.yaml c.yaml").out, "note:"));
  EXPECT_TRUE(Contains(Compare("a.yaml c.yaml b.yaml").out, "note: results 1 and 3 are of the"));
}

TEST_F(CompareTest, TellsOfAReferenceInMillimetres) {
  WriteResult("a.yaml");
  const YAML::Node T = YAML::LoadFile(Path("a.yaml"))["transform"];
  const auto reference = [&](double unit) {
    std::ostringstream text;
    for (int i = 0; i < 3; ++i) text << unit * T["translation"][i].as<double>() << " ";
    for (int i = 0; i < 4; ++i) text << T["rotation"][i].as<double>() << " ";
    return "a.yaml --reference '" + text.str() + "'";
  };
  EXPECT_TRUE(Contains(Compare(reference(1e3)).out, "seems to be in millimetres, must be in m"));
  EXPECT_FALSE(Contains(Compare(reference(1.0)).out, "millimetres"));
}

}  // namespace
}  // namespace imu_pose_calib
