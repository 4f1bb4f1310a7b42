#include "imu_pose_calib/ros/io/output_files.h"

#include <fcntl.h>
#include <sys/stat.h>

#include <algorithm>
#include <boost/algorithm/string/predicate.hpp>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <mutex>
#include <random>
#include <set>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {

const char kVersion[] = IMU_POSE_CALIB_VERSION;

namespace {

namespace fs = std::filesystem;

/// What is to be removed when the process is interrupted. Who holds the mutex is not interrupted.
struct Temporaries {
  std::mutex mutex;
  std::set<std::string> paths;
};

Temporaries& All() {
  static auto* all = new Temporaries;  // also there while others are destroyed
  return *all;
}

[[noreturn]] void Fail(const std::string& field, const std::string& path, int reason) {
  Reject(field, " '", path, "' cannot be written: ", std::strerror(reason));
}

/// A name that nobody can foresee.
std::string Beside(const std::string& target, const char* what) {
  return target + what + std::to_string(std::random_device()());
}

/// Where a link leads to, whether or not there is something; else the path itself.
std::string Target(const std::string& field, const std::string& path) {
  fs::path target = path;
  std::error_code error;
  const fs::file_status status = fs::status(target, error);
  if (error == std::errc::too_many_symbolic_link_levels) Fail(field, path, ELOOP);
  while (fs::is_symlink(fs::symlink_status(target, error))) {
    target = target.parent_path() / fs::read_symlink(target, error);
    if (error) Fail(field, path, error.value());
  }
  if (fs::is_directory(status)) Fail(field, path, EISDIR);
  if (fs::exists(status) && !fs::is_regular_file(status))
    Reject(field, " '", path, "' is no regular file, which it must be");
  return target;
}

/// Makes a new file beside the target, not through a link that somebody has laid; unlike one of
/// mkstemp() it has the permissions that the umask leaves it.
std::string MakeDraft(const std::string& field, const std::string& path,
                      const std::string& target) {
  const std::lock_guard<std::mutex> lock(All().mutex);
  for (;;) {
    std::string draft = Beside(target, ".tmp");
    if (std::FILE* file = std::fopen(draft.c_str(), "wx")) {
      std::fclose(file);
      All().paths.insert(draft);
      return draft;
    }
    if (errno != EEXIST) Fail(field, path, errno);
  }
}

/// Lets two names change their files; where one has none, it gets that of the other. In between,
/// the place of `target` is never empty where the file system can do that.
void Exchange(const std::string& draft, const std::string& target) {
  if (fs::is_directory(target))
    throw fs::filesystem_error("", std::make_error_code(std::errc::is_a_directory));
  if (!fs::exists(target)) return fs::rename(draft, target);
  if (!fs::exists(draft)) return fs::rename(target, draft);
  if (renameat2(AT_FDCWD, draft.c_str(), AT_FDCWD, target.c_str(), RENAME_EXCHANGE) == 0) return;
  const std::string aside = Beside(target, ".old");
  fs::rename(target, aside);
  std::error_code error;
  fs::rename(draft, target, error);
  fs::rename(aside, error ? target : draft);
  if (error) throw fs::filesystem_error("", error);
}

/// A file, or a folder if it is empty.
void RemoveTemporary(const std::string& path) {
  std::error_code ignored;
  fs::remove(path, ignored);
  const std::lock_guard<std::mutex> lock(All().mutex);
  All().paths.erase(path);
}

bool IsSame(const std::string& a, const std::string& b) {
  std::error_code error;
  return fs::weakly_canonical(fs::absolute(a), error) ==
         fs::weakly_canonical(fs::absolute(b), error);
}

/// Whether the beginning or the end of a file names this package.
bool IsOurs(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  const auto next_names_us = [&](size_t size) {
    std::string text(size, '\0');
    file.read(text.data(), static_cast<std::streamsize>(size));
    file.clear();
    return text.find("imu_pose_calib") != std::string::npos;
  };
  if (next_names_us(4096)) return true;
  file.seekg(-256, std::ios::end);
  return next_names_us(256);
}

/// What a result says that its run wrote elsewhere, see RunInfo; nothing when it is none of ours.
std::vector<std::string> ListedIn(const std::string& result) {
  if (!IsFile(result)) return {};  // a pipe would keep it waiting
  try {
    const YAML::Node root = ParseYaml(ReadYamlFile(result));
    auto files = root["imu_pose_calib"]["files"].as<std::vector<std::string>>();
    for (std::string& file : files) file = fs::path(result).parent_path() / file;
    return files;
  } catch (const std::exception&) {
    return {};
  }
}

}  // namespace

