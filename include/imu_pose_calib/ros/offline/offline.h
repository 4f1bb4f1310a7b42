#pragma once

#include <exception>
#include <memory>
#include <string>
#include <variant>
#include <vector>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/offline/calibration_report.h"
#include "imu_pose_calib/ros/offline/ground_truth.h"

namespace imu_pose_calib {

/// Calibration of recordings of one rig as calibrate_bag and calibrate_node offer it. Empty: the
/// default.
struct OfflineRequest : RecordingRequest {
  // The paths may also be several folders of ASL datasets, each a session, and bags of several
  // sessions: those that continue each other are one, see GroupBags(). With text files named beside
  // bags there is one session.

  bool one_recording = false;  ///< all bags are one session, whatever they hold
  std::string config;          ///< YAML of CalibrationOptions
  /// Kalibr's imu.yaml; its noise wins over `config`. Empty: without a `config`, the sensor.yaml
  /// beside a text file of the IMU, if there is one.
  std::string imu_yaml;
  std::string method;        ///< name of a Method; wins over `config`
  std::string solver;        ///< name of a SolverKind; wins over `config`
  std::string output;        ///< result YAML; default: see OutputPath()
  std::string report;        ///< HTML or PDF; default: none
  std::string marker_frame;  ///< replaces the name found in the bag
  std::string imu_frame;     ///< the same; of several IMUs: white space between them
  std::string exports;       ///< programs to export the result to, see ParseExports()
  TrajectoryRequest trajectory;
  /// Result of another recording, whose transform and accel_delay are kept.
  std::string calibration;
  bool keep_data = false;  ///< leaves OfflineResult::sessions also without a report
};

/// An option of calibrate_bag and parameter of the node, and the field that it fills.
struct RequestOption {
  struct List {  ///< several with white space between them
    std::string* texts;
    std::string& operator*() const { return *texts; }
  };
  const char* name;
  std::variant<std::string*, List, double*, bool*> field;
  const char* text;
  const char* unit = "TEXT";
};
/// All of them: those that many need, and those that few do.
struct RequestOptions {
  std::vector<RequestOption> common, others;
};
RequestOptions OptionsOf(OfflineRequest* request);

/// A usable calibration and what to do with it. No sessions when no report is wanted, nor
/// keep_data.
struct OfflineResult : CalibrationRun {
  OfflineRequest request;  ///< with the path of the output, which is not written yet
  std::vector<TrajectoryTarget> trajectories;  ///< ground truth of each IMU in each session
  std::vector<std::string> written;  ///< files that were written, with what is to be said of them
  std::string export_note;           ///< what is to be said of the exports
  std::vector<std::string> earlier;  ///< files that were there before, see FindEarlier()
  std::unique_ptr<OutputFiles> outputs = std::make_unique<OutputFiles>();
};

/// Options as the request names them: `config`, then what wins over it.
CalibrationOptions Options(const OfflineRequest& request);

/// Where the result goes: x.calibration.yaml for x.bag, the first of the bags, or for a file x.csv
/// of poses; calibration.yaml in a folder.
std::string OutputPath(const OfflineRequest& request);

/// Where the report goes by default: x.calibration.report.html beside x.calibration.yaml.
std::string ReportPath(const OfflineRequest& request);

/// Reads the recording and calibrates, after it has tried that all outputs can be written. A
/// failure leaves everything of an earlier run as it was, and its text names that. Data that are
/// refused have their report written, when one is wanted: beside a report that is there, as
/// x.refused.html.
///
/// Throws InputError when something cannot be used as given, DataError when no calibration can come
/// from the data: so the result is always usable.
OfflineResult CalibrateOffline(const OfflineRequest& request, const Progress& progress = {});

/// Writes, as far as the request asks for them, the result, what it is to be exported to, the
/// ground truth and the report, all at once; `outputs` may hold more. When a file cannot be
/// written, prints the text of the result on stdout before it throws, and leaves everything as it
/// was. Only a report that cannot be drawn is left out: returns why. Lets go of the recorded data.
std::string WriteResult(OfflineResult* offline, const Progress& progress = {});

/// What a person reads in the terminal: result, the files that were written, and those of earlier
/// runs that were not. `is_verbose`: all of it, else a screen of 25 lines.
std::string Describe(const OfflineResult& offline, bool is_verbose);

/// Checks of one session without a calibration.
struct OfflineCheck {
  DataCheck check;
  RecordingInfo info;
};

/// Reads each session and judges it; writes and removes nothing.
/// Throws InputError when something cannot be used as given.
std::vector<OfflineCheck> CheckOffline(const OfflineRequest& request);

/// The text of an error on one line, printable whatever files and arguments it quotes.
std::string OneLine(const std::exception& error);

}  // namespace imu_pose_calib
