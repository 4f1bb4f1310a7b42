#include "imu_pose_calib/ros/io/bag_file.h"

#include <lz4frame.h>
#include <rosbag/chunked_file.h>
#include <rosbag/stream.h>
#include <zstd.h>

#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <functional>
#include <set>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

/// Of the files of bags, the longer ones first; the first four of ROS 2.
constexpr const char* kEndings[] = {".mcap.zstd", ".db3.zstd", ".mcap",
                                    ".db3",       ".bag",      ".bag.active"};
constexpr size_t kRos2Endings = 4;

/// The ending that a name has, of the first `count`; empty: none.
std::string Ending(const std::string& name, size_t count) {
  for (size_t k = 0; k < count; ++k)
    if (boost::ends_with(name, kEndings[k]) && name != kEndings[k]) return kEndings[k];
  return "";
}

/// Files of a bag of ROS 2 in a folder, by name.
std::vector<std::string> FindBagFiles(const std::string& folder) {
  std::vector<std::string> files;
  std::error_code ignored;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder, ignored))
    if (!Ending(entry.path().filename(), kRos2Endings).empty() && entry.is_regular_file(ignored))
      files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  return files;
}

/// The files that a metadata.yaml names, which lie beside it whatever folder it gives them.
std::vector<std::string> ReadMetadata(const fs::path& metadata) {
  std::vector<std::string> files;
  try {
    const YAML::Node root = ParseYaml(ReadYamlFile(metadata));
    const YAML::Node names = root["rosbag2_bagfile_information"]["relative_file_paths"];
    if (!names || !names.IsSequence() || names.size() == 0)
      Reject("relative_file_paths names no files");
    for (const YAML::Node& name : names) {
      const fs::path given = name.as<std::string>();
      fs::path file = metadata.parent_path() / given.filename();
      if (!fs::exists(file) && fs::exists(file.string() + ".zstd")) file += ".zstd";
      if (!given.has_filename() || !fs::is_regular_file(file))
        Reject("the file '", given.string(), "' that it names is missing");
      files.push_back(file);
    }
  } catch (const std::runtime_error& error) {
    Reject("'", metadata.string(), "': ", error.what());
  }
  return files;
}

// --- Compression ---

constexpr size_t kStep = 1 << 17;  // [bytes] unfolded at a time

void CheckSize(uint64_t size, uint64_t max_size) {
  if (size > max_size) Reject("unfolds to more than ", max_size, " bytes");
}

/// Unfolds zstd frames, calling `use` with a piece at a time.
void Unzstd(ByteReader frames, uint64_t max_size,
            const std::function<void(std::string_view)>& use) {
  const std::unique_ptr<ZSTD_DStream, size_t (*)(ZSTD_DStream*)> stream(ZSTD_createDStream(),
                                                                        ZSTD_freeDStream);
  std::string stored, piece(kStep, '\0');
  ZSTD_inBuffer in{nullptr, 0, 0};
  for (uint64_t size = 0;;) {
    ZSTD_outBuffer out{piece.data(), piece.size(), 0};
    const size_t left = ZSTD_decompressStream(stream.get(), &out, &in);
    if (ZSTD_isError(left)) Reject("zstd: ", ZSTD_getErrorName(left));
    CheckSize(size += out.pos, max_size);
    use(std::string_view(piece).substr(0, out.pos));
    if (in.pos < in.size || (left != 0 && out.pos == out.size)) continue;  // more to come
    stored = frames.Piece();
    in = {stored.data(), stored.size(), 0};
    if (!stored.empty()) continue;
    if (left != 0) Reject("zstd: it is cut off");
    return;
  }
}

/// Unfolds a file, called `name` in errors.
void UnzstdInto(const std::string& path, const std::string& name, InputFile* input) {
  std::ofstream file(path, std::ios::binary);
  try {
    Unzstd({input, 0}, kMaxBlockSize + 100 * input->size(), [&](std::string_view piece) {
      if (!(file << piece << std::flush))
        Reject("cannot be unfolded into a temporary file: ", std::strerror(errno));
    });
  } catch (const InputError& error) {
    Reject("'", name, "': ", error.what());
  }
}

/// The contents of lz4 frames, as DecompressZstd().
std::string DecompressLz4(std::string_view bytes, uint64_t max_size) {
  LZ4F_dctx* raw = nullptr;
  if (LZ4F_isError(LZ4F_createDecompressionContext(&raw, LZ4F_VERSION))) throw std::bad_alloc();
  const std::unique_ptr<LZ4F_dctx, LZ4F_errorCode_t (*)(LZ4F_dctx*)> context(
      raw, LZ4F_freeDecompressionContext);
  std::string contents, piece(kStep, '\0');
  size_t hint = 1;
  while (!bytes.empty() || hint != 0) {
    size_t out = piece.size(), in = bytes.size();
    hint = LZ4F_decompress(context.get(), piece.data(), &out, bytes.data(), &in, nullptr);
    if (LZ4F_isError(hint)) Reject("lz4: ", LZ4F_getErrorName(hint));
    bytes.remove_prefix(in);
    CheckSize(contents.size() + out, max_size);
    contents.append(piece, 0, out);
    if (in == 0 && out == 0 && hint != 0) Reject("lz4: it is cut off");
  }
  return contents;
}