// --- OutputFiles ---

OutputFiles::OutputFiles() {
  run_id_ = UtcText(std::time(nullptr), "%Y%m%dT%H%M%S") + Format("-%08x", std::random_device()());
}

OutputFiles::~OutputFiles() {
  for (const File& file : files_) RemoveTemporary(file.draft);
  std::for_each(folders_.rbegin(), folders_.rend(), RemoveTemporary);
}

void OutputFiles::CheckKept(const std::string& field, const std::string& path) const {
  std::error_code ignored;
  for (const auto& [name, kept] : kept_)
    if (fs::equivalent(path, kept, ignored))
      Reject(field, " '", path, "' would replace the ", name, " '", kept, "'; choose another");
}

void OutputFiles::Plan(const std::string& field, const std::string& path, bool may_make_folders) {
  CheckKept(field, path);
  const std::string target = Target(field, path);
  for (const Named& other : planned_)
    if (IsSame(other.path, target))
      Reject(field, " and ", other.field, " are both '", path, "'; choose another");
  planned_.push_back({field, target});
  fs::path folder = fs::absolute(target).parent_path();
  while (may_make_folders && !fs::exists(folder)) folder = folder.parent_path();
  RemoveTemporary(MakeDraft(field, path, folder / fs::path(target).filename()));
}

std::string OutputFiles::Draft(const std::string& path) {
  CheckKept("output", path);
  const std::string target = Target("output", path);
  for (const File& other : files_)
    if (IsSame(other.target, target))
      Reject("output '", path, "' would replace another file of this run; choose another");
  files_.push_back({path, target, MakeDraft("output", path, target)});
  return files_.back().draft;
}

void OutputFiles::Write(const std::string& path, const std::string& text) {
  std::ofstream file(Draft(path), std::ios::binary);
  errno = 0;
  file.write(text.data(), static_cast<std::streamsize>(text.size()));
  file.close();
  if (!file) Fail("output", path, errno);
}

void OutputFiles::MakeFolder(const std::string& path) {
  fs::path folder;
  std::error_code error;
  for (const fs::path& part : fs::absolute(path)) {
    folder /= part;
    const std::lock_guard<std::mutex> lock(All().mutex);
    if (!fs::create_directory(folder, error)) continue;
    folders_.push_back(folder);
    All().paths.insert(folder);
  }
  if (error) Reject("folder '", path, "' cannot be made: ", error.message());
}

bool OutputFiles::Holds(const std::string& path) const {
  return std::any_of(committed_.begin(), committed_.end(),
                     [&](const std::string& target) { return IsSame(target, path); });
}

void OutputFiles::Commit() {
  const std::lock_guard<std::mutex> lock(All().mutex);
  auto file = files_.begin();
  try {
    for (; file != files_.end(); ++file) Exchange(file->draft, file->target);
  } catch (const fs::filesystem_error& failure) {
    const std::string path = file->path;
    while (file != files_.begin()) {
      --file;
      Exchange(file->draft, file->target);
    }
    Fail("output", path, failure.code().value());
  }
  for (const File& written : files_) {
    std::remove(written.draft.c_str());  // what was there before
    All().paths.erase(written.draft);
    committed_.push_back(written.target);
  }
  for (const std::string& folder : folders_) All().paths.erase(folder);
  for (const std::string& path : obsolete_) std::remove(path.c_str());
  files_.clear();
  folders_.clear();
  obsolete_.clear();
}

