#include "firmware/core/node/node.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <string>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/sim/aes.hpp"
#include "test/firmware/air.hpp"
#include "test/firmware/fake_chip.hpp"
#include "test/firmware/other_radio.hpp"

namespace groma::node {
namespace {

using testing::FakeChip;
using testing::OtherChip;
using testing::schedule_of;
using testing::Transfer;

constexpr std::uint64_t kTicksPerUs = 63'898;

// A node's hardware except for its radio.
struct FakeHost {
  std::uint64_t time_us = 1'000;
  sim::Aes aes;
  std::vector<std::vector<std::uint8_t>> sent;
  bool link_full = false;
  std::vector<std::uint8_t> stored;
  bool store_fails = false;
  bool store_corrupts = false;
  std::size_t sent_before_store = 0;
  std::vector<Indicator> shown;
  int restarts = 0;
  int resets = 0;
  int proofs = 0;
  std::optional<Fault> fault;

  FakeHost() = default;
  FakeHost(const FakeHost&) = delete;
  FakeHost& operator=(const FakeHost&) = delete;
  virtual ~FakeHost() = default;

  // Both clocks go on, together.
  virtual void pass(std::uint64_t us) noexcept = 0;
  void pass_to(std::uint64_t us) noexcept {
    if (us > time_us) pass(us - time_us);
  }
  // Commands to the radio: transmissions and receptions.
  virtual std::size_t radio_starts() = 0;
  virtual std::size_t transmissions() = 0;
  // The radio's own time-out ends its listening.
  virtual void end_listening() = 0;
  // A frame waits to be launched.
  virtual bool is_loaded() = 0;

  std::uint64_t now_us() noexcept { return time_us; }
  std::uint64_t radio_interrupt_us() noexcept { return time_us; }
  bool link_write(std::span<const std::uint8_t> frame) noexcept {
    if (link_full) return false;
    sent.emplace_back(frame.begin(), frame.end());
    return true;
  }
  // One link alone.
  const char* configure_link(const groma_Config&) noexcept { return ""; }
  bool link_answer(std::span<const std::uint8_t> frame) noexcept { return link_write(frame); }
  void count_link(groma_Counters&) noexcept {}
  virtual bool store_config(std::span<const std::uint8_t> blob) noexcept {
    sent_before_store = sent.size();
    pass(90'000);
    if (store_fails) return false;
    stored.assign(blob.begin(), blob.end());
    if (store_corrupts && !stored.empty()) stored.back() ^= 1;
    return true;
  }
  std::size_t load_config(std::span<std::uint8_t> out) noexcept {
    if (stored.size() > out.size()) return 0;
    std::copy(stored.begin(), stored.end(), out.begin());
    return stored.size();
  }
  security::BlockCipher& cipher() noexcept { return aes; }
  void set_indicator(Indicator indicator) noexcept { shown.push_back(indicator); }
  void restart() noexcept { ++restarts; }
  ResetReason reset_reason() noexcept { return ResetReason::kWatchdog; }
  std::optional<Fault> last_fault() noexcept { return fault; }
  std::uint32_t boot_count() noexcept { return 42; }
  void proof_of_life() noexcept { ++proofs; }
  StackUse stack_use() noexcept { return {.size_bytes = 4096, .high_water_bytes = 1234}; }
};

struct FakePlatform : FakeHost {
  using Radio = dw1000::Dw1000<FakeChip>;
  static constexpr std::uint64_t kFrameTimeout = 1U << 17;

  FakeChip chip;
  std::uint64_t last_radio_command_at_store = 0;

  FakeChip& spi() noexcept { return chip; }
  void reset_radio() noexcept {
    ++resets;
    chip.reset();
  }
  void delay_us(std::uint32_t us) noexcept {
    time_us += us;
    chip.wait(us);
  }
  void pass(std::uint64_t us) noexcept override {
    time_us += us;
    chip.time += us * kTicksPerUs;
  }
  bool store_config(std::span<const std::uint8_t> blob) noexcept override {
    last_radio_command_at_store = chip.written(0x0D, 0);
    return FakeHost::store_config(blob);
  }
  std::size_t radio_starts() override { return commands(0x102); }
  std::size_t transmissions() override { return commands(0x2); }
  void end_listening() override { chip.status |= kFrameTimeout; }
  bool is_loaded() override {
    const auto last = std::find_if(chip.log.rbegin(), chip.log.rend(), [](const Transfer& t) {
      return t.write && (t.file == 0x09 || t.file == 0x0D);
    });
    return last != chip.log.rend() && last->file == 0x09;
  }

 private:
  std::size_t commands(std::uint64_t bits) {
    std::size_t n = 0;
    for (const Transfer& t : chip.log) {
      if (t.write && t.file == 0x0D && (t.word() & bits) != 0) ++n;
    }
    return n;
  }
};
static_assert(Platform<FakePlatform>);

groma_Config good_config(groma_Role role = groma_Role_ROLE_TAG) {
  groma_Config config = groma_Config_init_zero;
  config.role = role;
  config.id = role == groma_Role_ROLE_TAG ? 2 : 101;
  config.network_id = 0x1234;
  config.has_schedule = true;
  config.schedule = schedule_of(3, 4, groma_RangingMethod_METHOD_DS_FINAL);
  return config;
}

groma_NodeToHost decode(std::span<const std::uint8_t> bytes) {
  wire::FrameDecoder decoder;
  bool whole = false;
  for (const std::uint8_t byte : bytes) whole = decoder.push(byte) || whole;
  EXPECT_TRUE(whole);
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  auto stream = pb_istream_from_buffer(decoder.payload().data(), decoder.payload().size());
  EXPECT_TRUE(pb_decode(&stream, groma_NodeToHost_fields, &message));
  return message;
}

// A radio of another kind, alone or on an air with others.
struct OtherPlatform : FakeHost {
  using Radio = testing::OtherRadio;
  using Air = OtherChip::Air;

