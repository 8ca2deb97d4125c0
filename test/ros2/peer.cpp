// ros2-peer: stands for another node of ROS 2, by Fast DDS with the settings of rmw_fastrtps_cpp. Messages
// are bytes (CDR): whoever reads its output decodes them.
//
//   ros2-peer DOMAIN PROFILE [read|write TOPIC TYPE reliable|best-effort volatile|latched DEPTH] ...
//
// PROFILE: default, humble-localhost (ROS_LOCALHOST_ONLY=1), jazzy-localhost
// (ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST) or loopback (unicast on 127.0.0.1 alone). It prints
//
//   message TOPIC NANOSECONDS HEX        received; by CLOCK_MONOTONIC
//   reader TOPIC TYPE USER_DATA          of another participant; writers likewise
//   participant USER_DATA
//   gone                                 a participant
//   incompatible TOPIC POLICY            the QoS of a writer does not fit
//
// and reads "TOPIC HEX", a message to write, and "quit".
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastdds/rtps/transport/shared_mem/SharedMemTransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <charconv>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

namespace {

namespace dds = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using Bytes = std::vector<std::uint8_t>;

constexpr std::uint32_t kMaxMessage = 1 << 20;

// Lines of several threads do not mix.
void print(const std::string& line) {
  static std::mutex mutex;
  const std::lock_guard lock(mutex);
  std::cout << line << std::endl;
}

std::string hex(const Bytes& bytes) {
  constexpr std::string_view kDigits = "0123456789abcdef";
  std::string out;
  out.reserve(2 * bytes.size());
  for (const std::uint8_t byte : bytes) {
    out += kDigits[byte >> 4U];
    out += kDigits[byte & 15U];
  }
  return out;
}

Bytes bytes_of(std::string_view text) {
  Bytes out;
  for (std::size_t i = 0; i + 1 < text.size(); i += 2) {
    std::uint8_t byte = 0;
    std::from_chars(text.data() + i, text.data() + i + 2, byte, 16);
    out.push_back(byte);
  }
  return out;
}

class RawType : public dds::TopicDataType {
 public:
  explicit RawType(const std::string& name) {
    setName(name.c_str());
    m_typeSize = kMaxMessage;
    m_isGetKeyDefined = false;
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }

  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    const Bytes& bytes = *static_cast<Bytes*>(data);
    if (payload->max_size < bytes.size()) return false;
    std::memcpy(payload->data, bytes.data(), bytes.size());
    payload->length = static_cast<std::uint32_t>(bytes.size());
    payload->encapsulation = CDR_LE;
    return true;
  }
  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
    return true;
  }
  std::function<std::uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<std::uint32_t>(static_cast<Bytes*>(data)->size()); };
  }
  void* createData() override { return new Bytes; }
  void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
  bool getKey(void* /*data*/, rtps::InstanceHandle_t* /*key*/, bool /*md5*/) override { return false; }
};

class Discovery : public dds::DomainParticipantListener {
  void on_participant_discovery(dds::DomainParticipant* /*participant*/,
                                rtps::ParticipantDiscoveryInfo&& info) override {
    if (info.status == rtps::ParticipantDiscoveryInfo::DISCOVERED_PARTICIPANT)
      print("participant " + std::string(info.info.m_userData.begin(), info.info.m_userData.end()));
    if (info.status == rtps::ParticipantDiscoveryInfo::REMOVED_PARTICIPANT ||
        info.status == rtps::ParticipantDiscoveryInfo::DROPPED_PARTICIPANT)
      print("gone");
  }
  template <typename Info>
  static void show(const char* kind, Info& info) {
    const auto& user_data = info.m_qos.m_userData.getValue();
    print(std::string(kind) + ' ' + info.topicName().to_string() + ' ' + info.typeName().to_string() + ' ' +
          std::string(user_data.begin(), user_data.end()));
  }
  void on_subscriber_discovery(dds::DomainParticipant* /*participant*/,
                               rtps::ReaderDiscoveryInfo&& info) override {
    if (info.status == rtps::ReaderDiscoveryInfo::DISCOVERED_READER) show("reader", info.info);
  }
  void on_publisher_discovery(dds::DomainParticipant* /*participant*/,
                              rtps::WriterDiscoveryInfo&& info) override {
    if (info.status == rtps::WriterDiscoveryInfo::DISCOVERED_WRITER) show("writer", info.info);
  }
};

class Printer : public dds::DataReaderListener {
  void on_data_available(dds::DataReader* reader) override {
    dds::SampleInfo info;
    Bytes bytes;
    while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data) continue;
      const auto now = std::chrono::steady_clock::now().time_since_epoch();
      print("message " + reader->get_topicdescription()->get_name() + ' ' +
            std::to_string(std::chrono::nanoseconds(now).count()) + ' ' + hex(bytes));
    }
  }
  void on_requested_incompatible_qos(dds::DataReader* reader,
                                     const dds::RequestedIncompatibleQosStatus& status) override {
    print("incompatible " + reader->get_topicdescription()->get_name() + ' ' +
          std::to_string(status.last_policy_id));
  }
};

