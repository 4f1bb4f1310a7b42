#pragma once

#include <boost/noncopyable.hpp>
#include <csignal>
#include <filesystem>
#include <string>
#include <thread>
#include <vector>

namespace imu_pose_calib {

/// Version of the package, "1.2.3".
extern const char kVersion[];

/// The files of one run, which appear together or not at all: each is written beside its place and
/// changes places with what is there by Commit(). Without it they are gone in the end, and what was
/// there is as it was. A link stays, and what it leads to is replaced. Errors are InputErrors that
/// name path and reason; nothing is to be committed after one.
class OutputFiles : boost::noncopyable {
 public:
  OutputFiles();
  ~OutputFiles();

  /// Tells the run from others: "20261125T012345-1a2b3c4d", the time (UTC) and a random number.
  const std::string& run_id() const { return run_id_; }

  /// What is read, as `field`: no file is to replace it.
  void Keep(const std::string& field, const std::string& path) { kept_.push_back({field, path}); }
  /// Throws unless a file can be written at `path`, and when it would replace what is read or is
  /// the place of another that is planned. `may_make_folders`: its folder need not be there.
  void Plan(const std::string& field, const std::string& path, bool may_make_folders = false);

  void Write(const std::string& path, const std::string& text);
  /// Where to write what is to be at `path`, for writers that want a name. Throws when that would
  /// replace what is read, or another file of the run.
  std::string Draft(const std::string& path);
  /// Makes a folder, and those that it is in.
  void MakeFolder(const std::string& path);
  /// Commit() removes the file, if it is there.
  void Remove(const std::string& path) { obsolete_.push_back(path); }

  void Commit();
  /// Whether the file is of this run, and committed.
  bool Holds(const std::string& path) const;

 private:
  struct File {
    std::string path, target, draft;
  };
  struct Named {
    std::string field, path;
  };

  void CheckKept(const std::string& field, const std::string& path) const;

  std::string run_id_;
  std::vector<Named> kept_, planned_;
  std::vector<File> files_;
  std::vector<std::string> committed_;  ///< targets
  std::vector<std::string> folders_;    ///< new ones, the outer first
  std::vector<std::string> obsolete_;
};

/// Replaces the file at `path` in one step.
void WriteFile(const std::string& path, const std::string& text);

/// Throws InputError when the folder that the file at `path` is to be in is missing.
void CheckFolderOf(const std::string& field, const std::string& path);

/// A folder for temporary files, removed in the end.
class TemporaryFolder : boost::noncopyable {
 public:
  TemporaryFolder();
  ~TemporaryFolder();

  const std::filesystem::path& path() const { return path_; }

 private:
  std::filesystem::path path_;
};

/// While it lives, SIGINT, SIGTERM and SIGHUP end the process as they do, but not before what is
/// not committed is removed, nor amid a commit. To be made before other threads.
class InterruptGuard : boost::noncopyable {
 public:
  InterruptGuard();
  ~InterruptGuard();

 private:
  sigset_t waited_for_{}, before_{};
  std::thread thread_;
};

/// Files of earlier runs that belong to the result at `output`: itself, those of this package that
/// are named after it, and what it lists.
std::vector<std::string> FindEarlier(const std::string& output);

/// "a.yaml, b.yaml (2026-11-25 01:23 UTC)": with the times at which the files were made.
std::string WithTimes(const std::vector<std::string>& files);

}  // namespace imu_pose_calib
