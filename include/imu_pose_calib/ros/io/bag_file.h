#pragma once

/// Files of bags: which there are, what they hold and, of ROS 2, how they are written.

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace imu_pose_calib {

class InputFile;

/// A file of a bag: what topics it has, where the messages are, and the bytes of each.
class BagFile {
 public:
  struct Topic {
    std::string name;
    std::string type;                   ///< as ROS 1 names it: "sensor_msgs/Imu"
    std::optional<std::string> md5sum;  ///< of the type's definition; none: of ROS 2
  };
  /// A message, and where the reader finds it.
  struct Entry {
    int64_t t_ns = 0;    ///< record time
    uint32_t topic = 0;  ///< index in topics()
    uint32_t chunk = 0;
    uint64_t at = 0, size = 0;
  };

  virtual ~BagFile() = default;
  const std::vector<Topic>& topics() const { return topics_; }
  const std::vector<Entry>& entries() const { return entries_; }  ///< in the order of the file
  /// What is to be said of the file; empty: nothing.
  const std::string& note() const { return note_; }
  /// What is wrong with the file, for when there are no messages at all.
  const std::string& problem() const { return problem_; }
  /// The bytes of a message, until the next call. Throws InputError when they cannot be had.
  virtual std::string_view Read(const Entry& entry) = 0;

 protected:
  std::vector<Topic> topics_;
  std::vector<Entry> entries_;
  std::string note_, problem_;
};

/// A bag of ROS 1, version 2.0. What is cut off, or has no index, is read as far as it is whole,
/// and `note()` says so. Throws InputError with the reason and the remedy.
std::unique_ptr<BagFile> OpenRos1(const std::string& path);

/// A file of a bag of ROS 2, by its first bytes: mcap or a database of SQLite (.db3), whole or
/// compressed by zstd. Throws InputError naming the file.
std::unique_ptr<BagFile> OpenRos2(const std::string& path);

/// Whether these are the first bytes of an mcap file, of a database of SQLite, or of a zstd frame.
bool IsMcap(std::string_view bytes);
bool IsSqlite(std::string_view bytes);
bool IsZstd(std::string_view bytes);

/// An mcap file. One that is cut off is read up to there, and `note()` says so. Throws InputError
/// with `name` and the place in the file when it is damaged otherwise.
std::unique_ptr<BagFile> OpenMcap(std::unique_ptr<InputFile> input, const std::string& name);

/// The database of rosbag2 (.db3) at `path`. Throws InputError with `name` and SQLite's words.
std::unique_ptr<BagFile> OpenSqlite(const std::string& path, const std::string& name);

/// "sensor_msgs/Imu" for "sensor_msgs/msg/Imu", with what it is encoded in unless that is "cdr".
std::string Ros1Type(std::string type, const std::string& encoding);

/// How a bag of ROS 2 is stored.
enum class Ros2Format { kMcap, kSqlite };

/// Where encoded messages go.
class Ros2Storage {
 public:
  virtual ~Ros2Storage() = default;
  /// Announces a topic, which gets the next number from 0 on.
  virtual void AddTopic(const std::string& name, const std::string& type,
                        const std::string& definition) = 0;
  /// In the order of time.
  virtual void Write(uint32_t topic, int64_t t_ns, const std::string& data) = 0;
  virtual void Close() = 0;
};

/// Both throw InputError with `path` when it cannot be written; so do their members.
std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path);
std::unique_ptr<Ros2Storage> CreateSqlite(const std::string& path);

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