void WriteFile(const std::string& path, const std::string& text) {
  OutputFiles files;
  files.Write(path, text);
  files.Commit();
}

void CheckFolderOf(const std::string& field, const std::string& path) {
  const fs::path folder = fs::path(path).parent_path();
  if (!folder.empty() && !IsFolder(folder))
    Reject(field, " '", path, "' cannot be written: there is no folder '", folder.string(), "'");
}

// --- Temporary files and interrupts ---

/// Tells the thread that waits for interrupts to end.
const int kEnd = SIGRTMIN;

TemporaryFolder::TemporaryFolder() {
  std::string name = (fs::temp_directory_path() / "imu_pose_calib_XXXXXX").string();
  const std::lock_guard<std::mutex> lock(All().mutex);
  if (mkdtemp(name.data()) == nullptr) Reject("no temporary folder '", name, "' can be made");
  path_ = name;
  All().paths.insert(path_);
}

TemporaryFolder::~TemporaryFolder() {
  std::error_code ignored;
  fs::remove_all(path_, ignored);
  RemoveTemporary(path_);
}

InterruptGuard::InterruptGuard() {
  sigemptyset(&waited_for_);
  sigaddset(&waited_for_, kEnd);
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) {
    struct sigaction action {};
    sigaction(signal, nullptr, &action);
    if (action.sa_handler != SIG_IGN) sigaddset(&waited_for_, signal);  // nohup, &
  }
  pthread_sigmask(SIG_BLOCK, &waited_for_, &before_);
  thread_ = std::thread([this] {
    int signal = 0;
    sigwait(&waited_for_, &signal);
    if (signal == kEnd) return;
    const std::lock_guard<std::mutex> lock(All().mutex);
    std::error_code ignored;
    // The inner ones first. A folder may be written to meanwhile.
    for (auto path = All().paths.rbegin(); path != All().paths.rend(); ++path)
      for (int trial = 0; trial < 100 && fs::exists(*path, ignored); ++trial)
        fs::remove_all(*path, ignored);
    std::signal(signal, SIG_DFL);
    pthread_sigmask(SIG_UNBLOCK, &waited_for_, nullptr);
    raise(signal);
  });
}

InterruptGuard::~InterruptGuard() {
  pthread_kill(thread_.native_handle(), kEnd);
  thread_.join();
  pthread_sigmask(SIG_SETMASK, &before_, nullptr);
}

// --- Earlier runs ---

std::vector<std::string> FindEarlier(const std::string& output) {
  fs::path stem = output;
  if (stem.extension() == ".yaml" || stem.extension() == ".yml") stem.replace_extension();
  const std::string start = stem.filename().string() + ".";
  std::vector<std::string> files;
  std::error_code ignored;
  const fs::path folder = stem.parent_path();
  for (const auto& entry : fs::directory_iterator(folder.empty() ? "." : folder, ignored)) {
    const std::string name = entry.path().filename().string();
    const bool is_named =
        boost::starts_with(name, start) && name.find(".tmp", start.size()) == std::string::npos;
    if (is_named && entry.is_regular_file(ignored) && IsOurs(entry.path()))
      files.push_back(folder / name);
  }
  for (const std::string& file : ListedIn(output))
    if (fs::exists(file, ignored)) files.push_back(file);
  std::sort(files.begin(), files.end());
  files.erase(std::unique(files.begin(), files.end(), IsSame), files.end());
  return files;
}

std::string WithTimes(const std::vector<std::string>& files) {
  std::map<std::string, std::string> names;  // by the minute
  for (const std::string& file : files) {
    struct stat info {};
    if (stat(file.c_str(), &info) != 0) continue;
    std::string& list = names[UtcText(info.st_mtime, "%Y-%m-%d %H:%M UTC")];
    list += (list.empty() ? "" : ", ") + file;
  }
  std::string text;
  for (const auto& [time, list] : names)
    text += (text.empty() ? "" : "; ") + list + " (" + time + ")";
  return text;
}

}  // namespace imu_pose_calib
