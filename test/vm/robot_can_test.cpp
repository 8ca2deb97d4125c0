// Odometry over CAN through the kernel's sockets, on the bus of the nodes.
#include "host/daemon/robot_can.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <linux/can/error.h>

#include <array>
#include <chrono>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "host/daemon/robot_input.hpp"
#include "host/link/reconnecting_link.hpp"
#include "host/link/socket_can_link.hpp"
#include "test/support/virtual_can.hpp"

namespace groma::daemon {
namespace {

using groma::test::CanParticipant;
using groma::test::VirtualCan;
using ::testing::HasSubstr;

constexpr std::uint32_t kDrive = 0x101;
constexpr std::uint32_t kImu = 0x1900'001EU | CAN_EFF_FLAG;

CanSignal signal(std::uint32_t id, unsigned start_bit) {
  CanSignal out;
  out.name = "Drive.Value";
  out.id = id;
  out.signal.start_bit = start_bit;
  out.signal.bits = 16;
  out.signal.type = io::DbcSignal::Type::kSigned;
  out.signal.factor = 0.001;
  out.signal.min = -20.0;
  out.signal.max = 20.0;
  return out;
}

double clock_s() {
  return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

class RobotOnCan : public ::testing::Test {
 protected:
  RobotOnCan() {
    signals_.interface = bus_.name();
    signals_.used = {signal(kDrive, 0), std::nullopt, signal(kDrive, 16), signal(kImu, 0)};
  }

  // Raw values of mm/s and mrad/s, little-endian.
  static void send(const CanParticipant& from, std::uint32_t id, std::int16_t first, std::int16_t second) {
    can_frame frame{};
    frame.can_id = id;
    frame.can_dlc = 4;
    std::memcpy(frame.data, &first, sizeof(first));
    std::memcpy(frame.data + sizeof(first), &second, sizeof(second));
    from.send_raw(frame);
  }

  // Everything that is available. A virtual bus has delivered a frame when its sender continues.
  static std::vector<RobotMessage> read_all(link::ByteLink& link, RobotInput& input) {
    std::vector<RobotMessage> messages;
    std::array<std::uint8_t, 50> buffer{};  // shorter than a line
    for (link::ReadResult result; (result = link.read(buffer)).bytes > 0;) {
      input.push(std::span(buffer).first(result.bytes));
      while (auto message = input.next()) messages.push_back(*message);
    }
    return messages;
  }

  VirtualCan bus_{"bus0"};
  CanSignals signals_;
  RobotInput input_;
};

TEST_F(RobotOnCan, LosesNoSampleAmongTheFramesOfNodes) {
  const CanParticipant base(bus_.name());
  const link::OpenedLink opened = open_robot_can(signals_);
  ASSERT_TRUE(opened.link) << opened.error.message;
  const link::OpenedLink node = link::open_link("can:bus0/3", 0);
  ASSERT_TRUE(node.link) << node.error.message;
  std::size_t odometry = 0;
  std::size_t rates = 0;
  std::size_t node_bytes = 0;
  double last_s = clock_s();
  for (int i = 0; i < 1000; ++i) {
    base.send_stream(std::vector<std::uint8_t>{1, 2, 3, 4, 5, 6, 7, 8, 0}, wire::CanFormat::kClassic,
                     {wire::CanDirection::kToHost, 3});
    send(base, kDrive, static_cast<std::int16_t>(i), -500);
    send(base, kDrive + 1, 0, 0);
    send(base, kDrive | CAN_EFF_FLAG, 0, 0);
    send(base, kImu, static_cast<std::int16_t>(-i), 0);
    for (const RobotMessage& message : read_all(*opened.link, input_)) {
      if (const auto* sample = std::get_if<model::OdometrySample>(&message)) {
        EXPECT_DOUBLE_EQ(sample->vx_mps, 0.001 * i);
        EXPECT_EQ(sample->vy_mps, 0.0);
        EXPECT_EQ(sample->omega_radps, -0.5);
        EXPECT_GE(sample->t_s, last_s);
        last_s = sample->t_s;
        ++odometry;
      } else {
        EXPECT_EQ(std::get<model::YawRateSample>(std::get<model::SensorSample>(message)).omega_radps,
                  -0.001 * i);
        ++rates;
      }
    }
    std::array<std::uint8_t, 64> buffer{};
    for (link::ReadResult result; (result = node.link->read(buffer)).bytes > 0;) node_bytes += result.bytes;
  }
  EXPECT_LE(last_s, clock_s());
  EXPECT_EQ(odometry, 1000U);
  EXPECT_EQ(rates, 1000U);
  EXPECT_EQ(node_bytes, 9000U);
  EXPECT_EQ(input_.counters().dropped(), 0U) << input_.last_problem();
  EXPECT_EQ(opened.link->can_counters()->frames, 2000U);
}

TEST_F(RobotOnCan, ReadsFramesOfCanFd) {
  const CanParticipant base(bus_.name());
  signals_.used = {signal(kImu, 16), std::nullopt, signal(kImu, 32 * 8), std::nullopt};
  const link::OpenedLink opened = open_robot_can(signals_);
  ASSERT_TRUE(opened.link) << opened.error.message;
  wire::CanFrame frame;
  frame.id = kImu & CAN_EFF_MASK;
  frame.format = wire::CanFormat::kFd;
  frame.size = 48;
  frame.data[2] = 0xE8;
  frame.data[3] = 0x03;
  frame.data[32] = 0x64;
  base.send(frame);
  const std::vector<RobotMessage> messages = read_all(*opened.link, input_);
  ASSERT_EQ(messages.size(), 1U);
  EXPECT_EQ(std::get<model::OdometrySample>(messages[0]).vx_mps, 1.0);
  EXPECT_DOUBLE_EQ(std::get<model::OdometrySample>(messages[0]).omega_radps, 0.1);
}

TEST_F(RobotOnCan, SurvivesTheInterfaceGoingDownAndComingUp) {
  link::ReconnectingLink link([this] { return open_robot_can(signals_); });
  double now_s = 0.0;
  ASSERT_TRUE(link.service(now_s)) << link.last_error().message;
  {
    const CanParticipant base(bus_.name());
    send(base, kDrive, 1000, 0);
  }
  for (int round = 0; round < 20; ++round) {
    bus_.down();
    EXPECT_EQ(read_all(*link.get(), input_).size(), 1U) << "earlier frames are not lost";
    std::array<std::uint8_t, 64> buffer{};
    EXPECT_TRUE(link.read(buffer, now_s).gone);
    now_s = link.next_attempt_s();
    EXPECT_FALSE(link.service(now_s));
    EXPECT_THAT(link.last_error().message, HasSubstr("can:bus0: bus0 is down"));
    bus_.up();
    now_s = link.next_attempt_s();
    ASSERT_TRUE(link.service(now_s)) << link.last_error().message;
    const CanParticipant base(bus_.name());
    send(base, kDrive, 1000, 0);
  }
}

TEST_F(RobotOnCan, ReportsBusErrorsAndBadValues) {
  const CanParticipant base(bus_.name());
  const link::OpenedLink opened = open_robot_can(signals_);
  ASSERT_TRUE(opened.link) << opened.error.message;
  can_frame error{};
  error.can_id = CAN_ERR_FLAG | CAN_ERR_BUSOFF;
  error.can_dlc = CAN_ERR_DLC;
  base.send_raw(error);
  send(base, kDrive, 0x7FFF, 0);
  EXPECT_TRUE(read_all(*opened.link, input_).empty());
  const std::string news = opened.link->take_news();
  EXPECT_THAT(news, HasSubstr("can:bus0: the controller has left the bus"));
  EXPECT_THAT(news, HasSubstr("1 values not used so far; the last: Drive.Value is 32.7"));
  EXPECT_EQ(opened.link->can_counters()->bus_off, 1U);
}

}  // namespace
}  // namespace groma::daemon
