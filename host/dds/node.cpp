#include "host/dds/node.hpp"

#include <dds/dds.h>
#include <fmt/format.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdlib>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>

#include "host/dds/raw_type.hpp"
#include "host/io/descriptor.hpp"
#include "host/ros2/cdr_writer.hpp"

namespace groma::dds {
namespace {

// One interface that Cyclone chooses, with multicast, and unicast to this computer: so nodes with any of ROS
// 2's own settings are found, on this computer and on others. Buffers of 1 MiB, the library's own size, fill
// over minutes.
constexpr std::string_view kSettings =
    "<CycloneDDS><Domain Id=\"any\"><General><Interfaces><NetworkInterface autodetermine=\"true\"/>"
    "</Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    "<Peers><Peer address=\"localhost\"/></Peers></Discovery>"
    "<Sizing><ReceiveBufferSize>256 KiB</ReceiveBufferSize></Sizing></Domain></CycloneDDS>";

constexpr std::string_view kParticipantType = "rmw_dds_common/msg/ParticipantEntitiesInfo";
constexpr std::string_view kParticipantTopic = "ros_discovery_info";
constexpr std::size_t kGidHumble = 24;
constexpr std::size_t kGid = 16;

// Of the definitions in github.com/ros2 (rosidl_generator_type_description); test/ros2/type_hash.py
// recomputes them.
struct TypeHash {
  std::string_view type;
  std::string_view hash;
};
constexpr std::array kTypeHashes{
    TypeHash{"diagnostic_msgs/msg/DiagnosticArray",
             "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"},
    TypeHash{"geometry_msgs/msg/PoseWithCovarianceStamped",
             "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"},
    TypeHash{"nav_msgs/msg/Odometry",
             "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"},
    TypeHash{kParticipantType, "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"},
    TypeHash{"sensor_msgs/msg/Imu",
             "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"},
    TypeHash{"sensor_msgs/msg/NavSatFix",
             "RIHS01_62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404"},
    TypeHash{"tf2_msgs/msg/TFMessage",
             "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"},
    TypeHash{"visualization_msgs/msg/MarkerArray",
             "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf"}};

struct QosDeleter {
  void operator()(dds_qos_t* qos) const { dds_delete_qos(qos); }
};
using QosHandle = std::unique_ptr<dds_qos_t, QosDeleter>;

QosHandle qos_of(const Qos& of, std::string_view type) {
  QosHandle qos(dds_create_qos());
  dds_qset_writer_data_lifecycle(qos.get(), false);
  dds_qset_history(qos.get(), DDS_HISTORY_KEEP_LAST, of.depth);
  // Without waiting for slow readers: the history keeps the last messages only.
  dds_qset_reliability(qos.get(), of.is_reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT, 0);
  if (of.is_latched) {
    dds_qset_durability(qos.get(), DDS_DURABILITY_TRANSIENT_LOCAL);
    dds_qset_durability_service(qos.get(), 0, DDS_HISTORY_KEEP_LAST, of.depth, DDS_LENGTH_UNLIMITED,
                                DDS_LENGTH_UNLIMITED, DDS_LENGTH_UNLIMITED);
  }
  // Never empty: ROS 2 Iron to Kilted warn of each endpoint without it.
  const std::string user_data = fmt::format("typehash={};", type_hash(type));
  dds_qset_userdata(qos.get(), user_data.data(), user_data.size());
  return qos;
}

void wake_by(int fd) noexcept {
  const std::uint64_t one = 1;
  static_cast<void>(!::write(fd, &one, sizeof(one)));
}

}  // namespace

std::string_view type_hash(std::string_view type) noexcept {
  const auto found = std::find_if(kTypeHashes.begin(), kTypeHashes.end(),
                                  [type](const TypeHash& of) { return of.type == type; });
  return found == kTypeHashes.end() ? std::string_view() : found->hash;
}

std::string dds_type_name(std::string_view type) {
  std::string out;
  for (const char c : type) {
    if (c == '/') {
      out += "::";
    } else {
      out += c;
    }
  }
  out.insert(out.rfind("::") + 2, "dds_::");
  return out + '_';
}

class Node::State {
 public:
  explicit State(Setup setup) : setup_(std::move(setup)) {
    if (!wake_fd_.valid())
      throw std::runtime_error("there is no descriptor for ROS 2; raise the limit of open files");
    create_participant();
    for (const Topic& topic : setup_.outputs) writers_.push_back(create_writer(topic));
    create_readers();
    announce();
    thread_ = std::thread([this] { run(); });
  }

  ~State() {
    stopped_ = true;
    wake();
    thread_.join();
    // Its callbacks write to wake_fd_.
    dds_delete(participant_);
    dds_delete(domain_);
  }

  State(const State&) = delete;
  State& operator=(const State&) = delete;

  void wake() noexcept {
    asked_ = true;
    wake_by(wake_fd_.get());
  }

  void write(std::size_t output, std::string_view cdr) {
    if (dds_write(writers_.at(output), &cdr) != DDS_RETCODE_OK) ++refused_;
  }

  [[nodiscard]] std::uint64_t refused() const noexcept { return refused_; }

 private:
  dds_entity_t expect(dds_entity_t result, std::string_view what) const {
    if (result >= 0) return result;
    const std::string problem =
        fmt::format("ROS 2, domain {}: {}: {}; check the network interfaces and CYCLONEDDS_URI",
                    setup_.domain_id, what, dds_strretcode(-result));
    if (participant_ > 0) dds_delete(participant_);
    if (domain_ > 0) dds_delete(domain_);
    throw std::runtime_error(problem);
  }