  OtherPlatform() : OtherPlatform(std::make_shared<Air>(), {.first_count = 0xFFFF'0000}) {}
  OtherPlatform(std::shared_ptr<Air> shared, const OtherChip::Settings& settings)
      : air(std::move(shared)), chip(*air, settings) {}

  OtherChip& spi() noexcept { return chip; }
  void reset_radio() noexcept { ++resets; }
  void delay_us(std::uint32_t us) noexcept { pass(us); }
  void pass(std::uint64_t us) noexcept override {
    time_us += us;
    air->now += static_cast<double>(us) * 63'897.6;
  }
  std::size_t radio_starts() override { return chip.transmissions + chip.receptions; }
  std::size_t transmissions() override { return chip.transmissions; }
  void end_listening() override { chip.advance(); }
  bool is_loaded() override { return chip.loaded; }

  std::shared_ptr<Air> air;
  OtherChip chip;
};
static_assert(Platform<OtherPlatform>);

// A node with whichever radio.
struct AnyNode {
  AnyNode() = default;
  AnyNode(const AnyNode&) = delete;
  AnyNode& operator=(const AnyNode&) = delete;
  virtual ~AnyNode() = default;
  virtual FakeHost& host() = 0;
  virtual void start() = 0;
  virtual void on_radio_interrupt() = 0;
  virtual void on_link_bytes(std::span<const std::uint8_t> bytes) = 0;
  [[nodiscard]] virtual std::uint64_t next_deadline_us() const = 0;
  virtual void on_timer() = 0;
  [[nodiscard]] virtual std::uint64_t quiet_until_us() const = 0;
  [[nodiscard]] virtual const groma_Counters& counters() const = 0;
};

template <class P>
struct NodeOn final : AnyNode {
  template <class... Args>
  explicit NodeOn(Args&&... args) : platform(std::forward<Args>(args)...) {}
  FakeHost& host() override { return platform; }
  void start() override { node.start(); }
  void on_radio_interrupt() override { node.on_radio_interrupt(); }
  void on_link_bytes(std::span<const std::uint8_t> bytes) override { node.on_link_bytes(bytes); }
  [[nodiscard]] std::uint64_t next_deadline_us() const override { return node.next_deadline_us(); }
  void on_timer() override { node.on_timer(); }
  [[nodiscard]] std::uint64_t quiet_until_us() const override { return node.quiet_until_us(); }
  [[nodiscard]] const groma_Counters& counters() const override { return node.counters(); }

  P platform;
  Node<P> node{platform, {.version = "1.2.3", .git_hash = 0xC0FFEE01}};
};

template <class P>
std::unique_ptr<AnyNode> node_on() {
  return std::make_unique<NodeOn<P>>();
}

class NodeFixture : public ::testing::Test {
 protected:
  explicit NodeFixture(std::unique_ptr<AnyNode> on) : owned_(std::move(on)) {}

  void store(const groma_Config& config) {
    host.stored.resize(kMaxConfigBytes);
    host.stored.resize(encode_config(config, host.stored));
    ASSERT_FALSE(host.stored.empty());
  }
  void command(const groma_HostToNode& message) {
    std::array<std::uint8_t, groma_HostToNode_size> payload{};
    auto stream = pb_ostream_from_buffer(payload.data(), payload.size());
    ASSERT_TRUE(pb_encode(&stream, groma_HostToNode_fields, &message));
    command(std::span(payload).first(stream.bytes_written));
  }
  void command(std::span<const std::uint8_t> payload) {
    std::vector<std::uint8_t> frame(wire::max_encoded_size(payload.size()));
    frame.resize(wire::encode_frame(payload, frame));
    // In two pieces, as a UART may deliver them.
    node.on_link_bytes(std::span(frame).first(frame.size() / 2));
    node.on_link_bytes(std::span(frame).subspan(frame.size() / 2));
  }
  void command(pb_size_t which, std::uint32_t request = 77) {
    groma_HostToNode message = groma_HostToNode_init_zero;
    message.request_id = request;
    message.which_body = which;
    command(message);
  }
  void write(const groma_Config& config) {
    groma_HostToNode message = groma_HostToNode_init_zero;
    message.request_id = 5;
    message.which_body = groma_HostToNode_write_config_tag;
    message.body.write_config = config;
    command(message);
  }
  std::vector<groma_NodeToHost> messages(pb_size_t which) {
    std::vector<groma_NodeToHost> out;
    for (const auto& bytes : host.sent) {
      const auto message = decode(bytes);
      if (message.which_body == which) out.push_back(message);
    }
    return out;
  }
  groma_Reply last_reply() {
    const auto replies = messages(groma_NodeToHost_reply_tag);
    EXPECT_FALSE(replies.empty());
    return replies.empty() ? groma_Reply groma_Reply_init_zero : replies.back().body.reply;
  }
  std::size_t radio_starts() { return host.radio_starts(); }
  std::size_t transmissions() { return host.transmissions(); }
  // Ends it by the radio's own time-out; then launches what is loaded.
  void end_listening() {
    ++receptions_ended;
    host.end_listening();
    node.on_radio_interrupt();
    launch();
  }
  void launch() {
    for (int i = 0; i < 100 && host.is_loaded(); ++i) {
      host.pass_to(node.next_deadline_us());
      node.on_timer();
    }
  }

  // Passes the radio's deadline without an event.
  void miss_event() {
    const std::uint32_t before = node.counters().radio_recoveries;
    for (int i = 0; i < 100 && node.counters().radio_recoveries == before; ++i) {
      host.pass_to(node.next_deadline_us());
      node.on_timer();
    }
  }

 private:
  std::unique_ptr<AnyNode> owned_;

 protected:
  std::size_t receptions_ended = 0;
  AnyNode& node = *owned_;
  FakeHost& host = owned_->host();
};

// With a DW1000, whose registers a test reads and writes.
class NodeTest : public NodeFixture {
 protected:
  NodeTest() : NodeFixture(node_on<FakePlatform>()) {}

  // A master that has heard nobody in its listening time and has armed its first beacon.
  void start_leading() {
    node.start();
    await_leading();
  }
  void await_leading() {
    for (int i = 0; i < 10 && platform.chip.written(0x0D, 0) != kTransmission; ++i) {
      platform.pass(50'000);
      end_listening();
    }
    ASSERT_EQ(platform.chip.written(0x0D, 0), kTransmission);
  }

  static constexpr std::uint64_t kTransmission = 0x06;
  static constexpr std::uint64_t kTransmitted = 1U << 7;
  static constexpr std::uint64_t kFrameTimeout = FakePlatform::kFrameTimeout;
  static constexpr std::uint64_t kClockPllLosing = 1U << 25;

  FakePlatform& platform = static_cast<FakePlatform&>(host);
};

// With each radio in turn: what does not depend on it.
class AnyRadio : public NodeFixture, public ::testing::WithParamInterface<std::unique_ptr<AnyNode> (*)()> {
 protected:
  AnyRadio() : NodeFixture(GetParam()()) {}

  FakeHost& platform = host;
};

INSTANTIATE_TEST_SUITE_P(Radios, AnyRadio, ::testing::Values(node_on<FakePlatform>, node_on<OtherPlatform>),
                         [](const auto& tested) { return tested.index == 0 ? "Dw1000" : "Other"; });

TEST_P(AnyRadio, SendsHelloAtStart) {
  platform.fault = Fault{.pc = 0x1234, .lr = 0x5678, .cfsr = 0x82};
  store(good_config());
  node.start();
  const auto hellos = messages(groma_NodeToHost_hello_tag);
  ASSERT_EQ(hellos.size(), 1U);
  const groma_Hello& hello = hellos[0].body.hello;
  EXPECT_STREQ(hello.version, "1.2.3");
  EXPECT_EQ(hello.git_hash, 0xC0FFEE01);
  EXPECT_EQ(hello.protocol_version, kProtocolVersion);
  EXPECT_EQ(hello.role, groma_Role_ROLE_TAG);
  EXPECT_EQ(hello.id, 2U);
  EXPECT_EQ(hello.network_id, 0x1234U);
  EXPECT_EQ(hello.schedule_hash, schedule_hash_of(good_config()));
  EXPECT_EQ(hello.config_hash, config_hash_of(good_config()));
  groma_Config other = good_config();
  other.transmit_antenna_delay_dtu += 1;
  EXPECT_NE(hello.config_hash, config_hash_of(other));
  EXPECT_EQ(hello.reset_reason, groma_ResetReason_RESET_WATCHDOG);
  ASSERT_TRUE(hello.has_last_fault);
  EXPECT_EQ(hello.last_fault.pc, 0x1234U);
  EXPECT_EQ(hello.last_fault.cfsr, 0x82U);
  EXPECT_STREQ(hello.radio_error, "");
  EXPECT_EQ(hello.boot_count, 42U);
  EXPECT_EQ(hello.stack_size_bytes, 4096U);
  EXPECT_EQ(hello.stack_high_water_bytes, 1234U);
  EXPECT_EQ(platform.shown.back(), Indicator::kSearching);
}

TEST_P(AnyRadio, UnconfiguredItStaysSilentOnTheAirAndAnswersTheLink) {
  node.start();
  EXPECT_EQ(platform.shown.back(), Indicator::kUnconfigured);
  command(groma_HostToNode_get_hello_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  EXPECT_EQ(last_reply().request_id, 77U);
  const auto hellos = messages(groma_NodeToHost_hello_tag);
  ASSERT_EQ(hellos.size(), 2U);
  EXPECT_EQ(hellos[1].body.hello.role, groma_Role_ROLE_UNCONFIGURED);
  EXPECT_EQ(hellos[1].body.hello.config_hash, 0U);
  command(groma_HostToNode_get_counters_tag);
  EXPECT_EQ(messages(groma_NodeToHost_counters_tag).size(), 1U);
  for (int i = 0; i < 10; ++i) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
  }
  EXPECT_EQ(transmissions(), 0U);
}

TEST_F(NodeTest, UnconfiguredItListensEachSecondAsProofOfLife) {
  node.start();
  const std::uint64_t began_us = platform.time_us;
  while (platform.time_us < began_us + 5'500'000) {
    if (radio_starts() > receptions_ended) {
      EXPECT_GE(platform.chip.written(0x0C, 0), 20'000U / 1.0257);
      platform.pass(20'000);
      end_listening();
    } else {
      platform.pass_to(node.next_deadline_us());
      node.on_timer();
    }
  }
  EXPECT_EQ(platform.proofs, 5);
  EXPECT_EQ(node.counters().frame_timeouts, 5U);
  EXPECT_EQ(node.counters().radio_recoveries, 0U);
  EXPECT_EQ(transmissions(), 0U);
  EXPECT_TRUE(messages(groma_NodeToHost_network_status_tag).empty());
}

TEST_F(NodeTest, UnconfiguredAndWithoutTheRadiosInterruptItProvesNothing) {
  node.start();
  const std::uint64_t began_us = platform.time_us;
  while (platform.time_us < began_us + 10'000'000) {
    platform.pass_to(node.next_deadline_us());
    // Its listening ends, but the interrupt line is cut.
    if (radio_starts() > 0) platform.chip.status |= kFrameTimeout;
    node.on_timer();
  }
  EXPECT_EQ(platform.proofs, 0);
  EXPECT_GE(node.counters().frame_timeouts, 9U);
}

TEST_P(AnyRadio, EachListeningOfTheSearchProvesLife) {
  store(good_config());
  node.start();
  EXPECT_EQ(platform.proofs, 0);
  for (int i = 1; i <= 3; ++i) {
    end_listening();
    EXPECT_EQ(platform.proofs, i);
  }
}

TEST_F(NodeTest, AMasterProvesLifeOnceASuperframe) {
  store(good_config(groma_Role_ROLE_ANCHOR));
  start_leading();
  platform.proofs = 0;
  // The slots of the beacon, of the shared frame and of three tags.
  for (int superframe = 0; superframe < 3; ++superframe) {
    platform.chip.put(0x17, 0, platform.chip.written(0x0A, 0) + 16'436, 5);
    platform.chip.time = platform.chip.written(0x0A, 0);
    platform.chip.status |= kTransmitted;
    node.on_radio_interrupt();
    launch();
    for (int slot = 0; slot < 4; ++slot) {
      EXPECT_EQ(platform.proofs, superframe);
      platform.chip.time = platform.chip.written(0x0A, 0) + 400 * kTicksPerUs;
      end_listening();
    }
    EXPECT_EQ(platform.proofs, superframe + 1);
  }
  EXPECT_EQ(node.counters().frames_sent, 3U);
  EXPECT_EQ(node.counters().late_transmits, 0U);
}

TEST_P(AnyRadio, ARadioRecoveryIsNoProofOfLife) {
  store(good_config());
  node.start();
  for (int i = 0; i < 5; ++i) miss_event();
  EXPECT_EQ(node.counters().radio_recoveries, 5U);
  EXPECT_EQ(platform.proofs, 0);
}

TEST_F(NodeTest, WarnsOfAnImplausibleAntennaDelay) {
  platform.chip.otp[0x1C] = 0x8098'8098;
  store(good_config());
  node.start();
  const char* const warning = "antenna delay not plausible, 16436 used";
  EXPECT_STREQ(messages(groma_NodeToHost_hello_tag).at(0).body.hello.radio_warning, warning);
  const auto logs = messages(groma_NodeToHost_log_tag);
  ASSERT_EQ(logs.size(), 1U);
  EXPECT_STREQ(logs[0].body.log.text, warning);
  EXPECT_EQ(logs[0].body.log.level, groma_LogLevel_LOG_WARNING);
}

TEST_F(NodeTest, ReportsWhyTheRadioIsDownAndRetries) {
  platform.chip.absent = true;
  store(good_config());
  node.start();
  EXPECT_STREQ(messages(groma_NodeToHost_hello_tag).at(0).body.hello.radio_error, "no DW1000 answers on SPI");
  EXPECT_EQ(platform.shown.back(), Indicator::kRadioFault);
  const int resets = platform.resets;
  for (int i = 0; i < 4; ++i) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
  }
  EXPECT_GT(platform.resets, resets);
  EXPECT_EQ(radio_starts(), 0U);
  EXPECT_EQ(platform.proofs, 0);
  platform.chip.absent = false;
  for (int i = 0; i < 4; ++i) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
  }
  EXPECT_STREQ(messages(groma_NodeToHost_hello_tag).back().body.hello.radio_error, "");
  EXPECT_GT(radio_starts(), 0U);
  EXPECT_EQ(platform.shown.back(), Indicator::kSearching);
}

TEST_F(NodeTest, AConfigurationIsStoredReadBackAndInForceAfterApply) {
  node.start();
  groma_Config config = good_config();
  config.transmit_antenna_delay_dtu = 16000;
  config.preamble = groma_Preamble_PREAMBLE_256;
  write(config);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  EXPECT_EQ(last_reply().request_id, 5U);
  ASSERT_TRUE(last_reply().has_config);
  EXPECT_EQ(last_reply().config.transmit_antenna_delay_dtu, 16000U);
  EXPECT_EQ(last_reply().config.schedule.anchor_ids_count, 4U);
  EXPECT_EQ(radio_starts(), 0U);
  EXPECT_EQ(platform.chip.written(0x18, 0), 16436U);

  command(groma_HostToNode_apply_config_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  EXPECT_EQ(platform.chip.written(0x18, 0), 16000U);
  EXPECT_EQ(platform.chip.written(0x27, 0x08), 0x333B00BEU);
  EXPECT_EQ(radio_starts(), 1U);
  EXPECT_EQ(messages(groma_NodeToHost_hello_tag).back().body.hello.role, groma_Role_ROLE_TAG);

  command(groma_HostToNode_read_config_tag);
  ASSERT_TRUE(last_reply().has_config);
  EXPECT_EQ(last_reply().config.id, 2U);
}

groma_Config without_key(groma_Config config) {
  config.network_key = {};
  return config;
}

groma_Config keyed_config(std::uint8_t first) {
  groma_Config config = good_config();
  config.network_key.size = 16;
  for (std::uint8_t i = 0; i < 16; ++i) config.network_key.bytes[i] = static_cast<std::uint8_t>(first + i);
  config.network_key_hash = 0x1000U + first;
  return config;
}

TEST_P(AnyRadio, NeverRevealsTheNetworkKey) {
  node.start();
  const groma_Config config = keyed_config(0x40);
  write(config);
  command(groma_HostToNode_apply_config_tag);
  command(groma_HostToNode_read_config_tag);
  const auto replies = messages(groma_NodeToHost_reply_tag);
  ASSERT_EQ(replies.size(), 3U);
  for (const auto& message : replies) {
    EXPECT_EQ(message.body.reply.result, groma_Result_RESULT_OK) << message.body.reply.text;
    ASSERT_TRUE(message.body.reply.has_config);
    EXPECT_EQ(message.body.reply.config.network_key.size, 0);
    EXPECT_EQ(message.body.reply.config.network_key_hash, config.network_key_hash);
  }
  const std::span<const std::uint8_t> key(config.network_key.bytes);
  for (const auto& frame : platform.sent) {
    EXPECT_EQ(std::search(frame.begin(), frame.end(), key.begin(), key.begin() + 6), frame.end());
  }
  EXPECT_NE(std::search(platform.stored.begin(), platform.stored.end(), key.begin(), key.end()),
            platform.stored.end());
  // The Hello's hash of the configuration depends on the key's hash, not on the key.
  groma_Config other = config;
  other.network_key.bytes[3] ^= 0x55;
  EXPECT_EQ(config_hash_of(other), config_hash_of(config));
  other.network_key_hash ^= 1;
  EXPECT_NE(config_hash_of(other), config_hash_of(config));
}

TEST_P(AnyRadio, KeepsItsKeyIfOnlyTheHashIsWritten) {
  node.start();
  const groma_Config config = keyed_config(0x40);
  write(config);
  groma_Config changed = without_key(config);
  changed.preamble = groma_Preamble_PREAMBLE_64;
  write(changed);
  const auto kept = decode_config(platform.stored);
  ASSERT_TRUE(kept.has_value());
  EXPECT_EQ(kept->preamble, groma_Preamble_PREAMBLE_64);
  EXPECT_EQ(kept->network_key.size, 16);
  EXPECT_EQ(kept->network_key.bytes[15], 0x4F);
  // The hash of another key requires that key with it.
  changed.network_key_hash ^= 1;
  write(changed);
  changed = config;
  changed.network_key.size = 15;
  write(changed);
  const auto replies = messages(groma_NodeToHost_reply_tag);
  ASSERT_EQ(replies.size(), 4U);
  EXPECT_EQ(replies[1].body.reply.result, groma_Result_RESULT_OK);
  EXPECT_STREQ(replies[2].body.reply.text, "network_key: missing, and this node has a different one");
  EXPECT_STREQ(replies[3].body.reply.text, "network_key: 16 bytes, or none");
}

TEST_P(AnyRadio, ReadingBeforeAnyWriteReturnsAnUnconfiguredNode) {
  node.start();
  command(groma_HostToNode_read_config_tag);
  ASSERT_TRUE(last_reply().has_config);
  EXPECT_EQ(last_reply().config.role, groma_Role_ROLE_UNCONFIGURED);
  command(groma_HostToNode_apply_config_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_INVALID);
}

TEST_P(AnyRadio, EachBadConfigurationIsRefusedByName) {
  node.start();
  const auto refused = [&](const char* word, auto&& spoil) {
    groma_Config config = good_config();
    spoil(config);
    write(config);
    EXPECT_EQ(last_reply().result, groma_Result_RESULT_INVALID) << word;
    EXPECT_NE(std::string(last_reply().text).find(word), std::string::npos) << last_reply().text;
    EXPECT_TRUE(platform.stored.empty()) << word;
  };
  refused("role", [](auto& c) { c.role = groma_Role_ROLE_UNCONFIGURED; });
  refused("id", [](auto& c) { c.id = 0; });
  refused("id", [](auto& c) { c.id = 65536 + 2; });
  refused("id", [](auto& c) { c.id = 101; });
  refused("network_id", [](auto& c) { c.network_id = 65535; });
  refused("schedule", [](auto& c) { c.has_schedule = false; });
  refused("tag_ids", [](auto& c) { c.schedule.tag_ids_count = 0; });
  refused("master_id", [](auto& c) { c.schedule.master_id = 2; });
  refused("guard_us", [](auto& c) { c.schedule.guard_us = 2000; });
  refused("transmit_antenna_delay", [](auto& c) { c.transmit_antenna_delay_dtu = 65536; });
  refused("receive_antenna_delay", [](auto& c) { c.receive_antenna_delay_dtu = 1U << 31; });
  EXPECT_EQ(node.counters().commands_refused, 11U);
}

// nanopb accepts any number for an enumeration.
TEST_P(AnyRadio, InvalidEnumeratorsAreRefused) {
  node.start();
  for (const auto& [member, offset] : {std::pair{"role", offsetof(groma_Config, role)},
                                       std::pair{"preamble", offsetof(groma_Config, preamble)}}) {
    groma_Config config = good_config();
    std::memset(reinterpret_cast<unsigned char*>(&config) + offset, 0x11, 4);
    EXPECT_NE(std::string(fault_of(config)).find(member), std::string::npos);
  }
}

TEST_P(AnyRadio, AFailedOrCorruptedStoreIsReportedAndTheNodeContinues) {
  store(good_config());
  node.start();
  const auto kept = platform.stored;
  platform.store_fails = true;
  write(good_config());
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_STORAGE);
  EXPECT_EQ(platform.stored, kept);
  platform.store_fails = false;
  platform.store_corrupts = true;
  const std::size_t starts = radio_starts();
  write(good_config());
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_STORAGE);
  // The radio is off while storing, and on again after it.
  EXPECT_EQ(radio_starts(), starts + 1);
}

TEST_F(NodeTest, NotifiesTheHostAndStopsTheRadioBeforeAFlashWrite) {
  store(good_config());
  node.start();
  for (const bool reset : {false, true}) {
    platform.sent.clear();
    if (reset) {
      command(groma_HostToNode_factory_reset_tag);
    } else {
      write(good_config());
    }
    EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
    ASSERT_EQ(platform.sent_before_store, 1U);
    EXPECT_STREQ(decode(platform.sent[0]).body.log.text, "off the air to write flash");
    EXPECT_EQ(platform.last_radio_command_at_store, 0x40U);
  }
}

TEST_F(NodeTest, AMasterContinuesItsCountAfterAFlashWrite) {
  groma_Config config = good_config(groma_Role_ROLE_ANCHOR);
  store(config);
  start_leading();
  const std::uint64_t first = platform.chip.written(0x0A, 0);
  config.report_raw_stamps = true;
  write(config);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  // Some superframes have passed; the next beacon comes a whole number of them later.
  for (int i = 0; i < 6 && platform.chip.written(0x0D, 0) != kTransmission; ++i) {
    platform.chip.time = platform.chip.written(0x0A, 0) + 400 * kTicksPerUs;
    end_listening();
  }
  EXPECT_EQ(platform.chip.written(0x0D, 0), kTransmission);
  const auto duration = static_cast<std::uint64_t>(
      mac::Superframe(config.schedule, dw1000::phy_of(radio::Preamble::k128)).duration().count());
  const std::uint64_t since = platform.chip.written(0x0A, 0) - first;
  EXPECT_GT(since, 90'000U * 63'897U);
  EXPECT_LT(std::min(since % duration, duration - since % duration), 512U);
  EXPECT_EQ(node.counters().late_transmits, 0U);
  EXPECT_EQ(node.counters().radio_recoveries, 0U);
}

TEST_P(AnyRadio, AResetThatLeavesTheOldConfigurationIsRefused) {
  store(good_config());
  node.start();
  const std::size_t starts = radio_starts();
  platform.store_fails = true;
  command(groma_HostToNode_factory_reset_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_STORAGE);
  EXPECT_EQ(radio_starts(), starts + 1);
  EXPECT_EQ(platform.shown.back(), Indicator::kSearching);
}

TEST_P(AnyRadio, AnInvalidStoredConfigurationIsIgnored) {
  groma_Config config = good_config();
  config.id = 101;  // an anchor's
  store(config);
  node.start();
  EXPECT_EQ(platform.shown.back(), Indicator::kUnconfigured);
  platform.stored.assign(50, 0xFF);
  node.start();
  EXPECT_EQ(platform.shown.back(), Indicator::kUnconfigured);
  EXPECT_EQ(radio_starts(), 0U);
}

TEST_F(NodeTest, FactoryResetForgetsAndFallsSilent) {
  groma_Config config = good_config();
  config.transmit_antenna_delay_dtu = 16000;
  config.preamble = groma_Preamble_PREAMBLE_256;
  store(config);
  node.start();
  command(groma_HostToNode_factory_reset_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  EXPECT_TRUE(platform.stored.empty());
  EXPECT_EQ(platform.chip.written(0x0D, 0), 0x40U);  // off
  EXPECT_EQ(platform.chip.written(0x18, 0), 16436U) << "the radio keeps nothing of it either";
  EXPECT_EQ(platform.chip.written(0x27, 0x08), 0x313B006BU);
  EXPECT_EQ(platform.shown.back(), Indicator::kUnconfigured);
  EXPECT_EQ(messages(groma_NodeToHost_hello_tag).back().body.hello.role, groma_Role_ROLE_UNCONFIGURED);
}

TEST_F(NodeTest, AfterAFactoryResetNoMissedBeaconsAreReported) {
  store(good_config(groma_Role_ROLE_ANCHOR));
  node.start();
  platform.chip.put(0x17, 0, platform.chip.written(0x0A, 0) + 16'436, 5);
  platform.chip.status |= kTransmitted;
  node.on_radio_interrupt();
  command(groma_HostToNode_factory_reset_tag);
  platform.sent.clear();
  for (int i = 0; i < 3; ++i) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
    end_listening();
  }
  EXPECT_GT(platform.proofs, 0);
  EXPECT_TRUE(messages(groma_NodeToHost_log_tag).empty());
}

TEST_P(AnyRadio, HintsAreForTagsAndEachHasItsWeight) {
  groma_HostToNode message = groma_HostToNode_init_zero;
  message.which_body = groma_HostToNode_prefer_anchors_tag;
  groma_AnchorPreference& hint = message.body.prefer_anchors;
  hint.ids_count = hint.weights_count = 2;
  hint.ids[0] = 104;
  hint.ids[1] = 777;  // not in the schedule, but known to the host
  hint.weights[0] = 200;
  hint.weights[1] = 30;
  node.start();
  command(message);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_UNSUPPORTED) << "unconfigured";
  store(good_config());
  node.start();
  command(message);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  platform.sent.clear();
  for (int i = 0; i < 40; ++i) {
    platform.pass(30'000);
    end_listening();
    node.on_timer();
  }
  const auto status = messages(groma_NodeToHost_network_status_tag);
  ASSERT_FALSE(status.empty());
  EXPECT_EQ(status.back().body.network_status.candidates, 5U);
  EXPECT_EQ(status.back().body.network_status.answering, 0U);
  EXPECT_FALSE(status.back().body.network_status.has_slot) << "no beacon has assigned one";
  hint.weights_count = 1;
  command(message);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_INVALID);
}

TEST_P(AnyRadio, OnlyATagLeavesTheNetwork) {
  store(good_config(groma_Role_ROLE_ANCHOR));
  node.start();
  command(groma_HostToNode_leave_network_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_UNSUPPORTED);
  store(good_config());
  node.start();
  command(groma_HostToNode_leave_network_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
}

TEST_P(AnyRadio, AnUnscheduledNodeMayJoin) {
  for (const groma_Role role : {groma_Role_ROLE_TAG, groma_Role_ROLE_ANCHOR}) {
    groma_Config config = good_config(role);
    config.id = 5000;
    EXPECT_STREQ(fault_of(config), "");
  }
}

TEST_P(AnyRadio, RebootAnswersAndRestarts) {
  node.start();
  command(groma_HostToNode_reboot_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  EXPECT_EQ(platform.restarts, 1);
}

TEST_P(AnyRadio, IdentifyBlinksForItsTime) {
  node.start();
  groma_HostToNode message = groma_HostToNode_init_zero;
  message.which_body = groma_HostToNode_identify_s_tag;
  message.body.identify_s = 2;
  command(message);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
  EXPECT_EQ(platform.shown.back(), Indicator::kIdentify);
  const std::uint64_t began_us = platform.time_us;
  while (platform.shown.back() == Indicator::kIdentify && platform.time_us < 10'000'000) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
  }
  EXPECT_EQ(platform.time_us - began_us, 2'000'000U);
  EXPECT_EQ(platform.shown.back(), Indicator::kUnconfigured);
  message.body.identify_s = 3601;
  command(message);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_INVALID);
}

TEST_P(AnyRadio, UnknownCommandsAndGarbageAreCounted) {
  node.start();
  const std::uint8_t unknown[] = {0x08, 0x05, 0xFA, 0x06, 0x00};  // request 5, field 111
  command(unknown);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_UNSUPPORTED);
  EXPECT_EQ(last_reply().request_id, 5U);
  const std::size_t sent = platform.sent.size();
  const std::uint8_t garbage[] = {0xFF, 0xFF, 0xFF};
  command(garbage);
  EXPECT_EQ(node.counters().link_frames_bad, 1U);
  const std::uint8_t noise[] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0};
  node.on_link_bytes(noise);
  EXPECT_EQ(node.counters().link_frames_bad, 2U);
  EXPECT_EQ(platform.sent.size(), sent);
  command(groma_HostToNode_get_hello_tag);
  EXPECT_EQ(last_reply().result, groma_Result_RESULT_OK);
}

TEST_P(AnyRadio, FramesDroppedByAFullLinkAreCounted) {
  node.start();
  platform.link_full = true;
  command(groma_HostToNode_get_hello_tag);
  EXPECT_EQ(node.counters().reports_dropped, 2U);
  platform.link_full = false;
  command(groma_HostToNode_get_counters_tag);
  EXPECT_EQ(messages(groma_NodeToHost_counters_tag).back().body.counters.reports_dropped, 2U);
}

TEST_P(AnyRadio, SendsTelemetryOnceASecond) {
  store(good_config());
  node.start();
  platform.sent.clear();
  while (platform.time_us < 5'500'000) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
  }
  const auto status = messages(groma_NodeToHost_network_status_tag);
  EXPECT_NEAR(static_cast<double>(status.size()), 5.0, 1.0);
  EXPECT_EQ(messages(groma_NodeToHost_counters_tag).size(), status.size());
  EXPECT_EQ(status.back().body.network_status.state, groma_SyncState_SYNC_SEARCHING);
  EXPECT_EQ(status.back().body.network_status.master_id, 0U) << "no known master";
}

TEST_P(AnyRadio, AMissingInterruptRestartsTheRadio) {
  store(good_config());
  node.start();
  EXPECT_EQ(radio_starts(), 1U);
  const int resets = platform.resets;
  // It listens for 50 ms; no interrupt reports the end.
  const std::uint64_t deadline_us = node.next_deadline_us();
  EXPECT_LT(deadline_us, platform.time_us + 60'000);
  platform.pass_to(deadline_us);
  node.on_timer();
  EXPECT_EQ(node.counters().radio_recoveries, 1U);
  EXPECT_EQ(platform.resets, resets);
  EXPECT_EQ(radio_starts(), 2U);
  EXPECT_EQ(messages(groma_NodeToHost_log_tag).size(), 1U);
  // A second one in a row resets it, but not after an event.
  end_listening();
  miss_event();
  EXPECT_EQ(platform.resets, resets);
  miss_event();
  EXPECT_EQ(platform.resets, resets + 1);
  EXPECT_EQ(node.counters().radio_recoveries, 3U);
}

TEST_F(NodeTest, AChipThatLostItsRegistersIsResetAtOnce) {
  store(good_config());
  node.start();
  const int resets = platform.resets;
  platform.chip.put(0x1F, 0, 0x21040055, 4);
  miss_event();
  EXPECT_EQ(platform.resets, resets + 1);
  EXPECT_EQ(platform.chip.get(0x1F, 0, 4), 0x4A480055U);
  EXPECT_EQ(node.counters().radio_recoveries, 1U);
}

TEST_F(NodeTest, ACounterThatRestartedResetsTheRadio) {
  store(good_config());
  node.start();
  for (int i = 0; i < 20; ++i) {
    platform.pass(50'000);
    end_listening();
  }
  const int resets = platform.resets;
  platform.chip.time = 12'345;
  end_listening();
  EXPECT_EQ(node.counters().radio_recoveries, 1U);
  EXPECT_LE(node.next_deadline_us(), platform.time_us);
  node.on_timer();
  EXPECT_EQ(platform.resets, resets + 1);
  EXPECT_EQ(node.counters().radio_recoveries, 1U);
}

TEST_F(NodeTest, AMissedInterruptIsHandledAtTheDeadline) {
  store(good_config());
  node.start();
  platform.chip.status |= kFrameTimeout;
  platform.pass_to(node.next_deadline_us());
  node.on_timer();
  EXPECT_EQ(node.counters().radio_recoveries, 0U);
  EXPECT_EQ(node.counters().frame_timeouts, 1U);
  EXPECT_EQ(radio_starts(), 2U);
}

TEST_F(NodeTest, PllFlagsAreReportedAndNothingElse) {
  store(good_config());
  node.start();
  platform.chip.status |= kClockPllLosing;
  EXPECT_FALSE(platform.chip.interrupt());
  end_listening();
  EXPECT_EQ(node.counters().radio_recoveries, 0U);
  command(groma_HostToNode_get_counters_tag);
  EXPECT_EQ(messages(groma_NodeToHost_counters_tag).back().body.counters.pll_flags, 1U);
}

TEST_F(NodeTest, AChipThatRejectsEverythingAsLateDoesNotHangTheNode) {
  platform.chip.on_write = [&](const Transfer& t) {
    if (t.file == 0x0D && (t.word() & 0x204) != 0) platform.chip.status |= 1U << 27;
  };
  store(good_config(groma_Role_ROLE_ANCHOR));
  node.start();
  for (int i = 0; i < 3; ++i) {
    platform.pass(50'000);
    end_listening();
  }
  EXPECT_GT(node.counters().late_transmits + node.counters().late_receives, 0U);
  for (int i = 0; i < 3; ++i) {
    platform.pass_to(node.next_deadline_us());
    node.on_timer();
  }
  SUCCEED();
}

TEST_F(NodeTest, ATransmissionTooCloseToPowerUpIsLateAndCounted) {
  store(good_config(groma_Role_ROLE_ANCHOR));
  node.start();
  std::uint32_t refused = 0;
  platform.chip.on_write = [&](const Transfer& t) {
    if (t.file != 0x0D || (t.word() & 0x4) == 0) return;
    platform.chip.status |= std::uint64_t{1} << 34;
    ++refused;
  };
  for (int i = 0; i < 10 && refused == 0; ++i) {
    platform.pass(50'000);
    end_listening();
  }
  EXPECT_GT(refused, 0U);
  EXPECT_EQ(node.counters().power_up_errors, refused);
  EXPECT_EQ(node.counters().late_transmits, refused);
  EXPECT_EQ(node.counters().radio_recoveries, 0U);
}

TEST_F(NodeTest, TheMasterSendsItsFirstBeacon) {
  store(good_config(groma_Role_ROLE_ANCHOR));
  node.start();
  EXPECT_EQ(platform.shown.back(), Indicator::kSearching);
  await_leading();
  EXPECT_EQ(platform.shown.back(), Indicator::kRanging);
  const auto writes = platform.chip.writes();
  const auto buffer =
      std::find_if(writes.begin(), writes.end(), [](const Transfer& t) { return t.file == 0x09; });
  ASSERT_NE(buffer, writes.end());
  const auto parsed = mac::parse(buffer->bytes);
  ASSERT_TRUE(parsed.frame);
  EXPECT_EQ(parsed.frame->network, 0x1234);
  EXPECT_EQ(parsed.frame->source, 101);
  const auto* beacon = std::get_if<mac::Beacon>(&parsed.frame->body);
  ASSERT_NE(beacon, nullptr);
  EXPECT_EQ(beacon->superframe, 0U);
  EXPECT_EQ(beacon->session, std::uint64_t{101} << 48 | std::uint64_t{42} << 16)
      << "its id and its boot count";
  EXPECT_EQ(beacon->epoch, 7U);
  EXPECT_EQ(beacon->schedule_hash, schedule_hash_of(good_config()));
}

TEST_F(NodeTest, ReportsUntilWhenTheRadioIsQuiet) {
  EXPECT_EQ(node.quiet_until_us(), ~std::uint64_t{0});
  // A master that has armed its first beacon.
  store(good_config(groma_Role_ROLE_ANCHOR));
  start_leading();
  const std::uint64_t beacon_us = node.quiet_until_us();
  EXPECT_GT(beacon_us, platform.time_us);
  EXPECT_LT(beacon_us, platform.time_us + 100'000);
  // While it searches for a beacon, service latency does not matter.
  store(good_config());
  command(groma_HostToNode_apply_config_tag);
  EXPECT_EQ(node.quiet_until_us(), ~std::uint64_t{0});
}

TEST_F(NodeTest, DeviceTimeContinuesOverARadioReset) {
  // A master: each beacon's DX_TIME shows its clock.
  store(good_config(groma_Role_ROLE_ANCHOR));
  platform.chip.time = 400'000'000'000;
  start_leading();
  const std::uint64_t first = platform.chip.written(0x0A, 0);
  platform.chip.time = 1'000'000;  // a reset counter
  platform.pass_to(node.next_deadline_us());
  node.on_timer();
  EXPECT_EQ(node.counters().radio_recoveries, 1U);
  await_leading();
  const std::uint64_t second = platform.chip.written(0x0A, 0);
  EXPECT_GT(first, 400'000'000'000U);
  EXPECT_LT(second, 10'000'000'000U);
}

// A tag that hears a master's beacons and nothing else. The master's clock is the tag's.
class LoneTagTest : public NodeTest {
 protected:
  LoneTagTest() { store(config); }

  void advance_to(std::uint64_t ticks) {
    if (ticks <= platform.chip.time) return;
    platform.time_us += (ticks - platform.chip.time) / kTicksPerUs;
    platform.chip.time = ticks;
  }
  [[nodiscard]] std::uint64_t beacon_at(std::uint32_t number) const {
    return kStart + static_cast<std::uint64_t>(
                        (std::int64_t{number} * superframe.duration() + superframe.beacon()).count());
  }
  void send_beacon() {
    mac::Beacon beacon{.superframe = next,
                       .session = 1,
                       .epoch = config.schedule.epoch,
                       .schedule_hash = schedule_hash_of(config),
                       .master = 101,
                       .slots = 3};
    beacon.owners.fill(mac::kBroadcast);
    const auto frame =
        mac::serialize({.network = 0x1234, .destination = mac::kBroadcast, .source = 101, .body = beacon});
    platform.chip.put(0x11, frame.bytes());
    platform.chip.put(0x10, 0, frame.bytes().size() + 2, 4);
    platform.chip.put(0x15, 0, beacon_at(next), 5);
    advance_to(beacon_at(next++) + kLater);
    platform.chip.status |= kReceivedAndTimestamped;
    node.on_radio_interrupt();
    launch();
  }
  void end_transmission(std::uint64_t start) {
    const auto writes = platform.chip.writes();
    const auto buffer =
        std::find_if(writes.rbegin(), writes.rend(), [](const Transfer& t) { return t.file == 0x09; });
    ASSERT_NE(buffer, writes.rend());
    const auto parsed = mac::parse(buffer->bytes);
    ASSERT_TRUE(parsed.frame);
    if (std::holds_alternative<mac::Poll>(parsed.frame->body)) ++polls;
    platform.chip.put(0x17, 0, start + 16'436, 5);
    advance_to(start + kLater);
    platform.chip.status |= kTransmitted;
    node.on_radio_interrupt();
    launch();
  }
  void run_superframes(std::uint32_t count) {
    const std::uint32_t end = next + count;
    for (int i = 0; next < end; ++i) {
      ASSERT_LT(i, 2'000);
      while (beacon_at(next) < platform.chip.time + kLater) ++next;
      const std::uint64_t command = platform.chip.written(0x0D, 0);
      const std::uint64_t start = platform.chip.written(0x0A, 0);
      const bool delayed = command != kReceiveNow;
      if (command == kTransmission) {
        end_transmission(start);
      } else if (!delayed || (start < beacon_at(next) && start + 2 * kLater > beacon_at(next))) {
        send_beacon();
      } else {
        advance_to(start + kLater);
        end_listening();
      }
    }
  }

  static constexpr std::uint64_t kReceiveNow = 0x100;
  static constexpr std::uint64_t kReceivedAndTimestamped = 1U << 14 | 1U << 13 | 1U << 10;
  static constexpr std::uint64_t kStart = 1'000'000'000;
  // From the start of an operation to its end, longer than a frame takes.
  static constexpr std::uint64_t kLater = 500 * kTicksPerUs;

  groma_Config config = good_config();
  mac::Superframe superframe{config.schedule, dw1000::phy_of(radio::Preamble::k128)};
  std::uint32_t next = 0;  // superframe of the next beacon
  std::size_t polls = 0;
};

// The chip may shift its clock by a share of the lead (docs/explanation/silicon.md).
TEST_F(LoneTagTest, LaunchesEachFrameWithTheSameLead) {
  std::vector<std::int64_t> leads;
  platform.chip.on_write = [&](const Transfer& t) {
    if (t.file != 0x0D || (t.word() & 0x2) == 0) return;
    const auto to_rmarker = static_cast<std::int64_t>(platform.chip.written(0x0A, 0) - platform.chip.time);
    leads.push_back((to_rmarker - superframe.phy().before_rmarker().count()) /
                    static_cast<std::int64_t>(kTicksPerUs));
  };
  node.start();
  run_superframes(40);
  EXPECT_GT(polls, 10U);
  EXPECT_GE(leads.size(), polls);
  for (const std::int64_t lead_us : leads) EXPECT_NEAR(static_cast<double>(lead_us), 200.0, 20.0);
}

TEST_F(LoneTagTest, ReportsOnceThatItIsLateForTheSchedule) {
  node.start();
  const auto run_a_second = [this] {
    for (int i = 0; i < 20; ++i) {
      run_superframes(4);
      node.on_timer();
    }
  };
  const auto reports = [this] {
    const auto logs = messages(groma_NodeToHost_log_tag);
    return std::count_if(logs.begin(), logs.end(), [](const groma_NodeToHost& message) {
      return std::string(message.body.log.text) == "late for the schedule: lengthen its turnaround or gap";
    });
  };
  run_a_second();
  run_a_second();
  EXPECT_EQ(reports(), 0);
  platform.chip.on_write = [this](const Transfer& t) {
    if (t.file == 0x0D && (t.word() & 0x204) != 0) platform.chip.status |= 1U << 27;
  };
  for (int i = 0; i < 4; ++i) run_a_second();
  EXPECT_GT(node.counters().late_transmits + node.counters().late_receives, 100U);
  EXPECT_EQ(reports(), 1);
}

// A listening that is late, but not too late, begins at once.
TEST_F(LoneTagTest, EachLateListeningCountsOnce) {
  node.start();
  run_superframes(20);
  platform.chip.on_write = [this](const Transfer& t) {
    if (t.file != 0x0D || (t.word() & 0x300) != 0x300) return;
    const std::uint64_t start = platform.chip.written(0x0A, 0);
    if (start > beacon_at(next) || start + 2 * kLater < beacon_at(next)) return;
    advance_to(start + 20 * kTicksPerUs);
    platform.chip.status |= 1U << 27;
  };
  run_superframes(20);
  platform.chip.on_write = nullptr;
  EXPECT_GE(node.counters().late_receives, 3U);
  command(groma_HostToNode_get_slack_tag);
  const groma_Slack slack = messages(groma_NodeToHost_slack_tag).at(0).body.slack;
  ASSERT_EQ(slack.slots[0].kind, groma_SlotKind_SLOT_BEACON);
  EXPECT_EQ(slack.slots[0].counts[0], node.counters().late_receives);
}

TEST_F(LoneTagTest, KeepsItsPlaceOverARadioRecovery) {
  node.start();
  run_superframes(20);
  polls = 0;
  run_superframes(8);
  const std::size_t usual = polls;
  EXPECT_GE(usual, 4U);
  platform.sent.clear();
  platform.shown.clear();
  miss_event();
  ASSERT_EQ(node.counters().radio_recoveries, 1U);
  EXPECT_EQ(std::count(platform.shown.begin(), platform.shown.end(), Indicator::kSearching), 0);
  polls = 0;
  run_superframes(8);
  EXPECT_GE(polls + 1, usual);
  for (const auto& message : messages(groma_NodeToHost_log_tag)) {
    EXPECT_STREQ(message.body.log.text, "radio: no answer, started again");
  }
}

TEST_F(LoneTagTest, ALentSlotStaysLentOverARadioRecovery) {
  node.start();
  run_superframes(20);
  EXPECT_GT(polls, 2U);
  groma_HostToNode survey = groma_HostToNode_init_zero;
  survey.request_id = 9;
  survey.target_id = 102;
  survey.which_body = groma_HostToNode_survey_tag;
  survey.body.survey.exchanges = 60;
  command(survey);
  ASSERT_EQ(last_reply().result, groma_Result_RESULT_PENDING);
  polls = 0;
  run_superframes(20);
  EXPECT_EQ(polls, 0U);
  miss_event();
  ASSERT_EQ(node.counters().radio_recoveries, 1U);
  run_superframes(20);
  EXPECT_EQ(polls, 0U) << "the anchor that surveys polls in this slot";
  // The survey was never answered.
  platform.time_us += 61'000'000;
  node.on_timer();
  run_superframes(20);
  EXPECT_GT(polls, 2U);
}

// A platform with a second link beside the UART.
struct TwoLinks : FakePlatform {
  std::vector<groma_Link> configured;
  std::vector<std::vector<std::uint8_t>> answered;
  const char* error = "";

  const char* configure_link(const groma_Config& config) noexcept {
    configured.push_back(config.link);
    return error;
  }
  bool link_answer(std::span<const std::uint8_t> frame) noexcept {
    answered.emplace_back(frame.begin(), frame.end());
    return true;
  }
  void count_link(groma_Counters& counters) noexcept { counters.can_frames_sent = 7; }
};
static_assert(Platform<TwoLinks>);

class TwoLinksTest : public ::testing::Test {
 protected:
  void store(const groma_Config& config) {
    platform.stored.resize(kMaxConfigBytes);
    platform.stored.resize(encode_config(config, platform.stored));
  }
  void command(pb_size_t which) {
    groma_HostToNode message = groma_HostToNode_init_zero;
    message.which_body = which;
    std::array<std::uint8_t, groma_HostToNode_size> payload{};
    auto stream = pb_ostream_from_buffer(payload.data(), payload.size());
    ASSERT_TRUE(pb_encode(&stream, groma_HostToNode_fields, &message));
    std::vector<std::uint8_t> frame(wire::max_encoded_size(stream.bytes_written));
    frame.resize(wire::encode_frame(std::span(payload).first(stream.bytes_written), frame));
    node.on_link_bytes(frame);
  }

  TwoLinks platform;
  Node<TwoLinks> node{platform, {.version = "1.2.3", .git_hash = 0xC0FFEE01}};
};

TEST_F(TwoLinksTest, TheConfigurationInForceChoosesTheLink) {
  node.start();
  EXPECT_EQ(platform.configured, std::vector({groma_Link_LINK_UART}));
  groma_Config config = good_config(groma_Role_ROLE_ANCHOR);
  config.link = groma_Link_LINK_CAN_FD;
  store(config);
  command(groma_HostToNode_apply_config_tag);
  EXPECT_EQ(platform.configured, std::vector({groma_Link_LINK_UART, groma_Link_LINK_CAN_FD}));
  command(groma_HostToNode_factory_reset_tag);
  EXPECT_EQ(platform.configured.back(), groma_Link_LINK_UART);
}

TEST_F(TwoLinksTest, AnAnswerGoesToTheRequesterAndReportsTheLinkError) {
  groma_Config config = good_config(groma_Role_ROLE_ANCHOR);
  config.link = groma_Link_LINK_CAN;
  store(config);
  platform.error = "no MCP2518FD answers on SPI";
  node.start();
  ASSERT_FALSE(platform.sent.empty());
  EXPECT_STREQ(decode(platform.sent.back()).body.hello.link_error, "no MCP2518FD answers on SPI");
  platform.sent.clear();
  command(groma_HostToNode_get_hello_tag);
  command(groma_HostToNode_get_counters_tag);
  EXPECT_TRUE(platform.sent.empty());
  ASSERT_EQ(platform.answered.size(), 4U);
  EXPECT_EQ(decode(platform.answered[0]).which_body, groma_NodeToHost_reply_tag);
  EXPECT_STREQ(decode(platform.answered[1]).body.hello.link_error, "no MCP2518FD answers on SPI");
  EXPECT_EQ(decode(platform.answered[2]).which_body, groma_NodeToHost_reply_tag);
  EXPECT_EQ(decode(platform.answered[3]).body.counters.can_frames_sent, 7U);
}

TEST_P(AnyRadio, RefusesInvalidLinksAndBitRates) {
  groma_Config config = good_config();
  config.link = groma_Link_LINK_CAN;
  config.can_nominal_bit_per_s = 500'000;
  config.can_data_bit_per_s = 4'000'000;
  EXPECT_STREQ(fault_of(config), "");
  config.can_nominal_bit_per_s = 333'333;
  EXPECT_NE(std::string(fault_of(config)).find("can_nominal_bit_per_s"), std::string::npos);
  config.can_nominal_bit_per_s = 0;
  config.can_data_bit_per_s = 1;
  EXPECT_NE(std::string(fault_of(config)).find("can_data_bit_per_s"), std::string::npos);
  config.can_data_bit_per_s = 0;
  const std::uint32_t none = 3;
  std::memcpy(&config.link, &none, sizeof(none));
  EXPECT_NE(std::string(fault_of(config)).find("link"), std::string::npos);
}

TEST(SlotReport, BecomesCompact) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_slot_report_tag;
  message.body.slot_report.sequence = 9;
  message.body.slot_report.ranges_count = 2;
  message.body.slot_report.ranges[1].anchor_id = 104;
  make_compact(message);
  ASSERT_EQ(message.which_body, groma_NodeToHost_compact_report_tag);
  EXPECT_EQ(message.body.compact_report.sequence, 9U);
  ASSERT_EQ(message.body.compact_report.ranges.size, 22U);
  EXPECT_EQ(message.body.compact_report.ranges.bytes[11], 104);
}

TEST(SlotReport, CarriesEachRangeWithItsTimeAndStatus) {
  mac::Exchange exchange{.number = 9, .superframe = 1234, .slot = 2, .count = 3};
  exchange.poll_sent = ranging::ClockTime(1'000'000'000'000);
  exchange.closing_sent = exchange.poll_sent + ranging::Ticks(800'000'000);
  const std::int64_t tof = 2131;  // 10 m
  exchange.legs[0] = {.anchor = 101,
                      .answered = true,
                      .timestamp_valid = true,
                      .received = exchange.poll_sent + ranging::Ticks(400'000'000 + 2 * tof),
                      .reply = ranging::Ticks(400'000'000),
                      .quality = dw1000::link_quality({.amplitude1 = 11'000,
                                                       .amplitude2 = 12'000,
                                                       .amplitude3 = 9'000,
                                                       .channel_power = 5'000,
                                                       .preamble_count = 113}),
                      .closing_state = mac::Leg::Closing::kHeld,
                      .closing = ranging::Ticks(400'000'000)};
  exchange.legs[1] = {.anchor = 102};
  exchange.legs[2] = exchange.legs[0];
  exchange.legs[2].anchor = 103;
  exchange.legs[2].closing_state = mac::Leg::Closing::kStale;
  groma_SlotReport report = groma_SlotReport_init_zero;
  groma_Counters counters = groma_Counters_init_zero;
  groma_Config config = groma_Config_init_zero;
  config.report_raw_stamps = true;
  const ranging::ClockTime now = exchange.poll_sent + ranging::Ticks(1'500'000'000);
  begin_slot_report(report, exchange, now);
  for (std::size_t i = 0; i < exchange.count; ++i) {
    fill_range(report, i, exchange, now, config, std::nullopt, counters);
  }
  EXPECT_EQ(report.superframe, 1234U);
  EXPECT_EQ(report.slot, 2U);
  EXPECT_EQ(report.device_time_dtu, 1'001'500'000'000U);
  ASSERT_EQ(report.ranges_count, 3U);
  EXPECT_EQ(report.ranges[0].status, groma_RangeStatus_RANGE_OK);
  EXPECT_NEAR(static_cast<double>(report.ranges[0].range_m), 10.0, 0.01);
  EXPECT_EQ(report.ranges[0].instant_offset_dtu, 400'000'000 + 2 * tof - 1'500'000'000);
  EXPECT_TRUE(report.ranges[0].has_first_path_power_cdbm);
  EXPECT_TRUE(report.ranges[0].has_receive_power_cdbm);
  ASSERT_TRUE(report.ranges[0].has_raw);
  EXPECT_EQ(report.ranges[0].raw.tag_round_dtu, 400'004'262U);
  EXPECT_EQ(report.ranges[0].raw.anchor_reply_dtu, 400'000'000U);
  EXPECT_EQ(report.ranges[0].raw.anchor_round_dtu, 400'000'000U);
  EXPECT_EQ(report.ranges[0].raw.tag_reply_dtu, 399'995'738U);
  EXPECT_EQ(report.ranges[1].status, groma_RangeStatus_RANGE_NO_RESPONSE);
  EXPECT_EQ(report.ranges[1].anchor_id, 102U);
  EXPECT_FALSE(report.ranges[1].has_raw);
  EXPECT_FALSE(report.ranges[1].has_receive_power_cdbm);
  EXPECT_EQ(report.ranges[2].status, groma_RangeStatus_RANGE_STALE);
  EXPECT_EQ(counters.ranges_completed, 1U);
  EXPECT_EQ(counters.ranges_lost, 2U);
}

TEST(MessageEncoder, AReplyWithAStoredConfigurationMatchesNanopbsEncoding) {
  groma_Config config = good_config();
  config.network_key.size = 16;
  config.network_key_hash = 0x12345678;
  config.correct_power_bias = true;
  groma_Config before = config;
  before.id = 1;
  before.network_key.bytes[3] = 9;
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_reply_tag;
  groma_Reply& reply = message.body.reply;
  reply.request_id = 70'000;
  reply.result = groma_Result_RESULT_STORAGE;
  std::strcpy(reply.text, "as it is");
  for (const bool on_trial : {false, true}) {
    std::vector<std::uint8_t> stored(kMaxStoredBytes);
    stored.resize(encode_config(config, stored, on_trial ? &before : nullptr));
    const auto visible = shown(stored);
    std::vector<std::uint8_t> expected(kMaxConfigBytes);
    expected.resize(encode_config(without_key(config), expected));
    EXPECT_TRUE(std::ranges::equal(visible, expected)) << on_trial;

    MessageEncoder encoder;
    const auto frame = encoder.encode(message, visible);
    const std::vector<std::uint8_t> seen(frame.begin(), frame.end());
    groma_NodeToHost whole = message;
    whole.body.reply.has_config = true;
    whole.body.reply.config = without_key(config);
    EXPECT_TRUE(std::ranges::equal(encoder.encode(whole), seen)) << on_trial;
    // Returns 0 for every buffer that is too short.
    std::vector<std::uint8_t> room(groma_NodeToHost_size);
    const std::size_t size = encode_message(message, visible, room);
    EXPECT_EQ(encode_message(message, visible, std::span(room).first(size)), size);
    for (std::size_t shorter = 0; shorter < size; ++shorter) {
      EXPECT_EQ(encode_message(message, visible, std::span(room).first(shorter)), 0U) << shorter;
    }
  }
}

TEST(Slack, KeepsTheLeastAndAHistogramOfEachKindOfSlot) {
  Slack slack;
  groma_Slack out = groma_Slack_init_zero;
  slack.fill(out);
  EXPECT_EQ(out.slots_count, 0);
  for (const std::int32_t us : {-7, 0, 9, 10, 19, 20, 499, 500, 40'000}) slack.add(mac::SlotKind::kPoll, us);
  slack.add(mac::SlotKind::kFinal, 31);
  slack.add(mac::SlotKind::kNone, 1);
  slack.fill(out);
  ASSERT_EQ(out.slots_count, 2);
  EXPECT_EQ(out.slots[0].kind, groma_SlotKind_SLOT_POLL);
  EXPECT_EQ(out.slots[0].least_us, -7);
  EXPECT_THAT(out.slots[0].counts, ::testing::ElementsAre(1, 2, 2, 1, 0, 0, 1, 2));
  EXPECT_EQ(out.slots[1].kind, groma_SlotKind_SLOT_FINAL);
  EXPECT_EQ(out.slots[1].least_us, 31);
  slack.clear();
  out = groma_Slack_init_zero;
  slack.fill(out);
  EXPECT_EQ(out.slots_count, 0);
}

TEST(MessageEncoder, TheLargestMessageOfTheSchemaFits) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_slot_report_tag;
  groma_SlotReport& report = message.body.slot_report;
  report.sequence = report.superframe = report.slot = report.tag_id = ~0U;
  report.device_time_dtu = report.network_time_dtu = ~std::uint64_t{0};
  report.network_rate_ppb = std::numeric_limits<std::int32_t>::min();
  report.ranges_count = 16;
  for (groma_Range& range : report.ranges) {
    range.anchor_id = 0xFFFF;
    range.status = groma_RangeStatus_RANGE_BAD_STAMP;
    range.instant_offset_dtu = std::numeric_limits<std::int64_t>::min();
    range.range_m = 1.0F;
    range.has_first_path_power_cdbm = range.has_receive_power_cdbm = range.has_clock_offset_ppb = true;
    range.first_path_power_cdbm = range.receive_power_cdbm = std::numeric_limits<std::int16_t>::min();
    range.clock_offset_ppb = std::numeric_limits<std::int32_t>::min();
    range.has_raw = true;
    range.raw = {~0U, ~0U, ~0ULL, ~0ULL};
    range.noise = 0xFFFF;
    range.flags = 0xFF;
  }
  MessageEncoder encoder;
  const auto frame = encoder.encode(message);
  ASSERT_FALSE(frame.empty());
  EXPECT_EQ(decode(frame).body.slot_report.ranges[15].anchor_id, 0xFFFF);
}

// ---- a network of nodes with a radio of another kind ------------------------------------------------------

class OtherNetwork {
 public:
  using Node = NodeOn<OtherPlatform>;

  Node& add(std::uint16_t id, double x_m, double offset_ppm) {
    // The counters start at different places, and the first one wraps at once.
    const std::uint64_t first = 0xFFFF'FFFF - std::uint64_t{nodes_.size()} * 0x3333'3333;
    nodes_.push_back(std::make_unique<Node>(
        air_, OtherChip::Settings{.x_m = x_m, .offset_ppm = offset_ppm, .first_count = first}));
    Node& node = *nodes_.back();
    groma_Config config = good_config(id < 100 ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR);
    config.id = id;
    config.schedule = schedule_of(1, 3, groma_RangingMethod_METHOD_DS_FINAL);
    node.platform.stored.resize(kMaxConfigBytes);
    node.platform.stored.resize(encode_config(config, node.platform.stored));
    return node;
  }
  void start() {
    air_->now = 1e8;
    set_clocks();
    for (auto& node : nodes_) node->start();
  }
  void run(double seconds) {
    const double end = air_->now + seconds * testing::kTicksPerSecond;
    for (;;) {
      double next = end;
      for (const auto& node : nodes_) {
        const auto deadline_us = static_cast<double>(node->next_deadline_us());
        next = std::min({next, node->platform.chip.next_event(), deadline_us * kTicksIn1us + 1.0});
      }
      air_->now = std::max(next, air_->now);
      set_clocks();
      if (air_->now >= end) return;
      for (auto& node : nodes_) {
        if (node->platform.chip.next_event() <= air_->now) node->platform.chip.advance();
      }
      for (auto& node : nodes_) {
        while (node->platform.chip.interrupt()) node->on_radio_interrupt();
        if (node->next_deadline_us() <= node->platform.time_us) node->on_timer();
      }
    }
  }

 private:
  void set_clocks() {
    for (auto& node : nodes_) {
      node->platform.time_us = static_cast<std::uint64_t>(air_->now / kTicksIn1us);
    }
  }

  static constexpr double kTicksIn1us = 63'897.6;
  std::shared_ptr<OtherChip::Air> air_ = std::make_shared<OtherChip::Air>();
  std::vector<std::unique_ptr<Node>> nodes_;
};

TEST(OtherRadio, ANetworkRangesOverManyWrapsOfItsCounter) {
  const std::map<std::uint32_t, double> anchors_m{{101, 0.0}, {102, 40.0}, {103, 71.3}};
  constexpr double kTag_m = 12.3;
  OtherNetwork network;
  double ppm = -15.0;
  for (const auto& [id, x_m] : anchors_m) network.add(static_cast<std::uint16_t>(id), x_m, ppm += 10.0);
  OtherNetwork::Node& tag = network.add(1, kTag_m, -12.0);
  network.start();
  network.run(12.0);

  EXPECT_EQ(tag.counters().radio_recoveries, 0U);
  EXPECT_EQ(tag.counters().late_transmits + tag.counters().late_receives, 0U);
  // Each of the six timestamps of a range may be half a tick off.
  const double resolution_m = static_cast<double>(testing::kOtherTick) * testing::kMetresPerTick;
  std::size_t good = 0;
  std::size_t bad = 0;
  double sum_m = 0.0;
  for (const auto& bytes : tag.platform.sent) {
    const groma_NodeToHost message = decode(bytes);
    if (message.which_body != groma_NodeToHost_slot_report_tag) continue;
    for (const groma_Range& range :
         std::span(message.body.slot_report.ranges).first(message.body.slot_report.ranges_count)) {
      if (range.status != groma_RangeStatus_RANGE_OK) {
        ++bad;
        continue;
      }
      ++good;
      const double error_m =
          static_cast<double>(range.range_m) - std::abs(anchors_m.at(range.anchor_id) - kTag_m);
      EXPECT_LT(std::abs(error_m), 1.1 * resolution_m);
      sum_m += error_m;
      EXPECT_FALSE(range.has_clock_offset_ppb);
      EXPECT_FALSE(range.has_first_path_power_cdbm);
      EXPECT_EQ(range.receive_power_cdbm, -8'174);
      EXPECT_EQ(range.flags & 3U, static_cast<unsigned>(groma_LineOfSight_LINE_OF_SIGHT_UNKNOWN));
    }
  }
  const double superframe_s =
      static_cast<double>(mac::Superframe(schedule_of(1, 3, groma_RangingMethod_METHOD_DS_FINAL),
                                          testing::other_phy_of(radio::Preamble::k128))
                              .duration()
                              .count()) /
      testing::kTicksPerSecond;
  EXPECT_GT(static_cast<double>(good), 3 * (11.5 / superframe_s));
  EXPECT_LT(bad, 10U);
  EXPECT_LT(std::abs(sum_m / static_cast<double>(good)), resolution_m / 4);
}

}  // namespace
}  // namespace groma::node
