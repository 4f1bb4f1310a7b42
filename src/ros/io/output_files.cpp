#include "imu_pose_calib/ros/io/output_files.h"

#include <poll.h>
#include <sys/eventfd.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <unistd.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <map>
#include <mutex>
#include <random>
#include <set>

#include "imu_pose_calib/core/base/types.h"
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
  throw InputError(field + " '" + path + "' cannot be written: " + std::strerror(reason));
}

/// A name that nobody can foresee.
std::string Beside(const std::string& target, const char* what) {
  return target + what + std::to_string(std::random_device()());
}

/// Where a link leads to, whether or not there is something; else the path itself.
std::string Target(const std::string& field, const std::string& path) {
  constexpr int kMostLinks = 40;
  fs::path target = path;
  std::error_code error;
  for (int links = 0; fs::is_symlink(fs::symlink_status(target, error)); ++links) {
    if (links == kMostLinks) Fail(field, path, ELOOP);
    target = target.parent_path() / fs::read_symlink(target, error);
    if (error) Fail(field, path, error.value());
  }
  const fs::file_status status = fs::status(target, error);
  if (fs::is_directory(status)) Fail(field, path, EISDIR);
  if (fs::exists(status) && !fs::is_regular_file(status))
    throw InputError(field + " '" + path + "' is no regular file, which it must be");
  return target;
}

/// Makes a new file beside the target, not through a link that somebody has laid; unlike one of
/// mkstemp() it has the permissions that the umask leaves it.
std::FILE* MakeDraft(const std::string& target, std::string* draft) {
  const std::lock_guard<std::mutex> lock(All().mutex);
  std::FILE* file = nullptr;
  do {
    *draft = Beside(target, ".tmp");
    file = std::fopen(draft->c_str(), "wx");
  } while (!file && errno == EEXIST);
  if (file) All().paths.insert(*draft);
  return file;
}

void RemoveTemporary(const std::string& path) {
  std::error_code ignored;
  fs::remove_all(path, ignored);
  const std::lock_guard<std::mutex> lock(All().mutex);
  All().paths.erase(path);
}

bool IsSame(const std::string& a, const std::string& b) {
  std::error_code error;
  return fs::weakly_canonical(fs::absolute(a), error) ==
         fs::weakly_canonical(fs::absolute(b), error);
}

std::string UtcText(std::time_t time, const char* format) {
  std::tm utc{};
  gmtime_r(&time, &utc);
  char text[32];
  std::strftime(text, sizeof(text), format, &utc);
  return text;
}

/// Whether the beginning or the end of a file names this package.
bool IsOurs(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  std::string text(4096, '\0');
  const auto read = [&] {
    file.read(text.data(), static_cast<std::streamsize>(text.size()));
    const bool found = text.find("imu_pose_calib") != std::string::npos;
    file.clear();
    return found;
  };
  if (read()) return true;
  text.assign(256, '\0');
  file.seekg(-static_cast<std::streamoff>(text.size()), std::ios::end);
  return read();
}

/// What a result says that its run wrote elsewhere, see RunInfo.
std::vector<std::string> ListedIn(const std::string& result) {
  constexpr size_t kMaxSize = 10'000'000;
  std::vector<std::string> files;
  try {
    for (const YAML::Node& file :
         ParseYaml(ReadYamlFile(result, kMaxSize))["imu_pose_calib"]["files"])
      files.push_back(fs::path(result).parent_path() / file.as<std::string>());
  } catch (const std::exception&) {
    files.clear();  // no result of ours
  }
  return files;
}

}  // namespace

// --- OutputFiles ---

OutputFiles::OutputFiles() {
  char random[16];
  std::snprintf(random, sizeof(random), "-%08x", std::random_device()());
  run_id_ = UtcText(std::time(nullptr), "%Y%m%dT%H%M%S") + random;
}

