// Where the sequences of public datasets are, and what is published of them.

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <filesystem>
#include <fstream>

#include "imu_pose_calib/ros/evaluation/sequences.h"
#include "imu_pose_calib/ros/io/text_table.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

struct Dataset {
  const char* name;
  const char* title;  ///< with place and licence
  bool is_imu0;       ///< the IMU of its bags is /imu0
  bool is_in_imu;     ///< poses without a sensor.yaml are said to be the IMU's
};

constexpr Dataset kDatasets[] = {
    {"tum-vi",
     "TUM-VI (Schubert et al., IROS 2018): https://cvg.cit.tum.de/data/datasets/"
     "visual-inertial-dataset, CC BY 4.0. Sequences in EuRoC's format, or bags; poses are "
     "published as those of the IMU, on its clock",
     true,
     true},
    {"euroc",
     "EuRoC MAV (Burri et al., IJRR 2016): https://doi.org/10.3929/ethz-b-000690084, in copyright, "
     "non-commercial use permitted. T_BS in sensor.yaml is the published calibration",
     true,
     false},
    {"broad",
     "BROAD (Laidig et al., Data 6(7):72, 2021): https://github.com/dlaidig/broad, CC BY 4.0. "
     "First, convert_broad.py FOLDER_OF_MAT_OR_HDF5 FOLDER. No calibration is published",
     false,
     false},
};

const Dataset& Find(const std::string& name) {
  for (const Dataset& dataset : kDatasets)
    if (dataset.name == name) return dataset;
  throw InputError("dataset '" + name + "' is unknown; must be tum-vi, euroc or broad");
}

/// All paths below a folder, in order.
std::vector<fs::path> Below(const std::string& folder) {
  if (!fs::is_directory(folder))
    throw InputError("'" + folder + "' is not a folder with recordings");
  std::vector<fs::path> paths;
  const auto options = fs::directory_options::skip_permission_denied;
  for (const auto& entry : fs::recursive_directory_iterator(folder, options))
    paths.push_back(entry.path());
  std::sort(paths.begin(), paths.end());
  return paths;
}

/// Path below `folder`, as a name; links are what they are called.
std::string NameOf(const fs::path& path, const std::string& folder) {
  const std::string name = path.lexically_relative(folder);
  return name == "." ? fs::absolute(path).lexically_normal().filename().string() : name;
}

Sequence BagSequence(const fs::path& path,
                     const std::string& folder,
                     const OfflineRequest& common) {
  Sequence sequence;
  sequence.name = NameOf(fs::path(path).replace_extension(""), folder);
  sequence.request = common;
  sequence.request.bag.paths = {path};
  return sequence;
}

/// The folder that a sequence is in, below `folder`: of one session, perhaps.
std::string GroupOf(const fs::path& path, const std::string& folder) {
  const std::string parent = path.parent_path().lexically_relative(folder);
  return path.lexically_relative(folder) == "." || parent == "." ? "" : parent + "/";
}

/// T_BS of the sensor.yaml beside a file of samples: x_body = T_BS x_sensor.
std::optional<Rigid3> SensorPose(const fs::path& data) {
  const fs::path path = data.parent_path() / "sensor.yaml";
  if (!fs::exists(path)) return std::nullopt;
  try {
    const YAML::Node list = ParseYaml(ReadYamlFile(path))["T_BS"]["data"];
    const auto values = list.as<std::vector<double>>();
    if (values.size() != 16) throw InputError("T_BS must have 16 elements");
    const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> T(values.data());
    const Eigen::Matrix3d R = T.topLeftCorner<3, 3>();
    return Rigid3{Eigen::Quaterniond(R).normalized(), T.topRightCorner<3, 1>()};
  } catch (const std::exception& error) {
    throw InputError(path.string() + ": " + error.what());
  }
}

bool HasPoses(const fs::path& file) {
  std::ifstream in(file);
  return in && HasPoseHeader(in, file);
}

/// The sources of poses of an ASL dataset whose IMU is in `imu`: .../imu0/data.csv.
void AddAsl(const Dataset& dataset,
            const fs::path& imu,
            const std::string& folder,
            const OfflineRequest& common,
            std::vector<Sequence>* sequences) {
  const fs::path sensors = imu.parent_path().parent_path();
  const fs::path root = sensors.filename() == "mav0" ? sensors.parent_path() : sensors;
  std::vector<fs::path> sources;
  for (const auto& entry : fs::directory_iterator(sensors))
    if (HasPoses(entry.path() / "data.csv")) sources.push_back(entry.path());
  std::sort(sources.begin(), sources.end());
  for (const fs::path& source : sources) {
    Sequence sequence;
    const std::string name = source.filename();
    sequence.group = GroupOf(root, folder) + name;
    sequence.name = NameOf(root, folder) + "/" + name;
    sequence.request = common;
    sequence.request.text.poses = source / "data.csv";
    sequence.request.text.imu = imu;
    const std::optional<Rigid3> T_BM = SensorPose(source / "data.csv"), T_BI = SensorPose(imu);
    if (T_BM)
      sequence.published_T_MI = T_BM->Inverse() * T_BI.value_or(Rigid3());
    else if (dataset.is_in_imu)
      sequence.published_T_MI = Rigid3();
    sequences->push_back(sequence);
  }
}

}  // namespace

std::string DatasetTitle(const std::string& dataset) { return Find(dataset).title; }

std::vector<Sequence> FindBags(const std::string& folder, const OfflineRequest& common) {
  std::vector<Sequence> sequences;
  for (const fs::path& path : Below(folder))
    if (path.extension() == ".bag") sequences.push_back(BagSequence(path, folder, common));
  if (sequences.empty()) throw InputError("there is no *.bag in '" + folder + "'");
  return sequences;
}

std::vector<Sequence> FindDataset(const std::string& name,
                                  const std::string& folder,
                                  const OfflineRequest& common) {
  const Dataset& dataset = Find(name);
  std::vector<Sequence> sequences;
  for (const fs::path& path : Below(folder)) {
    if (path.filename() == "data.csv" && path.parent_path().filename() == "imu0")
      AddAsl(dataset, path, folder, common, &sequences);
    if (path.extension() != ".bag") continue;
    Sequence sequence = BagSequence(path, folder, common);
    sequence.group = GroupOf(path, folder) + "bags";
    if (dataset.is_imu0 && common.bag.imu_topic.empty()) sequence.request.bag.imu_topic = "/imu0";
    sequences.push_back(sequence);
  }
  if (sequences.empty())
    throw InputError("there is no sequence of '" + name + "' below '" + folder + "'. " +
                     dataset.title);
  std::stable_sort(sequences.begin(), sequences.end(), [](const Sequence& a, const Sequence& b) {
    return a.group < b.group;
  });
  return sequences;
}

}  // namespace imu_pose_calib