/// The same of bz2, filled up to `size`.
std::string DecompressBz2(std::string_view bytes, uint64_t size) {
  std::string contents(size, '\0');
  rosbag::ChunkedFile none;
  try {
    rosbag::BZ2Stream(&none).decompress(reinterpret_cast<uint8_t*>(contents.data()),
                                        static_cast<unsigned>(size),
                                        reinterpret_cast<uint8_t*>(const_cast<char*>(bytes.data())),
                                        static_cast<unsigned>(bytes.size()));
  } catch (const rosbag::BagException& error) {
    Reject("bz2: ", error.what());
  }
  return contents;
}

}  // namespace

std::string DecompressZstd(std::string_view bytes, uint64_t max_size) {
  std::string contents;
  Unzstd(ByteReader(bytes), max_size, [&](std::string_view piece) { contents.append(piece); });
  return contents;
}

InputFile::InputFile(const std::string& path)
    : path_(path), file_(path, std::ios::binary | std::ios::ate) {
  const auto size = file_.tellg();
  if (size < 0) Reject("'", path_, "' cannot be read: ", std::strerror(errno));
  size_ = next_ = static_cast<uint64_t>(size);
}

std::string InputFile::Read(uint64_t at, uint64_t size) {
  std::string bytes(size, '\0');
  errno = 0;
  if (at < next_ || at - next_ > kStep)
    file_.seekg(static_cast<std::streamoff>(at));  // which drops what is buffered
  else
    file_.ignore(static_cast<std::streamsize>(at - next_));
  file_.read(bytes.data(), static_cast<std::streamsize>(size));
  next_ = at + size;
  if (!file_) {
    file_.clear();
    next_ = UINT64_MAX;
    Reject("'", path_,
           "' cannot be read: ", (errno == 0 ? "it has become shorter" : std::strerror(errno)));
  }
  return bytes;
}

std::unique_ptr<BagFile> OpenBagFile(const std::string& path) {
  if (!IsFile(path)) Reject("bag '", path, "' is not a file");
  auto input = std::make_unique<InputFile>(path);
  std::optional<TemporaryFolder> folder;  // what is open in it can be read without it
  std::string unfolded = path;
  if (boost::starts_with(input->Start(), kZstdMagic)) {
    unfolded = folder.emplace().path() / "unfolded";
    UnzstdInto(unfolded, path, input.get());
    input = std::make_unique<InputFile>(unfolded);
  }
  const std::string start = input->Start();
  if (boost::starts_with(start, kRos1Magic)) return OpenRos1(std::move(input), path);
  if (boost::starts_with(start, kMcapMagic)) return OpenMcap(std::move(input), path);
  if (boost::starts_with(start, kSqliteMagic)) return OpenSqlite(unfolded, path);
  Reject(
      "'", path,
      (Ending(path, kRos2Endings).empty() ? "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2"
                                          : "' is neither an mcap file nor a database of SQLite"),
      (start.empty() ? ": it is empty" : ""));
}

uint32_t RecordFile::AddChunk(std::string_view compression, ByteReader stored, uint64_t size) {
  if (compression.empty() && stored.size() != size)
    Reject("chunk has ", stored.size(), " bytes, must have ", size);
  if (size > kMaxBlockSize && !compression.empty())
    Reject("chunk is of ", size, " bytes, must be at most ", kMaxBlockSize);
  chunks_.push_back({std::string(compression), stored, size});
  return static_cast<uint32_t>(chunks_.size());
}

std::string_view RecordFile::Records(uint32_t chunk) {
  for (const auto& [kept, records] : kept_)
    if (kept == chunk) return records;
  auto [compression, stored, size] = chunks_.at(chunk - 1);
  std::string records = stored.All();
  if (compression == "lz4") records = DecompressLz4(records, size);
  if (compression == "zstd") records = DecompressZstd(records, size);
  if (compression == "bz2") records = DecompressBz2(records, size);
  if (records.size() != size) Reject("chunk unfolds to ", records.size(), " bytes, must be ", size);
  auto& slot = kept_[next_slot_++ % kKept];
  slot = {chunk, std::move(records)};
  return slot.second;
}

void RecordFile::NoteCutOff(const std::string& name, uint64_t end) {
  note_ = "'" + name + "' is cut off: it is read up to byte " + std::to_string(end) + " of " +
          std::to_string(size()) + ", " + std::to_string(entries_.size()) + " messages";
}

std::string Ros1Type(std::string type, const std::string& encoding) {
  const size_t at = type.find("/msg/");
  if (at != std::string::npos) type.erase(at, 4);
  return encoding == "cdr" ? type : type + " in " + encoding;
}

std::vector<std::string> MessageFiles(const std::string& path) {
  if (!IsFolder(path)) return {path};
  const std::string metadata = fs::path(path) / "metadata.yaml";
  return IsFile(metadata) ? ReadMetadata(metadata) : FindBagFiles(path);
}

std::string WithoutBagEnding(const std::string& path) {
  return path.substr(0, path.size() - Ending(path, std::size(kEndings)).size());
}

std::string FileNames(const std::vector<std::string>& paths) {
  std::vector<std::string> names;
  for (const fs::path path : paths)  // a folder may end with a slash
    names.push_back((path.has_filename() ? path : path.parent_path()).filename());
  return boost::join(names, ", ");
}

void CheckBagsExist(const std::vector<std::string>& paths) {
  std::set<fs::path> known;
  for (const std::string& path : paths) {
    std::error_code error;
    const bool exists = fs::exists(path, error);
    if (error) Reject("bag '", path, "' cannot be read: ", error.message());
    if (!exists) Reject("bag '", path, "' does not exist");
    if (!known.insert(fs::canonical(path)).second) Reject("bag '", path, "' is given twice");
  }
}

}  // namespace imu_pose_calib