OutputFiles::~OutputFiles() {
  for (const File& file : files_) RemoveTemporary(file.draft);
  std::error_code ignored;
  for (auto folder = folders_.rbegin(); folder != folders_.rend(); ++folder) {
    fs::remove(*folder, ignored);  // if it is empty
    const std::lock_guard<std::mutex> lock(All().mutex);
    All().paths.erase(*folder);
  }
}

void OutputFiles::Plan(const std::string& field, const std::string& path, bool may_make_folders) {
  const std::string target = Target(field, path);
  for (const Planned& other : planned_)
    if (IsSame(other.target, target))
      throw InputError(field + " and " + other.field + " are both '" + path + "'; choose another");
  planned_.push_back({field, target});
  fs::path folder = fs::absolute(target).parent_path();
  while (may_make_folders && !fs::exists(folder)) folder = folder.parent_path();
  std::string draft;
  std::FILE* file = MakeDraft((folder / fs::path(target).filename()).string(), &draft);
  if (!file) Fail(field, path, errno);
  std::fclose(file);
  RemoveTemporary(draft);
}

std::FILE* OutputFiles::Open(const std::string& path) {
  File made{path, Target("output", path), ""};
  std::FILE* file = MakeDraft(made.target, &made.draft);
  if (!file) Fail("output", path, errno);
  files_.push_back(made);
  return file;
}

std::string OutputFiles::Draft(const std::string& path) {
  std::fclose(Open(path));
  return files_.back().draft;
}

void OutputFiles::Write(const std::string& path, const std::string& text) {
  std::FILE* file = Open(path);
  const bool is_whole = std::fwrite(text.data(), 1, text.size(), file) == text.size();
  const int reason = errno;
  const bool is_closed = std::fclose(file) == 0;
  if (is_whole && is_closed) return;
  const int late_reason = errno;
  Drop(path);
  Fail("output", path, is_whole ? late_reason : reason);
}

void OutputFiles::Drop(const std::string& path) {
  const auto is_it = [&](const File& file) { return file.path == path; };
  for (const File& file : files_)
    if (is_it(file)) RemoveTemporary(file.draft);
  files_.erase(std::remove_if(files_.begin(), files_.end(), is_it), files_.end());
}

void OutputFiles::MakeFolder(const std::string& path) {
  std::vector<fs::path> missing;
  std::error_code error;
  for (fs::path folder = fs::absolute(path); !fs::exists(folder, error);
       folder = folder.parent_path())
    missing.push_back(folder);
  for (auto folder = missing.rbegin(); folder != missing.rend(); ++folder) {
    const std::lock_guard<std::mutex> lock(All().mutex);
    if (!fs::create_directory(*folder, error)) continue;
    folders_.push_back(*folder);
    All().paths.insert(*folder);
  }
  if (error || !fs::is_directory(path, error))
    throw InputError("folder '" + path +
                     "' cannot be made: " + (error ? error.message() : std::strerror(ENOTDIR)));
}

bool OutputFiles::Holds(const std::string& path) const {
  return std::any_of(files_.begin(), files_.end(),
                     [&](const File& file) { return IsSame(file.target, path); });
}

void OutputFiles::Replace(File* file) {
  std::error_code ignored;
  if (fs::is_directory(file->target, ignored)) Fail("output", file->path, EISDIR);
  // With a second name for what is there, the place is never empty; some file systems have no
  // second names.
  const std::string old = Beside(file->target, ".old");
  if (link(file->target.c_str(), old.c_str()) == 0 ||
      (errno != ENOENT && std::rename(file->target.c_str(), old.c_str()) == 0))
    file->old = old;
  else if (errno != ENOENT)
    Fail("output", file->path, errno);
  if (std::rename(file->draft.c_str(), file->target.c_str()) != 0)
    Fail("output", file->path, errno);
}

void OutputFiles::Restore(const File& file) {
  if (file.old.empty()) {
    std::remove(file.target.c_str());
  } else {
    std::rename(file.old.c_str(), file.target.c_str());
    std::remove(file.old.c_str());  // two names of one file stay both
  }
}

