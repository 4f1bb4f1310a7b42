#include <sqlite3.h>

#include <filesystem>
#include <map>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/ros2_file.h"

namespace imu_pose_calib {
namespace {

constexpr std::string_view kMagic("SQLite format 3\0", 16);

struct CloseSqlite {
  void operator()(sqlite3* database) const { sqlite3_close(database); }
  void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
};
using Statement = std::unique_ptr<sqlite3_stmt, CloseSqlite>;

/// A database of SQLite that is open.
class Database {
 protected:
  ~Database() = default;

  void Open(const std::string& path, int flags) {
    sqlite3* database = nullptr;
    const int status = sqlite3_open_v2(path.c_str(), &database, flags, nullptr);
    database_.reset(database);
    Check(status);
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

  int Run(const char* sql) const {
    return sqlite3_exec(database_.get(), sql, nullptr, nullptr, nullptr);
  }

  void Check(int status) const {
    if (status != SQLITE_OK) Fail(sqlite3_errmsg(database_.get()), status);
  }

  sqlite3* get() const { return database_.get(); }

 private:
  /// Throws InputError for an error of SQLite.
  [[noreturn]] virtual void Fail(const std::string& text, int status) const = 0;

  std::unique_ptr<sqlite3, CloseSqlite> database_;
};

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

class SqliteFile final : public Ros2File, private Database {
 public:
  SqliteFile(const std::string& path, const std::string& name) : name_(name) {
    // Nothing is written beside a database that cannot change.
    const std::string uri = Uri(path, HasJournal(path) ? "?mode=ro" : "?mode=ro&immutable=1");
    Open(uri, SQLITE_OPEN_READONLY | SQLITE_OPEN_URI);
    sqlite3_db_config(get(), SQLITE_DBCONFIG_DEFENSIVE, 1, nullptr);
    Run("PRAGMA trusted_schema=OFF; PRAGMA cell_size_check=ON");
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

  [[noreturn]] void Fail(const std::string& text, int status) const override {
    Fail(text + " (SQLite, " + std::to_string(status) + ")");
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
      entries_.push_back({Integer(messages.get(), 2), topic->second, 0,
                          static_cast<uint64_t>(Integer(messages.get(), 0)), 0});
    }
  }

  std::string name_;
  Statement data_;
  std::map<int64_t, uint32_t> ids_;
};

/// The tables of rosbag2.
constexpr char kTables[] = R"(
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
BEGIN)";

class SqliteStorage final : public Ros2Storage, private Database {
 public:
  explicit SqliteStorage(const std::string& path) : path_(path) {
    std::error_code ignored;
    std::filesystem::remove(path, ignored);
    Open(path, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE);
    Check(Run("PRAGMA journal_mode=OFF"));
    Check(Run(kTables));
    topic_ = Prepare("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')");
    message_ = Prepare("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)");
  }

  void AddTopic(const std::string& name, const std::string& type, const std::string&) override {
    sqlite3_bind_int64(topic_.get(), 1, ++topics_);
    sqlite3_bind_text(topic_.get(), 2, name.c_str(), -1, SQLITE_TRANSIENT);
    sqlite3_bind_text(topic_.get(), 3, type.c_str(), -1, SQLITE_TRANSIENT);
    Insert(topic_.get());
  }

  void Write(uint32_t topic, int64_t t_ns, const std::string& data) override {
    sqlite3_bind_int64(message_.get(), 1, int64_t{topic} + 1);
    sqlite3_bind_int64(message_.get(), 2, t_ns);
    sqlite3_bind_blob64(message_.get(), 3, data.data(), data.size(), SQLITE_TRANSIENT);
    Insert(message_.get());
  }

  void Close() override { Check(Run("COMMIT")); }

 private:
  [[noreturn]] void Fail(const std::string& text, int) const override {
    throw InputError("cannot write bag '" + path_ + "': " + text);
  }

  void Insert(sqlite3_stmt* statement) const {
    Step(statement);
    sqlite3_reset(statement);
  }

  std::string path_;
  Statement topic_, message_;
  int64_t topics_ = 0;
};

}  // namespace

bool IsSqlite(std::string_view bytes) { return bytes.substr(0, kMagic.size()) == kMagic; }

std::unique_ptr<Ros2File> OpenSqlite(const std::string& path, const std::string& name) {
  return std::make_unique<SqliteFile>(path, name);
}

std::unique_ptr<Ros2Storage> CreateSqlite(const std::string& path) {
  return std::make_unique<SqliteStorage>(path);
}

}  // namespace imu_pose_calib
