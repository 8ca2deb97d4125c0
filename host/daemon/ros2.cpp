#include "host/daemon/ros2.hpp"

#include <fmt/format.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include <boost/lockfree/spsc_queue.hpp>
#include <nlohmann/json.hpp>

#include "host/daemon/log_doubling.hpp"
#include "host/daemon/ros2_input.hpp"
#include "host/daemon/ros2_status.hpp"
#include "host/dds/node.hpp"
#include "host/io/descriptor.hpp"
#include "host/ros2/messages.hpp"
#include "host/ros2/time.hpp"

namespace groma::daemon {
namespace {

constexpr std::size_t kMaxStatus = 1 << 18;  // bytes of lines that wait for the node's thread
constexpr std::size_t kMaxLines = 1 << 17;   // bytes of lines that wait for the loop

template <typename Item, std::size_t kCapacity>
using Queue = boost::lockfree::spsc_queue<Item, boost::lockfree::capacity<kCapacity>>;

enum Out : std::size_t { kPose, kOdometry, kAnchors, kLinks, kTransforms, kDiagnostics };

// QoS as of the nodes that ROS 2 has for each.
std::vector<dds::Topic> outputs_of(const Ros2Settings& settings) {
  constexpr dds::Qos kLatched{.is_latched = true, .depth = 1};
  constexpr dds::Qos kQueued{};
  constexpr dds::Qos kTransform{.depth = 100};
  const auto own = [&](const char* name) { return fmt::format("/{}/{}", settings.name_space, name); };
  return {{own("pose"), "geometry_msgs/msg/PoseWithCovarianceStamped", kLatched},
          {own("odometry"), "nav_msgs/msg/Odometry", kQueued},
          {own("anchors"), "visualization_msgs/msg/MarkerArray", kLatched},
          {own("links"), "visualization_msgs/msg/MarkerArray", kQueued},
          {settings.tf_topic, "tf2_msgs/msg/TFMessage", kTransform},
          {std::string(ros2::kDiagnosticsTopic), "diagnostic_msgs/msg/DiagnosticArray", kQueued}};
}

Out output_of(std::string_view topic) {
  if (topic == ros2::kPoseTopic) return kPose;
  if (topic == ros2::kOdometryTopic) return kOdometry;
  if (topic == ros2::kTransformTopic) return kTransforms;
  return kDiagnostics;
}

struct InputTopic {
  Ros2Kind kind;
  std::string name;
};
std::vector<InputTopic> inputs_of(const Ros2Settings& settings) {
  std::vector<InputTopic> out;
  for (const auto& [kind, name] : {std::pair{Ros2Kind::kOdometry, settings.odometry_topic},
                                   {Ros2Kind::kImu, settings.imu_topic},
                                   {Ros2Kind::kFix, settings.fix_topic},
                                   {Ros2Kind::kPose, settings.pose_topic},
                                   {Ros2Kind::kInitialPose, settings.initialpose}}) {
    if (!name.empty()) out.push_back({kind, name});
  }
  return out;
}

dds::Graph graph_of(Ros2Settings::Graph graph) {
  switch (graph) {
    case Ros2Settings::Graph::kHumble:
      return dds::Graph::kHumble;
    case Ros2Settings::Graph::kIron:
      return dds::Graph::kIron;
    default:
      return dds::Graph::kOff;
  }
}

double unix_time_s() {
  return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

}  // namespace

class Ros2::State {
 public:
  State(const Ros2Settings& settings, std::span<const model::Tag> tags)
      : settings_(settings),
        tags_(tags.begin(), tags.end()),
        inputs_(inputs_of(settings)),
        input_(settings),
        messages_(frames(), settings.publishes_tf),
        node_(setup()) {}

  // ---- the loop's thread

  void put(const PoseEstimate& pose) noexcept {
    if (!poses_.push(pose)) ++poses_left_out_;
    node_.wake();
  }

  void put_line(std::string_view line) noexcept {
    if (!line.starts_with("{\"class\":\"STATUS\"") || status_.write_available() < line.size()) return;
    status_.push(line.data(), line.size());
    node_.wake();
  }

  void put(const model::Calibration& calibration) {
    {
      const std::lock_guard lock(mutex_);
      next_calibration_ = calibration;
    }
    node_.wake();
  }

