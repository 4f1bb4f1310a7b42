#pragma once

#include <string>
#include <vector>

namespace imu_pose_calib {

/// Whether there is a bag of ROS 2 at `path`: an .mcap or .db3 file, whole or compressed by zstd,
/// or a folder that holds one or a metadata.yaml.
bool IsRos2Bag(const std::string& path);

/// The files that hold the messages of a bag: itself or, of a folder, what its metadata.yaml names
/// or, without one, all that there are. Throws InputError when that names what is not there.
std::vector<std::string> MessageFiles(const std::string& path);

/// These and, of a folder, the metadata.yaml: all that is read.
std::vector<std::string> FilesOfBag(const std::string& path);

/// The bag's path without the ending that files of its kind have.
std::string WithoutBagEnding(const std::string& path);

/// "A.bag, B.bag" for error messages.
std::string FileNames(const std::vector<std::string>& paths);

/// Throws InputError when one of these is not there, or is given twice.
void CheckBagsExist(const std::vector<std::string>& paths);

}  // namespace imu_pose_calib
