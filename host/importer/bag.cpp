#include "host/importer/bag.hpp"

#include <fmt/format.h>
#include <sqlite3.h>

#include <algorithm>
#include <cerrno>
#include <fstream>
#include <map>
#include <optional>
#include <utility>

#include "host/io/error.hpp"
#include "host/mcap/reader.hpp"

namespace groma::importer {

namespace {

constexpr std::string_view kZstdMagic = "\x28\xB5\x2F\xFD";
constexpr std::string_view kSqliteMagic = "SQLite format 3";
constexpr int kMaxMessageBytes = 512 << 20;
constexpr const char* kDefinitions = "ros2msg";

std::ifstream open(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  if (file) return file;
  if (errno == EACCES) throw io::PermissionError({path}, "cannot be read", "allow this user to read it");
  throw io::DataError({path}, "cannot be read", "check the path");
}

class McapBag final : public Bag {
 public:
  explicit McapBag(std::filesystem::path path) : path_(std::move(path)) {
    std::ifstream file = open(path_);
    std::optional<mcap::Content> content =
        mcap::read(file, [&](std::uint16_t /*channel*/, std::uint64_t time_ns, std::string_view /*data*/) {
          begin_ns_ = std::min(begin_ns_.value_or(time_ns), time_ns);
        });
    if (!content) throw io::DataError({path_}, "is no MCAP file", "give a recording of rosbag2");
    for (auto& [id, channel] : content->channels) {
      topic_of_[id] = topics_.size();
      BagTopic& topic = topics_.emplace_back();
      topic.name = std::move(channel.topic);
      topic.type = channel.schema->name;
      topic.encoding = std::move(channel.message_encoding);
      // Aliases the schema, which is kept as a whole.
      if (channel.schema->encoding == kDefinitions && !channel.schema->data.empty())
        topic.definition = {channel.schema, &channel.schema->data};
      topic.messages = channel.messages;
    }
    if (content->damaged > 0)
      damage_ = fmt::format("{} chunks or records are damaged and were skipped, first {}", content->damaged,
                            content->first_damage);
    if (!content->is_complete)
      damage_ +=
          fmt::format("{}the file is not complete from byte {} on; all messages that are there were read",
                      damage_.empty() ? "" : "; ", content->end);
  }

  [[nodiscard]] const std::vector<BagTopic>& topics() const override { return topics_; }
  [[nodiscard]] std::uint64_t begin_ns() const override { return begin_ns_.value_or(0); }
  [[nodiscard]] std::string damage() const override { return damage_; }

  void read(const Take& take) override {
    std::ifstream file = open(path_);
    static_cast<void>(
        mcap::read(file, [&](std::uint16_t channel, std::uint64_t log_time_ns, std::string_view data) {
          const auto topic = topic_of_.find(channel);
          if (topic != topic_of_.end()) take(topic->second, log_time_ns, data);
        }));
  }

 private:
  std::filesystem::path path_;
  std::vector<BagTopic> topics_;
  std::map<std::uint16_t, std::size_t> topic_of_;  // by channel
  std::optional<std::uint64_t> begin_ns_;
  std::string damage_;
};

class SqliteBag final : public Bag {
 public:
  explicit SqliteBag(std::filesystem::path path) : path_(std::move(path)) {
    sqlite3* raw = nullptr;
    const int code = sqlite3_open_v2(path_.c_str(), &raw, SQLITE_OPEN_READONLY, nullptr);
    database_.reset(raw);
    if (code != SQLITE_OK) fail();
    // The file may come from anyone: it gets no views, no functions in its schema, and no values of any size.
    sqlite3_db_config(raw, SQLITE_DBCONFIG_ENABLE_VIEW, 0, nullptr);
    sqlite3_db_config(raw, SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0, nullptr);
    sqlite3_limit(raw, SQLITE_LIMIT_LENGTH, kMaxMessageBytes);
    each_row("PRAGMA cell_size_check = ON", [](sqlite3_stmt* /*row*/) {});
    // A file that was cut can then be read up to its end.
    each_row("PRAGMA writable_schema = ON", [](sqlite3_stmt* /*row*/) {});
    if (!has_table("topics") || !has_table("messages"))
      throw io::DataError({path_}, "is no recording of rosbag2: it lacks the tables topics and messages",
                          "give a file that ros2 bag record has written");
    std::map<std::string, std::shared_ptr<const std::string>, std::less<>> definitions;  // by type
    if (has_table("message_definitions")) {
      each_row("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions",
               [&](sqlite3_stmt* row) {
                 if (text(row, 1) == kDefinitions)
                   definitions.emplace(text(row, 0), std::make_shared<const std::string>(text(row, 2)));
               });
    }
    each_row("SELECT id, name, type, serialization_format FROM topics ORDER BY id", [&](sqlite3_stmt* row) {
      topic_of_[sqlite3_column_int64(row, 0)] = topics_.size();
      const auto definition = definitions.find(text(row, 2));
      topics_.push_back({std::string(text(row, 1)), std::string(text(row, 2)), std::string(text(row, 3)),
                         definition == definitions.end() ? nullptr : definition->second, 0});
    });
    try {
      each_row("SELECT topic_id, COUNT(*), MIN(timestamp) FROM messages GROUP BY topic_id",
               [&](sqlite3_stmt* row) {
                 const auto topic = topic_of_.find(sqlite3_column_int64(row, 0));
                 if (topic == topic_of_.end()) return;
                 topics_[topic->second].messages = static_cast<std::uint64_t>(sqlite3_column_int64(row, 1));
                 const auto time_ns = static_cast<std::uint64_t>(sqlite3_column_int64(row, 2));
                 begin_ns_ = std::min(begin_ns_.value_or(time_ns), time_ns);
               });
    } catch (const io::DataError&) {
      // read() says what is damaged. Until then each topic may have messages.
      for (BagTopic& topic : topics_) topic.messages = std::max<std::uint64_t>(topic.messages, 1);
    }
  }