  [[nodiscard]] int lines_fd() const noexcept { return lines_fd_.get(); }

  std::size_t read_lines(std::span<std::uint8_t> out) noexcept {
    std::size_t bytes = lines_.pop(out.data(), out.size());
    if (bytes == out.size()) return bytes;
    // Empty: until the next line, unless it has come meanwhile.
    std::uint64_t ignored = 0;
    static_cast<void>(!::read(lines_fd_.get(), &ignored, sizeof(ignored)));
    return bytes + lines_.pop(out.data() + bytes, out.size() - bytes);
  }

  [[nodiscard]] Ros2Counters counters() {
    const std::lock_guard lock(mutex_);
    return {lines_taken_, refused_, poses_left_out_ + lines_left_out_ + node_.refused()};
  }

  // What a user should know of, since the last call.
  std::string take_news() {
    std::string news;
    const auto add = [&news](std::string_view text) {
      news += news.empty() ? "" : "; ";
      news += text;
    };
    const std::lock_guard lock(mutex_);
    if (reported_refused_.is_due(refused_))
      add(fmt::format("ros2: {} messages not used so far; the last: {}", refused_, problem_));
    if (reported_left_out_.is_due(poses_left_out_ + lines_left_out_ + node_.refused()))
      add(
          fmt::format("ros2: {} poses and {} messages left out so far, because this computer is too slow; {} "
                      "refused by DDS",
                      poses_left_out_.load(), lines_left_out_.load(), node_.refused()));
    if (!time_problem_.empty()) add(std::exchange(time_problem_, ""));
    return news;
  }

 private:
  [[nodiscard]] ros2::Frames frames() const {
    return {.map = map_frame_, .odom = settings_.odom_frame, .base = settings_.base_frame};
  }

  [[nodiscard]] dds::Setup setup() {
    dds::Setup setup{.domain_id = settings_.domain_id,
                     .name_space = '/' + settings_.name_space,
                     .graph = graph_of(settings_.graph),
                     .outputs = outputs_of(settings_)};
    for (const InputTopic& input : inputs_) {
      // Best effort matches each writer.
      setup.inputs.push_back({input.name,
                              std::string(ros2_type(input.kind)),
                              {.is_reliable = input.kind == Ros2Kind::kInitialPose, .depth = 50}});
    }
    setup.on_message = [this](std::size_t input, std::string_view cdr) { take(inputs_.at(input).kind, cdr); };
    setup.on_wake = [this] { publish(); };
    return setup;
  }

  // ---- the node's thread

  void take(Ros2Kind kind, std::string_view cdr) {
    const std::string line = input_.take(kind, cdr);
    {
      const std::lock_guard lock(mutex_);
      lines_taken_ = input_.counters().lines;
      refused_ = input_.counters().refused;
      problem_ = input_.last_problem();
    }
    if (line.empty()) return;
    if (lines_.write_available() < line.size()) {
      ++lines_left_out_;
      return;
    }
    lines_.push(reinterpret_cast<const std::uint8_t*>(line.data()), line.size());
    const std::uint64_t one = 1;
    static_cast<void>(!::write(lines_fd_.get(), &one, sizeof(one)));
  }

  void publish() {
    publish_calibration();
    poses_.consume_all([this](const PoseEstimate& pose) {
      check_time(pose.t_s);
      last_ = localization_of(pose);
      messages_.put(*last_, [this](std::string_view topic, std::string_view, double, std::string_view cdr) {
        node_.write(output_of(topic), cdr);
      });
    });
    status_.consume_all([this](char c) {
      if (c != '\n') {
        line_ += c;
        return;
      }
      publish_status(line_);
      line_.clear();
    });
  }

  void publish_calibration() {
    std::optional<model::Calibration> next;
    {
      const std::lock_guard lock(mutex_);
      next.swap(next_calibration_);
    }
    if (!next) return;
    calibration_ = *std::move(next);
    if (calibration_.frame != map_frame_) {
      map_frame_ = calibration_.frame;
      input_.set_map_frame(map_frame_);
      messages_ = ros2::LocalizationMessages(frames(), settings_.publishes_tf);
    }
    node_.write(kAnchors, ros2::anchor_markers(calibration_));
  }