void OutputFiles::Commit() {
  const std::lock_guard<std::mutex> lock(All().mutex);
  size_t done = 0;
  try {
    for (; done < files_.size(); ++done) Replace(&files_[done]);
  } catch (const InputError&) {
    if (!files_[done].old.empty()) Restore(files_[done]);
    while (done-- > 0) Restore(files_[done]);
    throw;
  }
  for (const File& file : files_) {
    if (!file.old.empty()) std::remove(file.old.c_str());
    All().paths.erase(file.draft);
  }
  for (const std::string& folder : folders_) All().paths.erase(folder);
  folders_.clear();
  for (const std::string& path : obsolete_) std::remove(path.c_str());
  obsolete_.clear();
}

void WriteFile(const std::string& path, const std::string& text) {
  OutputFiles files;
  files.Write(path, text);
  files.Commit();
}

// --- Temporary files and interrupts ---

TemporaryFolder::TemporaryFolder() {
  std::string name = (fs::temp_directory_path() / "imu_pose_calib_XXXXXX").string();
  const std::lock_guard<std::mutex> lock(All().mutex);
  if (mkdtemp(name.data()) == nullptr)
    throw InputError("no temporary folder '" + name + "' can be made");
  path_ = name;
  All().paths.insert(path_);
}

TemporaryFolder::~TemporaryFolder() { RemoveTemporary(path_); }

struct InterruptGuard::State {
  sigset_t signals{}, before{};
  int arrived = -1, end = -1;
};

InterruptGuard::InterruptGuard() : state_(std::make_unique<State>()) {
  sigemptyset(&state_->signals);
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) {
    struct sigaction action {};
    sigaction(signal, nullptr, &action);
    if (action.sa_handler != SIG_IGN) sigaddset(&state_->signals, signal);  // nohup, &
  }
  pthread_sigmask(SIG_BLOCK, &state_->signals, &state_->before);
  state_->arrived = signalfd(-1, &state_->signals, SFD_CLOEXEC);
  state_->end = eventfd(0, EFD_CLOEXEC);
  thread_ = std::thread([this] {
    pollfd files[] = {{state_->end, POLLIN, 0}, {state_->arrived, POLLIN, 0}};
    while (poll(files, 2, -1) < 0 && errno == EINTR) {
    }
    signalfd_siginfo info{};
    if ((files[1].revents & POLLIN) == 0 ||
        read(state_->arrived, &info, sizeof(info)) != sizeof(info))
      return;
    const std::lock_guard<std::mutex> lock(All().mutex);
    std::error_code ignored;
    // The inner ones first. A folder may be written to meanwhile.
    for (auto path = All().paths.rbegin(); path != All().paths.rend(); ++path)
      for (int trial = 0; trial < 100 && fs::exists(*path, ignored); ++trial)
        fs::remove_all(*path, ignored);
    const auto signal = static_cast<int>(info.ssi_signo);
    std::signal(signal, SIG_DFL);
    pthread_sigmask(SIG_UNBLOCK, &state_->signals, nullptr);
    raise(signal);
  });
}

InterruptGuard::~InterruptGuard() {
  const uint64_t one = 1;
  if (write(state_->end, &one, sizeof(one)) == sizeof(one)) thread_.join();
  close(state_->end);
  close(state_->arrived);
  pthread_sigmask(SIG_SETMASK, &state_->before, nullptr);
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
    const bool is_named = name.compare(0, start.size(), start) == 0 &&
                          name.find(".tmp", start.size()) == std::string::npos;
    if (is_named && entry.is_regular_file(ignored) && IsOurs(entry.path()))
      files.push_back(folder / name);
  }
  for (const std::string& file : ListedIn(output)) files.push_back(file);
  std::sort(files.begin(), files.end());
  const auto is_gone = [&](const std::string& file) { return !fs::exists(file, ignored); };
  files.erase(std::remove_if(files.begin(), files.end(), is_gone), files.end());
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