  void create_participant() {
    const char* const environment = std::getenv("CYCLONEDDS_URI");
    const std::string settings = fmt::format("{}{}{}", kSettings, environment != nullptr ? "," : "",
                                             environment != nullptr ? environment : "");
    domain_ = expect(dds_create_domain(setup_.domain_id, settings.c_str()), "the domain cannot be entered");
    const QosHandle qos(dds_create_qos());
    constexpr std::string_view kEnclave = "enclave=/;";
    dds_qset_userdata(qos.get(), kEnclave.data(), kEnclave.size());
    participant_ =
        expect(dds_create_participant(setup_.domain_id, qos.get(), nullptr), "there is no participant");
  }

  dds_entity_t create_topic(const std::string& name, std::string_view type) {
    return expect(create_raw_topic(participant_, name, dds_type_name(type)), name);
  }

  dds_entity_t create_writer(const Topic& topic) {
    const dds_entity_t entity = create_topic("rt" + topic.name, topic.type);
    return expect(dds_create_writer(participant_, entity, qos_of(topic.qos, topic.type).get(), nullptr),
                  topic.name);
  }

  void create_readers() {
    struct Deleter {
      void operator()(dds_listener_t* listener) const { dds_delete_listener(listener); }
    };
    // Called on a thread of Cyclone's, which takes nothing.
    const std::unique_ptr<dds_listener_t, Deleter> listener(dds_create_listener(this));
    dds_lset_data_available(listener.get(), [](dds_entity_t, void* state) {
      wake_by(static_cast<State*>(state)->wake_fd_.get());
    });
    for (const Topic& topic : setup_.inputs) {
      const dds_entity_t entity = create_topic("rt" + topic.name, topic.type);
      readers_.push_back(
          expect(dds_create_reader(participant_, entity, qos_of(topic.qos, topic.type).get(), listener.get()),
                 topic.name));
    }
  }

  // One sample of ros_discovery_info: the node with its endpoints.
  void announce() {
    if (setup_.graph == Graph::kOff) return;
    const Qos latched{.is_reliable = true, .is_latched = true, .depth = 1};
    const dds_entity_t topic = create_topic(std::string(kParticipantTopic), kParticipantType);
    const dds_entity_t writer =
        expect(dds_create_writer(participant_, topic, qos_of(latched, kParticipantType).get(), nullptr),
               kParticipantTopic);
    ros2::CdrWriter out;
    put_gid(out, participant_);
    out.length(1).put(setup_.name_space).put(setup_.name);
    for (const auto* const entities : {&readers_, &writers_}) {
      out.length(entities->size());
      for (const dds_entity_t entity : *entities) put_gid(out, entity);
    }
    const std::string_view cdr = out.message();
    expect(dds_write(writer, &cdr), kParticipantTopic);
  }

  void put_gid(ros2::CdrWriter& out, dds_entity_t entity) const {
    dds_guid_t guid{};
    expect(dds_get_guid(entity, &guid), "an entity has no identity");
    const std::size_t size = setup_.graph == Graph::kHumble ? kGidHumble : kGid;
    const std::span<const std::uint8_t> bytes(guid.v);
    for (std::size_t i = 0; i < size; ++i) out.put(i < bytes.size() ? bytes[i] : std::uint8_t{0});
  }

  void run() {
    std::string cdr;
    while (!stopped_) {
      pollfd poll_of{.fd = wake_fd_.get(), .events = POLLIN, .revents = 0};
      static_cast<void>(::poll(&poll_of, 1, -1));
      std::uint64_t ignored = 0;
      static_cast<void>(!::read(wake_fd_.get(), &ignored, sizeof(ignored)));
      if (asked_.exchange(false) && setup_.on_wake) setup_.on_wake();
      for (std::size_t i = 0; i < readers_.size(); ++i) take_some(i, cdr);
    }
  }

  // A few at a time: a flood of messages must not hold up what is written.
  void take_some(std::size_t input, std::string& cdr) {
    constexpr int kMost = 32;
    void* sample = &cdr;
    dds_sample_info_t info{};
    for (int i = 0; i < kMost; ++i) {
      if (dds_take(readers_[input], &sample, &info, 1, 1) != 1) return;
      if (info.valid_data && setup_.on_message) setup_.on_message(input, cdr);
    }
    wake_by(wake_fd_.get());
  }

  Setup setup_;
  io::Descriptor wake_fd_{::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)};
  dds_entity_t domain_ = 0;
  dds_entity_t participant_ = 0;
  std::vector<dds_entity_t> writers_;
  std::vector<dds_entity_t> readers_;
  std::atomic<bool> stopped_ = false;
  std::atomic<bool> asked_ = false;
  std::atomic<std::uint64_t> refused_ = 0;
  std::thread thread_;
};

Node::Node(Setup setup) : state_(std::make_unique<State>(std::move(setup))) {}
Node::~Node() = default;

void Node::wake() noexcept {
  state_->wake();
}
void Node::write(std::size_t output, std::string_view cdr) {
  state_->write(output, cdr);
}
std::uint64_t Node::refused() const noexcept {
  return state_->refused();
}

}  // namespace groma::dds
