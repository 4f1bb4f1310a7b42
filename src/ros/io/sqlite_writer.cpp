#include <sqlite3.h>

#include <filesystem>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/io/ros2_writer.h"

namespace imu_pose_calib {
namespace {

struct CloseSqlite {
  void operator()(sqlite3* database) const { sqlite3_close(database); }
  void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
};
using Statement = std::unique_ptr<sqlite3_stmt, CloseSqlite>;

/// The tables of rosbag2.
constexpr char kTables[] = R"(
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
BEGIN)";

class SqliteStorage : public Ros2Storage {
 public:
  explicit SqliteStorage(const std::string& path) : path_(path) {
    std::error_code ignored;
    std::filesystem::remove(path, ignored);
    sqlite3* database = nullptr;
    const int status = sqlite3_open_v2(
        path.c_str(), &database, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE, nullptr);
    database_.reset(database);
    Check(status);
    Run("PRAGMA journal_mode=OFF");
    Run(kTables);
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

  void Close() override { Run("COMMIT"); }

 private:
  void Check(int status) const {
    if (status != SQLITE_OK)
      throw InputError("cannot write bag '" + path_ + "': " + sqlite3_errmsg(database_.get()));
  }

  void Run(const char* sql) const {
    Check(sqlite3_exec(database_.get(), sql, nullptr, nullptr, nullptr));
  }

  Statement Prepare(const char* sql) const {
    sqlite3_stmt* statement = nullptr;
    Check(sqlite3_prepare_v2(database_.get(), sql, -1, &statement, nullptr));
    return Statement(statement);
  }

  void Insert(sqlite3_stmt* statement) const {
    const int status = sqlite3_step(statement);
    Check(status == SQLITE_DONE ? SQLITE_OK : status);
    sqlite3_reset(statement);
  }

  std::string path_;
  std::unique_ptr<sqlite3, CloseSqlite> database_;
  Statement topic_, message_;  ///< go before the database
  int64_t topics_ = 0;
};

}  // namespace

std::unique_ptr<Ros2Storage> CreateSqlite(const std::string& path) {
  return std::make_unique<SqliteStorage>(path);
}

}  // namespace imu_pose_calib
