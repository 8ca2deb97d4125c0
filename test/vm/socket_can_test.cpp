// Nodes on a CAN interface, through the kernel's sockets.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <linux/can/error.h>
#include <poll.h>
#include <unistd.h>

#include <chrono>
#include <numeric>
#include <string>
#include <thread>
#include <vector>

#include "host/link/can_log.hpp"
#include "host/link/can_path.hpp"
#include "host/link/reconnecting_link.hpp"
#include "host/link/report_decoder.hpp"
#include "test/host/link/node_frames.hpp"
#include "test/support/virtual_can.hpp"

namespace groma::link {
namespace {

using groma::test::CanParticipant;
using groma::test::VirtualCan;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using wire::CanDirection;
using wire::CanFormat;

// Collects what a ReportDecoder passes to its sink.
class Collected : public NodeSink {
 public:
  void on_range(const model::RangeSample& range) override { ranges.push_back(range); }
  void on_log(const groma_Log& log) override { logs.emplace_back(log.text); }

  std::vector<model::RangeSample> ranges;
  std::vector<std::string> logs;
};

class SocketCan : public ::testing::Test {
 protected:
  [[nodiscard]] std::string path(unsigned node, const std::string& scheme = "can") const {
    return scheme + ":" + bus_.name() + "/" + std::to_string(node);
  }

  // Opens a link; throws if that fails.
  static std::unique_ptr<ByteLink> open(const std::string& path) {
    OpenedLink opened = open_link(path, 0);
    if (!opened.link) throw std::runtime_error(opened.error.message);
    return std::move(opened.link);
  }
  static const CanCounters& counters(const ByteLink& link) { return *link.can_counters(); }

  // Reads everything available.
  static std::vector<std::uint8_t> read_all(ByteLink& link, std::size_t chunk = 512) {
    std::vector<std::uint8_t> all;
    std::vector<std::uint8_t> buffer(chunk);
    for (ReadResult result; (result = link.read(buffer)).bytes > 0;) {
      all.insert(all.end(), buffer.begin(), buffer.begin() + static_cast<std::ptrdiff_t>(result.bytes));
    }
    return all;
  }

  void send_from(unsigned node, std::span<const std::uint8_t> stream,
                 CanFormat format = CanFormat::kClassic) const {
    others_.send_stream(stream, format, {CanDirection::kToHost, static_cast<std::uint16_t>(node)});
  }

  void send_error(std::uint32_t classes, std::uint8_t controller = 0) const {
    can_frame frame{};
    frame.can_id = CAN_ERR_FLAG | classes;
    frame.can_dlc = CAN_ERR_DLC;
    frame.data[1] = controller;
    others_.send_raw(frame);
  }