  [[nodiscard]] const std::vector<BagTopic>& topics() const override { return topics_; }
  [[nodiscard]] std::uint64_t begin_ns() const override { return begin_ns_.value_or(0); }
  [[nodiscard]] std::string damage() const override { return damage_; }

  // In the order of the rows: an index may be damaged where the rows are not.
  void read(const Take& take) override {
    std::size_t count = 0;
    std::size_t damaged = 0;
    try {
      each_row("SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id",
               [&](sqlite3_stmt* row) {
                 const auto topic = topic_of_.find(sqlite3_column_int64(row, 0));
                 if (topic == topic_of_.end()) return;
                 ++count;
                 const auto time_ns = static_cast<std::uint64_t>(sqlite3_column_int64(row, 1));
                 const std::string_view data = bytes(row, 2);
                 if (!data.starts_with(kZstdMagic)) return take(topic->second, time_ns, data);
                 const std::optional<std::string> message = mcap::decompress_zstd(data);
                 if (message) return take(topic->second, time_ns, *message);
                 ++damaged;
               });
    } catch (const io::DataError&) {
      if (count == 0) throw;
      damage_ = fmt::format("the file is damaged or cut; {} messages before were read", count);
    }
    if (damaged > 0)
      damage_ +=
          fmt::format("{}{} messages are damaged and were skipped", damage_.empty() ? "" : "; ", damaged);
  }

 private:
  struct Close {
    void operator()(sqlite3* database) const { sqlite3_close(database); }
    void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
  };

  [[noreturn]] void fail() const {
    throw io::DataError({path_}, fmt::format("cannot be read ({})", sqlite3_errmsg(database_.get())),
                        "copy the file again from the robot; 'sqlite3 FILE .recover' may save a damaged one");
  }

  static std::string_view bytes(sqlite3_stmt* row, int column) {
    const void* data = sqlite3_column_blob(row, column);
    const int size = sqlite3_column_bytes(row, column);
    if (data == nullptr) return {};
    return {static_cast<const char*>(data), static_cast<std::size_t>(size)};
  }
  static std::string_view text(sqlite3_stmt* row, int column) { return bytes(row, column); }

  template <typename Use>
  void each_row(const char* query, const Use& use) const {
    sqlite3_stmt* raw = nullptr;
    if (sqlite3_prepare_v2(database_.get(), query, -1, &raw, nullptr) != SQLITE_OK) fail();
    const std::unique_ptr<sqlite3_stmt, Close> statement(raw);
    for (;;) {
      const int code = sqlite3_step(raw);
      if (code == SQLITE_DONE) return;
      if (code != SQLITE_ROW) fail();
      use(raw);
    }
  }

  [[nodiscard]] bool has_table(std::string_view name) const {
    bool found = false;
    each_row("SELECT name FROM sqlite_master WHERE type = 'table'",
             [&](sqlite3_stmt* row) { found = found || text(row, 0) == name; });
    return found;
  }

  std::filesystem::path path_;
  std::unique_ptr<sqlite3, Close> database_;
  std::vector<BagTopic> topics_;
  std::map<std::int64_t, std::size_t> topic_of_;  // by id
  std::optional<std::uint64_t> begin_ns_;
  std::string damage_;
};

}  // namespace

std::unique_ptr<Bag> open_bag(const std::filesystem::path& path) {
  // Opening a pipe would wait for its writer, and a recording is read twice.
  if (!std::filesystem::is_regular_file(path))
    throw io::DataError({path}, "is not a regular file", "give a recording of rosbag2");
  std::string head(kSqliteMagic.size(), '\0');
  open(path).read(head.data(), static_cast<std::streamsize>(head.size()));
  if (head.starts_with(kSqliteMagic)) return std::make_unique<SqliteBag>(path);
  if (head.starts_with(kZstdMagic)) {
    throw io::DataError({path}, "is compressed as a whole", fmt::format("run: zstd -d {}", path.string()));
  }
  return std::make_unique<McapBag>(path);
}

std::vector<std::filesystem::path> bag_files(const std::filesystem::path& path) {
  if (!std::filesystem::exists(path)) throw io::DataError({path}, "does not exist", "check the path");
  if (!std::filesystem::is_directory(path)) return {path};
  std::vector<std::filesystem::path> files;
  for (const auto& entry : std::filesystem::directory_iterator(path)) {
    const std::string name = entry.path().filename();
    if (!entry.is_regular_file()) continue;
    if (name.ends_with(".mcap") || name.ends_with(".db3") || name.ends_with(".zstd"))
      files.push_back(entry.path());
  }
  if (files.empty())
    throw io::DataError({path}, "has no .mcap and no .db3 file", "give a recording of rosbag2");
  std::sort(files.begin(), files.end());
  return files;
}

}  // namespace groma::importer
