// A recording of rosbag2: MCAP or SQLite; the first bytes show which.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

namespace groma::importer {

struct BagTopic {
  std::string name;
  std::string type;      // such as "nav_msgs/msg/Odometry"
  std::string encoding;  // of its messages; "cdr" is read
  // Of the type, in the syntax of .msg files; null: the recording has none. Shared by the topics of a type.
  std::shared_ptr<const std::string> definition;
  std::uint64_t messages = 0;
};

class Bag {
 public:
  // topic: index in topics(). The view is valid during the call.
  using Take = std::function<void(std::size_t topic, std::uint64_t log_time_ns, std::string_view message)>;

  virtual ~Bag() = default;
  [[nodiscard]] virtual const std::vector<BagTopic>& topics() const = 0;
  // The earliest time at which a message was recorded; 0 without messages.
  [[nodiscard]] virtual std::uint64_t begin_ns() const = 0;
  // Calls take() for each message, in the order of the recording. Throws io::DataError.
  virtual void read(const Take& take) = 0;
  // What is wrong with the recording although it was read, such as a missing end, known after read(); empty:
  // nothing.
  [[nodiscard]] virtual std::string damage() const = 0;
};

// Throws io::DataError or io::PermissionError.
[[nodiscard]] std::unique_ptr<Bag> open_bag(const std::filesystem::path& path);

// The files of a recording: `path` itself, or the .mcap and .db3 files of a folder. Throws
// io::DataError if there are none.
[[nodiscard]] std::vector<std::filesystem::path> bag_files(const std::filesystem::path& path);

}  // namespace groma::importer
