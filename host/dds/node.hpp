// A node of ROS 2 by Cyclone DDS alone, with a thread of its own: writing and taking allocate and wait in
// their caller's thread. Names, QoS and the texts of discovery are those of ROS 2's own middlewares.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

namespace groma::dds {

// How a node announces itself to `ros2 node list`: the format differs between Humble and later releases.
enum class Graph : std::uint8_t { kOff, kHumble, kIron };

// As of ROS 2. A writer has to offer at least what a reader asks for.
struct Qos {
  bool is_reliable = true;
  bool is_latched = false;  // transient local: late readers get the last message
  std::int32_t depth = 10;
};

struct Topic {
  std::string name;  // such as "/groma/pose"
  std::string type;  // such as "nav_msgs/msg/Odometry"
  Qos qos;
};

struct Setup {
  std::uint32_t domain_id = 0;
  std::string name_space = "/groma";
  std::string name = "localizer";
  Graph graph = Graph::kOff;
  std::vector<Topic> outputs;
  std::vector<Topic> inputs;
  // Both are called on the node's thread. A message of an input, by its index; and after each wake().
  std::function<void(std::size_t input, std::string_view cdr)> on_message;
  std::function<void()> on_wake;
};

class Node {
 public:
  // Throws std::runtime_error with the problem and what to do. The user's CYCLONEDDS_URI comes after the
  // node's own settings.
  explicit Node(Setup setup);
  ~Node();
  Node(const Node&) = delete;
  Node& operator=(const Node&) = delete;

  // Calls on_wake on the node's thread. From any thread; allocates nothing and never waits.
  void wake() noexcept;

  // Sends a message (CDR). Only on the node's thread, within on_message and on_wake.
  void write(std::size_t output, std::string_view cdr);

  // Of all outputs: messages that DDS refused.
  [[nodiscard]] std::uint64_t refused() const noexcept;

 private:
  class State;
  std::unique_ptr<State> state_;
};

// The text that endpoints of a type carry since ROS 2 Iron, such as "RIHS01_3cc97d..."; empty: not known.
[[nodiscard]] std::string_view type_hash(std::string_view type) noexcept;
// "nav_msgs/msg/Odometry" as DDS has it: "nav_msgs::msg::dds_::Odometry_".
[[nodiscard]] std::string dds_type_name(std::string_view type);

}  // namespace groma::dds
