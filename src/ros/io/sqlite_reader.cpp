#include <sqlite3.h>

#include <filesystem>
#include <map>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/io/ros2_file.h"

namespace imu_pose_calib {
namespace {

constexpr std::string_view kMagic("SQLite format 3\0", 16);

struct CloseSqlite {
  void operator()(sqlite3* database) const { sqlite3_close(database); }
  void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
};
using Statement = std::unique_ptr<sqlite3_stmt, CloseSqlite>;

/// "file:PATH?...", as SQLite wants it.
std::string Uri(const std::string& path, const char* query) {
  std::string uri = "file:";
  for (const char c : std::filesystem::absolute(path).string()) {
    if (c == '%' || c == '?' || c == '#') {
      uri += c == '%' ? "%25" : c == '?' ? "%3f" : "%23";
    } else {
      uri += c;
    }
  }
  return uri + query;
}

/// Whether changes lie beside the database that it does not hold yet.
bool HasJournal(const std::string& path) {
  for (const char* ending : {"-wal", "-journal"}) {
    std::error_code error;
    if (std::filesystem::file_size(path + ending, error) > 0 && !error) return true;
  }
  return false;
}

class SqliteFile : public Ros2File {
 public:
  SqliteFile(const std::string& path, const std::string& name) : name_(name) {
    // Nothing is written beside a database that cannot change.
    const std::string uri = Uri(path, HasJournal(path) ? "?mode=ro" : "?mode=ro&immutable=1");
    sqlite3* database = nullptr;
    const int status =
        sqlite3_open_v2(uri.c_str(), &database, SQLITE_OPEN_READONLY | SQLITE_OPEN_URI, nullptr);
    database_.reset(database);
    Check(status);
    sqlite3_db_config(database, SQLITE_DBCONFIG_DEFENSIVE, 1, nullptr);
    sqlite3_exec(database,
                 "PRAGMA trusted_schema=OFF; PRAGMA cell_size_check=ON",
                 nullptr,
                 nullptr,
                 nullptr);
    CheckTables();
    ReadTopics();
    ReadEntries();
    data_ = Prepare("SELECT data FROM messages WHERE rowid = ?");
  }

  std::string_view Read(const Entry& entry) override {
    sqlite3_reset(data_.get());
    sqlite3_bind_int64(data_.get(), 1, static_cast<sqlite3_int64>(entry.at));
    if (!Step(data_.get()) || sqlite3_column_type(data_.get(), 0) != SQLITE_BLOB)
      Fail("message " + std::to_string(static_cast<int64_t>(entry.at)) + " has no data");
    const auto* data = static_cast<const char*>(sqlite3_column_blob(data_.get(), 0));
    return {data, static_cast<size_t>(sqlite3_column_bytes(data_.get(), 0))};
  }

 private:
  [[noreturn]] void Fail(const std::string& text) const {
    throw InputError("'" + name_ + "' is no bag of ROS 2, or damaged: " + text);
  }

  void Check(int status) const {
    if (status != SQLITE_OK)
      Fail(std::string(sqlite3_errmsg(database_.get())) + " (SQLite, " + std::to_string(status) +
           ")");
  }

  Statement Prepare(const std::string& sql) const {
    sqlite3_stmt* statement = nullptr;
    Check(sqlite3_prepare_v2(database_.get(), sql.c_str(), -1, &statement, nullptr));
    return Statement(statement);
  }

  /// False after the last row.
  bool Step(sqlite3_stmt* statement) const {
    const int status = sqlite3_step(statement);
    if (status != SQLITE_ROW && status != SQLITE_DONE) Check(status);
    return status == SQLITE_ROW;
  }

  std::string Text(sqlite3_stmt* statement, int column) const {
    if (sqlite3_column_type(statement, column) != SQLITE_TEXT) Fail("a topic has no name or type");
    const auto* text = reinterpret_cast<const char*>(sqlite3_column_text(statement, column));
    return {text, static_cast<size_t>(sqlite3_column_bytes(statement, column))};
  }

  int64_t Integer(sqlite3_stmt* statement, int column) const {
    if (sqlite3_column_type(statement, column) != SQLITE_INTEGER)
      Fail("a topic or a message has no number or time");
    return sqlite3_column_int64(statement, column);
  }

  /// A view could be a program that does not end.
  void CheckTables() const {
    for (const char* table : {"topics", "messages"}) {
      const Statement type =
          Prepare(std::string("SELECT type FROM sqlite_master WHERE name = '") + table + "'");
      if (!Step(type.get()) || Text(type.get(), 0) != "table")
        Fail(std::string("it has no table ") + table);
    }
  }

  void ReadTopics() {
    const Statement topics = Prepare("SELECT id, name, type, serialization_format FROM topics");
    while (Step(topics.get())) {
      ids_[Integer(topics.get(), 0)] = static_cast<uint32_t>(topics_.size());
      topics_.push_back({Text(topics.get(), 1), Text(topics.get(), 2), Text(topics.get(), 3)});
    }
  }

  void ReadEntries() {
    const Statement messages = Prepare("SELECT rowid, topic_id, timestamp FROM messages");
    while (Step(messages.get())) {
      const auto topic = ids_.find(Integer(messages.get(), 1));
      if (topic == ids_.end())
        Fail("a message is of topic " + std::to_string(Integer(messages.get(), 1)) +
             ", which is unknown");
      entries_.push_back({Integer(messages.get(), 2),
                          topic->second,
                          0,
                          static_cast<uint64_t>(Integer(messages.get(), 0)),
                          0});
    }
  }

  std::string name_;
  std::unique_ptr<sqlite3, CloseSqlite> database_;
  Statement data_;  ///< goes before the database
  std::map<int64_t, uint32_t> ids_;
};

}  // namespace

bool IsSqlite(std::string_view bytes) { return bytes.substr(0, kMagic.size()) == kMagic; }

std::unique_ptr<Ros2File> OpenSqlite(const std::string& path, const std::string& name) {
  return std::make_unique<SqliteFile>(path, name);
}

}  // namespace imu_pose_calib