  VirtualCan bus_{"bus0"};
  CanParticipant others_{"bus0"};
};

std::vector<std::uint8_t> report_of(std::uint32_t sequence, std::uint32_t tag) {
  std::vector<groma_Range> ranges;
  for (std::uint16_t anchor = 10; anchor < 20; ++anchor) {
    ranges.push_back(test::make_range(anchor, 1.0 + 0.5 * anchor, std::int64_t{-1'000'000} * anchor));
  }
  return test::frame_of(test::make_report(sequence, tag, 1'000'000'000ULL * (sequence + 1), ranges));
}

TEST_F(SocketCan, CarriesReportsInClassicFrames) {
  const auto link = open(path(3));
  ReportDecoder decoder(equivalent_baud(CanFormat::kClassic));
  Collected got;
  std::size_t can_frames = 0;
  for (std::uint32_t i = 0; i < 50; ++i) {
    const auto report = report_of(i, 3);
    can_frames += (report.size() + 7) / 8;
    send_from(3, report);
    decoder.take(read_all(*link), 1.0 + 0.1 * i, got);
  }
  EXPECT_EQ(decoder.counters().reports, 50U);
  EXPECT_EQ(decoder.counters().frames_lost, 0U);
  EXPECT_EQ(decoder.frame_counters().bytes_discarded, 0U);
  ASSERT_EQ(got.ranges.size(), 500U);
  EXPECT_EQ(got.ranges.back().anchor_id, 19);
  EXPECT_FLOAT_EQ(static_cast<float>(got.ranges.back().range_m), 10.5F);
  EXPECT_EQ(counters(*link).frames, can_frames);
  EXPECT_THAT(link->take_news(), IsEmpty());
}

TEST_F(SocketCan, CarriesReportsInFdFramesMixedWithClassicOnes) {
  const auto link = open(path(3, "canfd"));
  ReportDecoder decoder(equivalent_baud(CanFormat::kFd));
  Collected got;
  for (std::uint32_t i = 0; i < 50; ++i) {
    send_from(3, report_of(i, 3), i % 5 == 4 ? CanFormat::kClassic : CanFormat::kFd);
    decoder.take(read_all(*link), 1.0 + 0.1 * i, got);
  }
  EXPECT_EQ(decoder.counters().reports, 50U);
  EXPECT_EQ(decoder.frame_counters().crc_errors, 0U);
  EXPECT_EQ(got.ranges.size(), 500U);
}

TEST_F(SocketCan, ReceivesNoFdFramesOnAClassicLink) {
  const auto link = open(path(3));
  send_from(3, report_of(0, 3), CanFormat::kFd);
  EXPECT_THAT(read_all(*link), IsEmpty());
}

TEST_F(SocketCan, SeparatesTwoNodesOnOneBus) {
  const auto third = open(path(3));
  const auto fourth = open(path(4));
  const auto of_third = report_of(7, 3);
  const auto of_fourth = report_of(9, 4);
  // The frames of both nodes alternate, as on a shared bus.
  for (std::size_t at = 0; at < std::max(of_third.size(), of_fourth.size()); at += 8) {
    const auto part = [&](const std::vector<std::uint8_t>& all) {
      return std::span(all)
          .subspan(std::min(at, all.size()))
          .first(std::min<std::size_t>(8, all.size() - std::min(at, all.size())));
    };
    send_from(3, part(of_third));
    send_from(4, part(of_fourth));
  }
  EXPECT_EQ(read_all(*third), of_third);
  EXPECT_EQ(read_all(*fourth), of_fourth);
}

TEST_F(SocketCan, ReadsInPiecesOfAnySize) {
  const auto link = open(path(3, "canfd"));
  std::vector<std::uint8_t> stream(1000);
  std::iota(stream.begin(), stream.end(), std::uint8_t{1});
  stream.back() = 0;
  for (const std::size_t chunk : {1U, 7U, 64U, 100U, 4096U}) {
    send_from(3, stream, CanFormat::kFd);
    auto got = read_all(*link, chunk);
    ASSERT_GE(got.size(), stream.size());
    got.resize(stream.size());
    EXPECT_EQ(got, stream) << chunk;
  }
}

TEST_F(SocketCan, IgnoresFramesThatAreNotFromItsNode) {
  const auto link = open(path(3, "canfd"));
  wire::CanFrame frame;
  frame.size = 2;
  frame.data = {0x66, 0x66};
  for (const std::uint32_t id :
       {wire::can_id({CanDirection::kToHost, 4}), wire::can_id({CanDirection::kToNode, 3}),
        wire::can_id({CanDirection::kToHost, 0x103}), 0x0600'0003U, 0x1600'0003U | 1U << 20}) {
    frame.id = id;
    others_.send(frame);
    frame.format = CanFormat::kFd;
    others_.send(frame);
    frame.format = CanFormat::kClassic;
  }
  can_frame raw{};
  raw.can_dlc = 8;
  raw.can_id = 3;  // 11 bits
  others_.send_raw(raw);
  raw.can_id = wire::can_id({CanDirection::kToHost, 3}) | CAN_EFF_FLAG | CAN_RTR_FLAG;
  others_.send_raw(raw);
  EXPECT_THAT(read_all(*link), IsEmpty());
  EXPECT_EQ(counters(*link).frames, 0U);

  frame.id = wire::can_id({CanDirection::kToHost, 3});
  others_.send(frame);
  frame.size = 0;
  others_.send(frame);
  EXPECT_THAT(read_all(*link), ElementsAre(0x66, 0x66));
}

TEST_F(SocketCan, WritesToItsNode) {
  const auto link = open(path(3));
  const std::vector<std::uint8_t> stream{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0};
  EXPECT_EQ(link->write(stream), stream.size());
  const auto first = others_.receive();
  const auto second = others_.receive();
  ASSERT_TRUE(first && second);
  EXPECT_EQ(first->id, wire::can_id({CanDirection::kToNode, 3}));
  EXPECT_EQ(first->format, CanFormat::kClassic);
  EXPECT_THAT(std::vector(first->payload().begin(), first->payload().end()),
              ElementsAre(0, 1, 2, 3, 4, 5, 6, 7));
  EXPECT_THAT(std::vector(second->payload().begin(), second->payload().end()), ElementsAre(8, 9, 0));
  EXPECT_THAT(read_all(*link), IsEmpty()) << "its own frames do not come back";
}

TEST_F(SocketCan, PadsFdFramesOnlyAfterTheEndOfAFrame) {
  const auto link = open(path(3, "canfd"));
  const std::vector<std::uint8_t> ended{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0};
  EXPECT_EQ(link->write(ended), ended.size());
  const auto filled = others_.receive();
  ASSERT_TRUE(filled);
  EXPECT_EQ(filled->format, CanFormat::kFd);
  EXPECT_TRUE(filled->bit_rate_switch);
  EXPECT_THAT(std::vector(filled->payload().begin(), filled->payload().end()),
              ElementsAre(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 0));

  const std::vector<std::uint8_t> part{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10};
  EXPECT_EQ(link->write(part), part.size());
  const auto first = others_.receive();
  const auto second = others_.receive();
  ASSERT_TRUE(first && second);
  EXPECT_EQ(first->size, 8);
  EXPECT_THAT(std::vector(second->payload().begin(), second->payload().end()), ElementsAre(8, 9, 10));
}

TEST_F(SocketCan, SurvivesTheInterfaceGoingDownAndComingUp) {
  ReconnectingLink link([this] { return open_link(path(3), 0); });
  double now_s = 0.0;
  ASSERT_TRUE(link.service(now_s)) << link.last_error().message;
  std::vector<std::uint8_t> buffer(64);
  const std::vector<std::uint8_t> last_words{1, 2, 3, 0};
  send_from(3, last_words);

  bus_.down();
  EXPECT_EQ(link.read(buffer, now_s).bytes, last_words.size()) << "earlier frames are not lost";
  EXPECT_TRUE(link.read(buffer, now_s).gone);
  EXPECT_EQ(link.counters().lost, 1U);
  now_s = link.next_attempt_s();
  EXPECT_FALSE(link.service(now_s));
  EXPECT_EQ(link.last_error().fault, LinkFault::kNoDevice);
  EXPECT_THAT(link.last_error().message,
              HasSubstr("bus0 is down; 'sudo ip link set bus0 up type can bitrate 1000000'"));

  bus_.up();
  now_s = link.next_attempt_s();
  ASSERT_TRUE(link.service(now_s)) << link.last_error().message;
  CanParticipant(bus_.name()).send_stream(last_words, CanFormat::kClassic, {CanDirection::kToHost, 3});
  EXPECT_EQ(link.read(buffer, now_s).bytes, last_words.size());
}

TEST_F(SocketCan, IsGoneIfAWriteFindsTheInterfaceDown) {
  const auto link = open(path(3));
  bus_.down();
  const std::vector<std::uint8_t> stream{1, 0};
  EXPECT_EQ(link->write(stream), 0U);
  std::uint8_t byte = 0;
  EXPECT_TRUE(link->read({&byte, 1}).gone);
}

TEST_F(SocketCan, SurvivesTheAdapterBeingUnplugged) {
  ReconnectingLink link([this] { return open_link(path(3, "canfd"), 0); });
  double now_s = 0.0;
  ASSERT_TRUE(link.service(now_s)) << link.last_error().message;
  std::vector<std::uint8_t> buffer(64);

  bus_.remove();
  EXPECT_TRUE(link.read(buffer, now_s).gone);
  now_s = link.next_attempt_s();
  EXPECT_FALSE(link.service(now_s));
  EXPECT_EQ(link.last_error().fault, LinkFault::kNoDevice);
  EXPECT_THAT(link.last_error().message, HasSubstr("there is no interface bus0"));

  bus_.add();
  now_s = link.next_attempt_s();
  ASSERT_TRUE(link.service(now_s)) << link.last_error().message;
  CanParticipant(bus_.name())
      .send_stream(std::vector<std::uint8_t>{5, 0}, CanFormat::kFd, {CanDirection::kToHost, 3});
  EXPECT_EQ(link.read(buffer, now_s).bytes, 2U);
}

TEST_F(SocketCan, CountsFramesThatAFullQueueLoses) {
  const auto link = open(path(3));
  const auto report = report_of(0, 3);
  const std::size_t frames_each = (report.size() + 7) / 8;
  std::size_t sent = 0;
  for (; sent < 20'000; sent += frames_each) send_from(3, report);
  // The socket reports the loss with the first frame that fits again.
  static_cast<void>(read_all(*link));
  send_from(3, report);
  sent += frames_each;
  static_cast<void>(read_all(*link));
  EXPECT_GT(counters(*link).frames, 500U);
  EXPECT_GT(counters(*link).frames_overrun, 0U);
  EXPECT_EQ(counters(*link).frames + counters(*link).frames_overrun, sent);
  EXPECT_THAT(link->take_news(), HasSubstr("the computer is too busy"));
  EXPECT_THAT(link->take_news(), IsEmpty()) << "reported once";
}

TEST_F(SocketCan, ReportsBusErrorsAndRecovery) {
  const auto link = open(path(3));
  send_error(CAN_ERR_CRTL, CAN_ERR_CRTL_TX_WARNING);
  send_error(CAN_ERR_CRTL, CAN_ERR_CRTL_TX_PASSIVE);
  send_error(CAN_ERR_CRTL, CAN_ERR_CRTL_TX_PASSIVE);
  EXPECT_THAT(read_all(*link), IsEmpty());
  EXPECT_THAT(link->take_news(),
              HasSubstr(path(3) + ": many errors on the bus (the controller is error-passive)"));

  send_error(CAN_ERR_BUSOFF);
  const std::vector<std::uint8_t> bytes{9, 0};
  EXPECT_THAT(read_all(*link), IsEmpty());
  const std::string news = link->take_news();
  EXPECT_THAT(news, HasSubstr("(bus-off)"));
  EXPECT_THAT(news, HasSubstr("'sudo ip link set bus0 type can restart'"));

  send_error(CAN_ERR_RESTARTED);
  send_from(3, bytes);
  EXPECT_EQ(read_all(*link), bytes);
  EXPECT_THAT(link->take_news(), HasSubstr("the bus works again"));

  send_error(CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW);
  send_error(CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW);
  send_error(CAN_ERR_LOSTARB);
  EXPECT_THAT(read_all(*link), IsEmpty());
  EXPECT_THAT(link->take_news(), HasSubstr("the controller's own buffer was full"));

  EXPECT_EQ(counters(*link).error_frames, 7U) << "a lost arbitration does not count";
  EXPECT_EQ(counters(*link).error_passive, 1U);
  EXPECT_EQ(counters(*link).bus_off, 1U);
  EXPECT_EQ(counters(*link).restarts, 1U);
  EXPECT_EQ(counters(*link).controller_overruns, 2U);
}

TEST_F(SocketCan, SaysWhyAnInterfaceCannotBeUsed) {
  EXPECT_THAT(open_link("can:can9/3", 0).error.message,
              HasSubstr("can:can9/3: there is no interface can9; available CAN interfaces: "));
  EXPECT_THAT(open_link("can:can9/3", 0).error.message, HasSubstr("bus0"));
  const LinkError loopback = open_link("can:lo/3", 0).error;
  EXPECT_EQ(loopback.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(loopback.message, HasSubstr("lo is not a CAN interface"));
  bus_.down();
  EXPECT_THAT(open_link(path(3, "canfd"), 0).error.message,
              HasSubstr("up type can bitrate 1000000 dbitrate 2000000 fd on"));

  const VirtualCan classic("classic0", CAN_MTU);
  const LinkError no_fd = open_link("canfd:classic0/3", 0).error;
  EXPECT_EQ(no_fd.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(no_fd.message, HasSubstr("classic0 is set up for classic CAN"));
  EXPECT_THAT(no_fd.message, HasSubstr("can:classic0/3"));
  EXPECT_TRUE(open_link("can:classic0/3", 0).link);
}

TEST_F(SocketCan, NeedsNoPrivileges) {
  if (::geteuid() != 0 || ::seteuid(65534) != 0) GTEST_SKIP() << "cannot become another user";
  OpenedLink opened = open_link(path(3), 0);
  ASSERT_EQ(::seteuid(0), 0);
  ASSERT_TRUE(opened.link) << opened.error.message;
  const std::vector<std::uint8_t> bytes{1, 2, 0};
  send_from(3, bytes);
  EXPECT_EQ(read_all(*opened.link), bytes);
}

TEST_F(SocketCan, ReadsALogOfCandumpUnchanged) {
  constexpr const char* kCandump = "/usr/bin/candump";
  if (::access(kCandump, X_OK) != 0) GTEST_SKIP() << "no can-utils here";
  const auto stream = report_of(5, 3);
  // candump receives nothing before it has opened its socket: wait before sending.
  groma::test::ChildResult dumped;
  std::thread candump([&] { dumped = groma::test::run_child({kCandump, "-L", "-T", "1000", bus_.name()}); });
  std::this_thread::sleep_for(std::chrono::milliseconds(700));
  send_from(3, stream);
  send_from(3, stream, CanFormat::kFd);
  candump.join();

  std::vector<std::uint8_t> read;
  std::size_t fd_frames = 0;
  for (std::size_t at = 0; at < dumped.out.size();) {
    const std::size_t end = dumped.out.find('\n', at);
    const CanLogLine line = parse_candump_line(std::string_view(dumped.out).substr(at, end - at));
    at = end == std::string::npos ? dumped.out.size() : end + 1;
    ASSERT_TRUE(line.intact && line.frame) << dumped.out;
    EXPECT_EQ(line.frame->interface, bus_.name());
    EXPECT_EQ(line.frame->frame.bit_rate_switch, line.frame->frame.format == CanFormat::kFd);
    fd_frames += line.frame->frame.format == CanFormat::kFd ? 1U : 0U;
    const auto bytes = wire::stream_in(line.frame->frame, {CanDirection::kToHost, 3});
    read.insert(read.end(), bytes.begin(), bytes.end());
  }
  EXPECT_EQ(fd_frames, (stream.size() + 63) / 64) << dumped.out << dumped.err;
  ASSERT_GE(read.size(), 2 * stream.size());
  EXPECT_TRUE(std::equal(stream.begin(), stream.end(), read.begin()));
  EXPECT_TRUE(
      std::equal(stream.begin(), stream.end(), read.begin() + static_cast<std::ptrdiff_t>(stream.size())));
}

}  // namespace
}  // namespace groma::link