  void publish_status(const std::string& line) {
    const nlohmann::ordered_json status = nlohmann::ordered_json::parse(line, nullptr, false);
    if (!status.is_object()) return;
    const nlohmann::ordered_json& time = status.at("t_s");
    const double t_s = time.is_number() ? time.get<double>() : unix_time_s();
    if (!ros2::has_timestamp(t_s)) return;
    node_.write(kDiagnostics, ros2::diagnostics_message(diagnostics_of(status), t_s));
    if (last_)
      node_.write(kLinks, ros2::link_markers(links_of(status, calibration_, tags_, last_->pose), last_->t_s,
                                             map_frame_));
  }

  // Once: nodes of ROS 2 drop messages and transforms of another time.
  void check_time(double t_s) {
    constexpr double kDay_s = 86400.0;
    if (time_checked_ || std::abs(t_s - unix_time_s()) < kDay_s) return;
    time_checked_ = true;
    const std::lock_guard lock(mutex_);
    time_problem_ = fmt::format(
        "ros2: t_s of odometry is {:.0f}, not the time since 1970, so that other nodes will not use "
        "the poses; set the robot's clock, or send t_s in seconds since 1970",
        t_s);
  }

  Ros2Settings settings_;
  std::vector<model::Tag> tags_;
  std::vector<InputTopic> inputs_;

  // Between the threads.
  Queue<PoseEstimate, kMaxPoses> poses_;
  Queue<char, kMaxStatus> status_;
  Queue<std::uint8_t, kMaxLines> lines_;
  io::Descriptor lines_fd_{::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)};
  std::atomic<std::uint64_t> poses_left_out_ = 0;
  std::atomic<std::uint64_t> lines_left_out_ = 0;
  std::mutex mutex_;  // of the following
  std::optional<model::Calibration> next_calibration_;
  std::uint64_t lines_taken_ = 0;
  std::uint64_t refused_ = 0;
  std::string problem_;
  std::string time_problem_;

  // Of the loop's thread.
  LogDoubling reported_refused_;
  LogDoubling reported_left_out_;

  // Of the node's thread.
  std::string map_frame_ = "map";
  Ros2Input input_;
  ros2::LocalizationMessages messages_;
  model::Calibration calibration_;
  std::optional<ros2::Localization> last_;
  std::string line_;
  bool time_checked_ = false;
  dds::Node node_;  // last: its thread uses the others
};

namespace {

class Ros2Link : public link::ByteLink {
 public:
  using Read = std::function<std::size_t(std::span<std::uint8_t>)>;
  Ros2Link(int fd, Read read, std::function<std::string()> news)
      : fd_(fd), read_(std::move(read)), news_(std::move(news)) {}

  [[nodiscard]] int poll_fd() const noexcept override { return fd_; }
  [[nodiscard]] link::ReadResult read(std::span<std::uint8_t> out) override { return {read_(out), false}; }
  // Only for reading: what is written to it is discarded.
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override { return bytes.size(); }
  [[nodiscard]] std::string take_news() override { return news_(); }

 private:
  int fd_;
  Read read_;
  std::function<std::string()> news_;
};

}  // namespace

Ros2::Ros2(std::unique_ptr<State> state) : state_(std::move(state)) {}
Ros2::~Ros2() = default;

Ros2::Opened Ros2::open(const Ros2Settings& settings, std::span<const model::Tag> tags) {
  try {
    return {std::unique_ptr<Ros2>(new Ros2(std::make_unique<State>(settings, tags))), {}};
  } catch (const std::runtime_error& error) {
    return {nullptr, {link::LinkFault::kUnsuitable, error.what()}};
  }
}

Ros2Counters Ros2::counters() const {
  return state_->counters();
}

std::unique_ptr<link::ByteLink> Ros2::make_link() {
  return std::make_unique<Ros2Link>(
      state_->lines_fd(),
      [state = state_.get()](std::span<std::uint8_t> out) { return state->read_lines(out); },
      [state = state_.get()] { return state->take_news(); });
}

void Ros2::on_pose(const PoseEstimate& pose, std::string_view /*line*/) {
  state_->put(pose);
}
void Ros2::on_line(std::string_view line) {
  state_->put_line(line);
}
void Ros2::on_calibration(const model::Calibration& calibration) {
  state_->put(calibration);
}

}  // namespace groma::daemon
