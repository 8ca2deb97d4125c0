// A USB serial converter through libserialport: opened, used, unplugged and plugged in again. The virtual
// machine emulates the converter (test/vm/run --usb); the kernel's driver for FTDI's chips serves it.
#include <fcntl.h>
#include <gmock/gmock.h>
#include <grp.h>
#include <gtest/gtest.h>
#include <poll.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

#include <chrono>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "host/io/descriptor.hpp"
#include "host/link/byte_link.hpp"
#include "host/link/reconnecting_link.hpp"
#include "host/link/report_decoder.hpp"
#include "host/link/usb_port.hpp"
#include "test/host/link/node_frames.hpp"

namespace groma::link {
namespace {

using ::testing::HasSubstr;

constexpr const char* kPort = "/dev/ttyUSB0";
constexpr unsigned kBaud = 1'000'000;
constexpr auto kPatience = std::chrono::seconds(10);

bool eventually(const std::function<bool()>& done) {
  const auto deadline = std::chrono::steady_clock::now() + kPatience;
  while (!done()) {
    if (std::chrono::steady_clock::now() > deadline) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

// The converter's far end, in place of a node's UART.
class FarEnd {
 public:
  FarEnd() : fd_(::open("/dev/groma-usb-far-end", O_RDWR | O_NONBLOCK | O_CLOEXEC)) {
    if (!fd_.valid()) throw std::runtime_error("no far end; run this with test/vm/run --usb");
  }

  void send(std::span<const std::uint8_t> bytes) const {
    while (!bytes.empty()) {
      const ssize_t n = ::write(fd_.get(), bytes.data(), bytes.size());
      if (n > 0) bytes = bytes.subspan(static_cast<std::size_t>(n));
      pollfd entry{fd_.get(), POLLOUT, 0};
      if (n <= 0 && ::poll(&entry, 1, 2000) <= 0) throw std::runtime_error("the far end accepts no bytes");
    }
  }

  std::vector<std::uint8_t> receive(std::size_t size) const {
    std::vector<std::uint8_t> got;
    eventually([&] {
      std::uint8_t buffer[512];
      const ssize_t n = ::read(fd_.get(), buffer, sizeof(buffer));
      if (n > 0) got.insert(got.end(), buffer, buffer + n);
      return got.size() >= size;
    });
    return got;
  }

 private:
  io::Descriptor fd_;
};

// QEMU's monitor.
class Socket {
 public:
  Socket() : monitor_(::open("/dev/groma-monitor", O_RDWR | O_CLOEXEC)) {}

  void unplug() const { send("device_del converter"); }
  void plug_in() const { send("device_add usb-serial,chardev=usb,id=converter,bus=xhci.0"); }

 private:
  void send(const std::string& command) const {
    const std::string line = command + "\n";
    if (::write(monitor_.get(), line.data(), line.size()) != static_cast<ssize_t>(line.size())) {
      throw std::runtime_error("QEMU's monitor accepts no commands");
    }
  }

  io::Descriptor monitor_;
};

std::vector<std::uint8_t> read_until(ByteLink& link, std::size_t size) {
  std::vector<std::uint8_t> got;
  eventually([&] {
    std::uint8_t buffer[300];
    const ReadResult result = link.read(buffer);
    got.insert(got.end(), buffer, buffer + result.bytes);
    return result.gone || got.size() >= size;
  });
  return got;
}

class SerialPort : public ::testing::Test {
 protected:
  void SetUp() override {
    ASSERT_TRUE(eventually([] { return ::access(kPort, F_OK) == 0; })) << "no converter";
  }

  static std::unique_ptr<ByteLink> open() {
    OpenedLink opened = open_link(kPort, kBaud);
    if (!opened.link) throw std::runtime_error(opened.error.message);
    return std::move(opened.link);
  }

  FarEnd far_end_;
  Socket socket_;
};

TEST_F(SerialPort, CarriesEachByteValueBothWaysUnchanged) {
  const auto link = open();
  std::vector<std::uint8_t> bytes;
  for (int round = 0; round < 20; ++round) {
    for (int value = 0; value < 256; ++value)
      bytes.push_back(static_cast<std::uint8_t>((value * 37 + round) & 0xFF));
  }
  std::thread sender([&] { far_end_.send(bytes); });
  EXPECT_EQ(read_until(*link, bytes.size()), bytes);
  sender.join();

  std::vector<std::uint8_t> got;
  for (std::span<const std::uint8_t> rest(bytes); !rest.empty();) {
    rest = rest.subspan(link->write(rest));
    const auto more = far_end_.receive(1);
    got.insert(got.end(), more.begin(), more.end());
  }
  const auto more = far_end_.receive(bytes.size() - got.size());
  got.insert(got.end(), more.begin(), more.end());
  EXPECT_EQ(got, bytes);
}

TEST_F(SerialPort, IsSetRawAndToTheBitRate) {
  const auto link = open();
  termios settings{};
  ASSERT_EQ(::tcgetattr(link->poll_fd(), &settings), 0);
  EXPECT_EQ(::cfgetospeed(&settings), static_cast<speed_t>(B1000000));
  EXPECT_EQ(settings.c_lflag & static_cast<tcflag_t>(ICANON | ECHO | ISIG), 0U);
  EXPECT_EQ(settings.c_iflag & static_cast<tcflag_t>(IXON | IXOFF | ICRNL | INLCR), 0U);
  EXPECT_EQ(settings.c_cflag & static_cast<tcflag_t>(CSIZE), static_cast<tcflag_t>(CS8));
  EXPECT_EQ(settings.c_cflag & static_cast<tcflag_t>(PARENB | CSTOPB | CRTSCTS), 0U);
}

TEST_F(SerialPort, ReadsWithoutBlockingAndSupportsPoll) {
  const auto link = open();
  std::uint8_t buffer[16];
  const ReadResult nothing = link->read(buffer);
  EXPECT_EQ(nothing.bytes, 0U);
  EXPECT_FALSE(nothing.gone);
  far_end_.send(std::vector<std::uint8_t>{1, 2, 3});
  pollfd entry{link->poll_fd(), POLLIN, 0};
  EXPECT_EQ(::poll(&entry, 1, 5000), 1);
  EXPECT_EQ(read_until(*link, 3).size(), 3U);
}

TEST_F(SerialPort, RejectsASecondReader) {
  const auto link = open();
  const OpenedLink second = open_link(kPort, kBaud);
  EXPECT_FALSE(second.link);
  EXPECT_EQ(second.error.fault, LinkFault::kBusy) << second.error.message;
  EXPECT_THAT(second.error.message, HasSubstr(kPort));
}

TEST_F(SerialPort, NamesTheGroupThatMayOpenIt) {
  const group* dialout = ::getgrnam("dialout");
  ASSERT_NE(dialout, nullptr);
  ASSERT_EQ(::chown(kPort, 0, dialout->gr_gid), 0);
  ASSERT_EQ(::chmod(kPort, 0660), 0);
  ASSERT_EQ(::seteuid(65534), 0);
  const OpenedLink opened = open_link(kPort, kBaud);
  ASSERT_EQ(::seteuid(0), 0);
  EXPECT_FALSE(opened.link);
  EXPECT_EQ(opened.error.fault, LinkFault::kPermission) << opened.error.message;
  EXPECT_THAT(opened.error.message, HasSubstr("sudo usermod -aG dialout $USER"));
}

TEST_F(SerialPort, IsFoundByTheSerialNumberOfItsDevice) {
  const std::vector<UsbPort> ports = list_usb_ports();
  ASSERT_EQ(ports.size(), 1U);
  EXPECT_EQ("/dev/" + ports[0].name, kPort);
  const OpenedLink opened = open_link("serial:" + ports[0].serial, kBaud);
  ASSERT_TRUE(opened.link) << opened.error.message;
  const std::vector<std::uint8_t> bytes{1, 2, 3};
  far_end_.send(bytes);
  EXPECT_EQ(read_until(*opened.link, bytes.size()), bytes);
  EXPECT_THAT(open_link("serial:none", kBaud).error.message,
              HasSubstr("connected serial numbers: " + ports[0].serial + " (ttyUSB0)"));
}

TEST_F(SerialPort, IsGoneWhenUnpluggedAndComesBackWhenPluggedIn) {
  ReconnectingLink link([] { return open_link(kPort, kBaud); });
  ReportDecoder decoder(kBaud);
  class Collected : public NodeSink {
   public:
    void on_range(const model::RangeSample& range) override { ranges.push_back(range); }
    std::vector<model::RangeSample> ranges;
  } got;
  const auto start = std::chrono::steady_clock::now();
  const auto now_s = [&] {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  };
  std::uint8_t buffer[300];
  bool gone = false;
  const auto serve = [&] {
    if (link.service(now_s())) decoder.link_reopened();
    const ReadResult result = link.read(buffer, now_s());
    decoder.take(std::span(buffer).first(result.bytes), now_s(), got);
    gone = gone || result.gone;
  };
  const auto served_until = [&](const std::function<bool()>& done) {
    return eventually([&] {
      serve();
      return done();
    });
  };
  std::uint32_t sequence = 0;
  const auto report = [&] {
    ++sequence;
    return test::frame_of(
        test::make_report(sequence, 3, 1'000'000'000ULL * sequence, {test::make_range(7, 4.0, -1000)}));
  };

  for (std::size_t round = 0; round < 3; ++round) {
    ASSERT_TRUE(served_until([&] { return link.get() != nullptr; })) << link.last_error().message;
    const std::size_t before = got.ranges.size();
    for (int i = 0; i < 10; ++i) far_end_.send(report());
    EXPECT_TRUE(served_until([&] { return got.ranges.size() >= before + 10; })) << "round " << round;

    gone = false;
    socket_.unplug();
    ASSERT_TRUE(served_until([&] { return gone; })) << "round " << round;
    EXPECT_EQ(link.counters().lost, round + 1);
    const auto failed = link.counters().attempts_failed;
    ASSERT_TRUE(served_until([&] { return link.counters().attempts_failed > failed; }));
    EXPECT_EQ(link.last_error().fault, LinkFault::kNoDevice) << link.last_error().message;
    EXPECT_THAT(link.last_error().message, HasSubstr("/dev/ttyUSB0: no such device"));
    socket_.plug_in();
  }
  EXPECT_TRUE(served_until([&] { return link.get() != nullptr; })) << link.last_error().message;
  EXPECT_EQ(link.counters().opened, 4U);
  EXPECT_EQ(decoder.counters().frames_lost, 0U);
}

TEST_F(SerialPort, AcceptsNoBytesWhenUnplugged) {
  const auto link = open();
  socket_.unplug();
  EXPECT_TRUE(eventually([&] {
    std::uint8_t byte = 0;
    return link->read({&byte, 1}).gone;
  }));
  const std::vector<std::uint8_t> bytes{1, 2, 3};
  EXPECT_EQ(link->write(bytes), 0U);
  socket_.plug_in();
}

}  // namespace
}  // namespace groma::link