void set_transports(const std::string& profile, dds::DomainParticipantQos& qos) {
  if (profile == "default") return;
  auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  qos.transport().use_builtin_transports = false;
  auto& builtin = qos.wire_protocol().builtin;
  rtps::Locator_t here;
  rtps::IPLocator::setIPv4(here, "127.0.0.1");
  if (profile == "humble-localhost") {
    udp->interfaceWhiteList.emplace_back("127.0.0.1");
  } else if (profile == "jazzy-localhost") {
    builtin.metatrafficUnicastLocatorList.push_back(rtps::Locator_t());
    udp->maxInitialPeersRange = 32;
    builtin.initialPeersList.push_back(here);
  } else if (profile == "loopback") {
    udp->interfaceWhiteList.emplace_back("127.0.0.1");
    udp->maxInitialPeersRange = 10;
    builtin.metatrafficUnicastLocatorList.push_back(rtps::Locator_t());
    builtin.initialPeersList.push_back(here);
  } else {
    throw std::runtime_error("there is no profile " + profile);
  }
  qos.transport().user_transports.push_back(udp);
  if (profile != "loopback")
    qos.transport().user_transports.push_back(
        std::make_shared<eprosima::fastdds::rtps::SharedMemTransportDescriptor>());
}

struct Endpoint {
  std::string kind, topic, type, reliability, durability;
  int depth = 1;
};

template <typename Qos>
void set_qos(const Endpoint& endpoint, Qos& qos) {
  qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
  qos.data_sharing().off();
  qos.reliability().kind =
      endpoint.reliability == "reliable" ? dds::RELIABLE_RELIABILITY_QOS : dds::BEST_EFFORT_RELIABILITY_QOS;
  qos.durability().kind =
      endpoint.durability == "latched" ? dds::TRANSIENT_LOCAL_DURABILITY_QOS : dds::VOLATILE_DURABILITY_QOS;
  qos.history().kind = dds::KEEP_LAST_HISTORY_QOS;
  qos.history().depth = endpoint.depth;
}

void run(int argc, char** argv) {
  if (argc < 3 || (argc - 3) % 6 != 0) throw std::runtime_error("usage: see the source");
  auto* const factory = dds::DomainParticipantFactory::get_instance();
  dds::DomainParticipantQos participant_qos = factory->get_default_participant_qos();
  set_transports(argv[2], participant_qos);
  const std::string enclave = "enclave=/;";
  participant_qos.user_data().setValue(Bytes(enclave.begin(), enclave.end()));
  participant_qos.name("/");
  Discovery discovery;
  Printer printer;
  auto* const participant = factory->create_participant(static_cast<std::uint32_t>(std::stoi(argv[1])),
                                                        participant_qos, &discovery, dds::StatusMask::none());
  if (participant == nullptr) throw std::runtime_error("there is no participant");
  auto* const publisher = participant->create_publisher(dds::PUBLISHER_QOS_DEFAULT);
  auto* const subscriber = participant->create_subscriber(dds::SUBSCRIBER_QOS_DEFAULT);
  std::map<std::string, dds::DataWriter*> writers;
  for (int i = 3; i < argc; i += 6) {
    const Endpoint endpoint{argv[i],     argv[i + 1], argv[i + 2],
                            argv[i + 3], argv[i + 4], std::stoi(argv[i + 5])};
    dds::TypeSupport type(new RawType(endpoint.type));
    type.register_type(participant);
    auto* topic = static_cast<dds::Topic*>(participant->lookup_topicdescription(endpoint.topic));
    if (topic == nullptr)
      topic = participant->create_topic(endpoint.topic, endpoint.type, dds::TOPIC_QOS_DEFAULT);
    if (endpoint.kind == "read") {
      dds::DataReaderQos qos = subscriber->get_default_datareader_qos();
      set_qos(endpoint, qos);
      if (subscriber->create_datareader(topic, qos, &printer) == nullptr)
        throw std::runtime_error("no reader of " + endpoint.topic);
    } else {
      dds::DataWriterQos qos = publisher->get_default_datawriter_qos();
      set_qos(endpoint, qos);
      qos.publish_mode().kind = dds::SYNCHRONOUS_PUBLISH_MODE;
      writers[endpoint.topic] = publisher->create_datawriter(topic, qos);
      if (writers[endpoint.topic] == nullptr) throw std::runtime_error("no writer of " + endpoint.topic);
    }
  }
  print("ready");
  for (std::string line; std::getline(std::cin, line) && line != "quit";) {
    std::istringstream words(line);
    std::string topic;
    std::string text;
    words >> topic >> text;
    Bytes bytes = bytes_of(text);
    if (!writers.at(topic)->write(&bytes)) print("not written " + topic);
  }
  participant->delete_contained_entities();
  factory->delete_participant(participant);
}

}  // namespace

int main(int argc, char** argv) {
  try {
    run(argc, argv);
  } catch (const std::exception& error) {
    std::cerr << "ros2-peer: " << error.what() << '\n';
    return 1;
  }
  return 0;
}
