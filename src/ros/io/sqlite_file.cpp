#include <sqlite3.h>

#include <boost/algorithm/string/replace.hpp>
#include <filesystem>
#include <map>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

struct CloseSqlite {
  void operator()(sqlite3* database) const { sqlite3_close(database); }
  void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
};
using Statement = std::unique_ptr<sqlite3_stmt, CloseSqlite>;

/// A database of SQLite that is open.
class Database {
 public:
  /// `failure` begins the texts of errors.
  Database(const std::string& path, int flags, const std::string& failure) : failure_(failure) {
    sqlite3* database = nullptr;
    const int status = sqlite3_open_v2(path.c_str(), &database, flags, nullptr);
    database_.reset(database);
    Check(status);
  }

  sqlite3* get() const { return database_.get(); }

  [[noreturn]] void Fail(const std::string& text) const { Reject(failure_, text); }

  void Check(int status) const {
    if (status != SQLITE_OK) Reject(failure_, sqlite3_errmsg(get()), " (SQLite, ", status, ")");
  }

  Statement Prepare(const std::string& sql) const {
    sqlite3_stmt* statement = nullptr;
    Check(sqlite3_prepare_v2(get(), sql.c_str(), -1, &statement, nullptr));
    return Statement(statement);
  }

  /// False after the last row.
  bool Step(const Statement& statement) const {
    const int status = sqlite3_step(statement.get());
    if (status != SQLITE_DONE && status != SQLITE_ROW) Check(status);
    return status == SQLITE_ROW;
  }

  void Run(const char* sql) const { Check(sqlite3_exec(get(), sql, nullptr, nullptr, nullptr)); }

 private:
  std::string failure_;
  std::unique_ptr<sqlite3, CloseSqlite> database_;
};

// --- Reading ---

/// "file:PATH?...", as SQLite opens it for reading. Nothing is written beside a database that
/// cannot change; else there may be changes beside it that it does not hold yet.
std::string ReadingUri(const std::string& path) {
  std::string uri = std::filesystem::absolute(path);
  for (const auto& [mark, escape] : {std::pair("%", "%25"), {"?", "%3f"}, {"#", "%23"}})
    boost::replace_all(uri, mark, escape);
  bool has_changes = false;
  for (const char* ending : {"-wal", "-journal"}) {
    std::error_code error;
    has_changes = has_changes || (std::filesystem::file_size(path + ending, error) > 0 && !error);
  }
  return "file:" + uri + (has_changes ? "?mode=ro" : "?mode=ro&immutable=1");
}

class SqliteFile final : public BagFile {
 public:
  SqliteFile(const std::string& path, const std::string& name)
      : database_(ReadingUri(path), SQLITE_OPEN_READONLY | SQLITE_OPEN_URI,
                  "'" + name + "' is no bag of ROS 2, or damaged: ") {
    sqlite3_db_config(database_.get(), SQLITE_DBCONFIG_DEFENSIVE, 1, nullptr);
    database_.Run("PRAGMA trusted_schema=OFF; PRAGMA cell_size_check=ON");
    for (const std::string table : {"topics", "messages"})  // a view could never end
      if (!database_.Step(database_.Prepare(
              "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = '" + table + "'")))
        database_.Fail("it has no table " + table);
    std::map<int64_t, uint32_t> ids;
    const Statement topics =
        database_.Prepare("SELECT id, name, type, serialization_format FROM topics");
    while (database_.Step(topics)) {
      ids[Integer(topics, 0)] = static_cast<uint32_t>(topics_.size());
      topics_.push_back({Text(topics, 1), Ros1Type(Text(topics, 2), Text(topics, 3)), {}});
    }
    const Statement messages = database_.Prepare("SELECT rowid, topic_id, timestamp FROM messages");
    while (database_.Step(messages)) {
      const auto topic = ids.find(Integer(messages, 1));
      if (topic == ids.end())
        database_.Fail("a message is of topic " + std::to_string(Integer(messages, 1)) +
                       ", which is unknown");
      entries_.push_back(
          {Integer(messages, 2), topic->second, 0, static_cast<uint64_t>(Integer(messages, 0)), 0});
    }
    data_ = database_.Prepare("SELECT data FROM messages WHERE rowid = ?");
  }

  std::string_view Read(const Entry& entry) override {
    const auto id = static_cast<int64_t>(entry.at);
    sqlite3_reset(data_.get());
    sqlite3_bind_int64(data_.get(), 1, id);
    if (!database_.Step(data_) || sqlite3_column_type(data_.get(), 0) != SQLITE_BLOB)
      database_.Fail("message " + std::to_string(id) + " has no data");
    const auto* data = static_cast<const char*>(sqlite3_column_blob(data_.get(), 0));
    return {data, static_cast<size_t>(sqlite3_column_bytes(data_.get(), 0))};
  }

 private:
  std::string Text(const Statement& statement, int column) const {
    if (sqlite3_column_type(statement.get(), column) != SQLITE_TEXT)
      database_.Fail("a topic has no name or type");
    const auto* text = reinterpret_cast<const char*>(sqlite3_column_text(statement.get(), column));
    return {text, static_cast<size_t>(sqlite3_column_bytes(statement.get(), column))};
  }

  int64_t Integer(const Statement& statement, int column) const {
    if (sqlite3_column_type(statement.get(), column) != SQLITE_INTEGER)
      database_.Fail("a topic or a message has no number or time");
    return sqlite3_column_int64(statement.get(), column);
  }

  Database database_;
  Statement data_;
};

// --- Writing ---

/// The tables of rosbag2.
constexpr char kTables[] = R"(
PRAGMA journal_mode=OFF;
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
BEGIN)";

class SqliteStorage final : public Ros2Storage {
 public:
  explicit SqliteStorage(const std::string& path)
      : database_(path, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE,
                  "cannot write bag '" + path + "': ") {
    database_.Run(kTables);
    topic_ = database_.Prepare("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')");
    message_ = database_.Prepare("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)");
  }

  void AddTopic(const std::string& name, const std::string& type, const std::string&) override {
    sqlite3_bind_int64(topic_.get(), 1, ++topics_);
    sqlite3_bind_text(topic_.get(), 2, name.c_str(), -1, SQLITE_TRANSIENT);
    sqlite3_bind_text(topic_.get(), 3, type.c_str(), -1, SQLITE_TRANSIENT);
    Insert(topic_);
  }

  void Write(uint32_t topic, int64_t t_ns, const std::string& data) override {
    sqlite3_bind_int64(message_.get(), 1, int64_t{topic} + 1);
    sqlite3_bind_int64(message_.get(), 2, t_ns);
    sqlite3_bind_blob64(message_.get(), 3, data.data(), data.size(), SQLITE_TRANSIENT);
    Insert(message_);
  }

  void Close() override { database_.Run("COMMIT"); }

 private:
  void Insert(const Statement& statement) const {
    database_.Step(statement);
    sqlite3_reset(statement.get());
  }

  Database database_;
  Statement topic_, message_;
  int64_t topics_ = 0;
};

}  // namespace

std::unique_ptr<BagFile> OpenSqlite(const std::string& path, const std::string& name) {
  return std::make_unique<SqliteFile>(path, name);
}

std::unique_ptr<Ros2Storage> CreateSqlite(const std::string& path) {
  std::error_code ignored;
  std::filesystem::remove(path, ignored);
  return std::make_unique<SqliteStorage>(path);
}

}  // namespace imu_pose_calib
