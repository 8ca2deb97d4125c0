#include "host/link/byte_link.hpp"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <poll.h>
#include <pty.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <termios.h>
#include <unistd.h>

#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "host/link/descriptor.hpp"
#include "host/link/reconnecting_link.hpp"

namespace groma::link {
namespace {

using ::testing::HasSubstr;

// A real pseudo-terminal: the test holds the master end, the link opens the slave by its path.
class Pty {
 public:
  Pty() {
    int master = -1;
    int slave = -1;
    if (::openpty(&master, &slave, nullptr, nullptr, nullptr) != 0) throw std::runtime_error("openpty");
    char name[128];
    if (::ttyname_r(slave, name, sizeof(name)) != 0) throw std::runtime_error("ttyname_r");
    path_ = name;
    ::close(slave);
    master_ = Descriptor(master);
  }
  [[nodiscard]] const std::string& path() const { return path_; }
  [[nodiscard]] int master() const { return master_.get(); }
  void send(const std::string& text) const {
    ASSERT_EQ(::write(master(), text.data(), text.size()), static_cast<ssize_t>(text.size()));
  }
  void hang_up() { master_.close(); }

 private:
  Descriptor master_;
  std::string path_;
};

class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "groma-link-XXXXXX").string();
    if (::mkdtemp(name.data()) == nullptr) throw std::runtime_error("mkdtemp");
    path_ = name;
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  ~TemporaryFolder() { std::filesystem::remove_all(path_); }
  [[nodiscard]] std::filesystem::path operator/(const std::string& name) const { return path_ / name; }
  [[nodiscard]] const std::filesystem::path& path() const { return path_; }

 private:
  std::filesystem::path path_;
};

// Waits up to two seconds for bytes or the end.
ReadResult read_soon(ByteLink& link, std::span<std::uint8_t> out) {
  for (int i = 0; i < 20; ++i) {
    pollfd entry{link.poll_fd(), POLLIN, 0};
    ::poll(&entry, 1, 100);
    const ReadResult result = link.read(out);
    if (result.bytes > 0 || result.gone) return result;
  }
  return {};
}

std::string read_text(ByteLink& link) {
  std::vector<std::uint8_t> buffer(4096);
  const ReadResult result = read_soon(link, buffer);
  return {buffer.begin(), buffer.begin() + static_cast<std::ptrdiff_t>(result.bytes)};
}

TEST(PtyLink, CarriesEachByteValueBothWaysUnchanged) {
  const Pty pty;
  OpenedLink opened = open_link(pty.path(), 115200);
  ASSERT_TRUE(opened.link) << opened.error.message;
  std::string all;
  for (int i = 0; i < 256; ++i) all.push_back(static_cast<char>(i));
  pty.send(all);
  EXPECT_EQ(read_text(*opened.link), all);

  const std::vector<std::uint8_t> bytes(all.begin(), all.end());
  EXPECT_EQ(opened.link->write(bytes), bytes.size());
  std::vector<char> back(512);
  const ssize_t n = ::read(pty.master(), back.data(), back.size());
  EXPECT_EQ(std::string(back.data(), static_cast<std::size_t>(n)), all);
}

TEST(PtyLink, ReadsWithoutWaiting) {
  const Pty pty;
  const OpenedLink opened = open_link(pty.path(), 115200);
  ASSERT_TRUE(opened.link);
  std::uint8_t byte = 0;
  const ReadResult result = opened.link->read({&byte, 1});
  EXPECT_EQ(result.bytes, 0U);
  EXPECT_FALSE(result.gone);
}

TEST(PtyLink, SetsTheBitRate) {
  for (const auto& [baud, code] : {std::pair{115200U, B115200}, {1000000U, B1000000}, {921600U, B921600}}) {
    const Pty pty;
    const OpenedLink opened = open_link(pty.path(), baud);
    ASSERT_TRUE(opened.link);
    termios settings{};
    ASSERT_EQ(::tcgetattr(pty.master(), &settings), 0);
    EXPECT_EQ(::cfgetispeed(&settings), code);
    EXPECT_EQ(::cfgetospeed(&settings), code);
    EXPECT_EQ(settings.c_lflag & static_cast<tcflag_t>(ICANON | ECHO), 0U);
  }
}

TEST(PtyLink, RefusesAnInvalidRate) {
  const Pty pty;
  const OpenedLink opened = open_link(pty.path(), 123456);
  EXPECT_FALSE(opened.link);
  EXPECT_EQ(opened.error.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(opened.error.message, HasSubstr(pty.path()));
  EXPECT_THAT(opened.error.message, HasSubstr("123456"));
}

TEST(PtyLink, IsGoneAfterAHangUp) {
  Pty pty;
  const OpenedLink opened = open_link(pty.path(), 115200);
  ASSERT_TRUE(opened.link);
  std::vector<std::uint8_t> buffer(64);
  pty.hang_up();
  const ReadResult result = read_soon(*opened.link, buffer);
  EXPECT_EQ(result.bytes, 0U);
  EXPECT_TRUE(result.gone);
  const std::uint8_t byte = 1;
  EXPECT_EQ(opened.link->write({&byte, 1}), 0U);
}

TEST(PtyLink, CanBeOpenedAgainAfterClosing) {
  const Pty pty;
  for (int i = 0; i < 3; ++i) {
    const OpenedLink opened = open_link(pty.path(), 115200);
    ASSERT_TRUE(opened.link) << opened.error.message;
    pty.send("again");
    EXPECT_EQ(read_text(*opened.link), "again");
  }
}

TEST(PtyLink, RefusesASecondReader) {
  const Pty pty;
  OpenedLink first = open_link(pty.path(), 115200);
  ASSERT_TRUE(first.link);
  const OpenedLink second = open_link(pty.path(), 115200);
  EXPECT_FALSE(second.link);
  EXPECT_EQ(second.error.fault, LinkFault::kBusy);
  EXPECT_THAT(second.error.message, HasSubstr(pty.path()));
  first.link.reset();
  EXPECT_TRUE(open_link(pty.path(), 115200).link);
}

TEST(OpenLink, NamesAMissingDevice) {
  for (const auto open : {open_link, open_pty, open_serial_port}) {
    const OpenedLink opened = open("/dev/ttyGroma99", 115200);
    EXPECT_FALSE(opened.link);
    EXPECT_EQ(opened.error.fault, LinkFault::kNoDevice) << opened.error.message;
    EXPECT_THAT(opened.error.message, HasSubstr("/dev/ttyGroma99: no such device"));
    EXPECT_THAT(opened.error.message, HasSubstr("/dev/serial/by-id"));
  }
}

TEST(OpenLink, RefusesAPathThatIsNotATerminal) {
  EXPECT_EQ(open_link("/dev/null", 115200).error.fault, LinkFault::kUnsuitable);
  EXPECT_EQ(open_serial_port("/dev/null", 115200).error.fault, LinkFault::kUnsuitable);
  EXPECT_EQ(open_pty("/dev/null", 115200).error.fault, LinkFault::kUnsuitable);
  const OpenedLink folder = open_link("/tmp", 115200);
  EXPECT_EQ(folder.error.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(folder.error.message, HasSubstr("/tmp: "));
}

constexpr gid_t kTty = 5;  // on Debian

// The advice never makes a user a member of the group root.
TEST(OpenLink, AdvisesAUdevRuleForADeviceOfRoot) {
  if (::geteuid() != 0) GTEST_SKIP() << "only root can give a pseudo-terminal to the group root";
  const Pty pty;
  ASSERT_EQ(::chown(pty.path().c_str(), 0, 0), 0);
  ASSERT_EQ(::chmod(pty.path().c_str(), 0600), 0);
  ASSERT_EQ(::seteuid(65534), 0);
  const OpenedLink opened = open_link(pty.path(), 115200);
  ASSERT_EQ(::seteuid(0), 0);
  EXPECT_EQ(opened.error.fault, LinkFault::kPermission) << opened.error.message;
  EXPECT_THAT(opened.error.message, HasSubstr("groma flash --udev-rules"));
  EXPECT_EQ(opened.error.message.find("usermod"), std::string::npos) << opened.error.message;
}

TEST(OpenLink, NamesTheGroupThatMayOpenADevice) {
  const Pty pty;
  ASSERT_EQ(::chmod(pty.path().c_str(), 0600), 0);
  const bool root = ::geteuid() == 0;
  if (root) {
    ASSERT_EQ(::chown(pty.path().c_str(), 0, kTty), 0);
    ASSERT_EQ(::seteuid(65534), 0);
  } else if (::chmod(pty.path().c_str(), 0) != 0) {
    GTEST_SKIP() << "the pseudo-terminal's mode cannot be changed";
  }
  const OpenedLink opened = open_link(pty.path(), 115200);
  if (root) {
    ASSERT_EQ(::seteuid(0), 0);
  }
  EXPECT_FALSE(opened.link);
  EXPECT_EQ(opened.error.fault, LinkFault::kPermission) << opened.error.message;
  EXPECT_THAT(opened.error.message, HasSubstr("usermod -aG"));
}

TEST(Recording, IsReadToItsEnd) {
  const TemporaryFolder folder;
  std::ofstream(folder / "capture.bin") << "0123456789";
  const OpenedLink opened = open_link((folder / "capture.bin").string(), 0);
  ASSERT_TRUE(opened.link);
  std::uint8_t buffer[4];
  std::string text;
  ReadResult result;
  while (!(result = opened.link->read(buffer)).gone) text.append(buffer, buffer + result.bytes);
  EXPECT_EQ(text, "0123456789");
}

TEST(UnixSocket, ConnectsCarriesAndEnds) {
  const TemporaryFolder folder;
  const std::string path = (folder / "robot.sock").string();
  Descriptor listener(::socket(AF_UNIX, SOCK_STREAM, 0));
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  path.copy(address.sun_path, sizeof(address.sun_path) - 1);
  ASSERT_EQ(::bind(listener.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
  EXPECT_EQ(open_link(path, 0).error.fault, LinkFault::kNoDevice) << "no listener yet";
  ASSERT_EQ(::listen(listener.get(), 1), 0);
  OpenedLink opened = open_link(path, 0);
  ASSERT_TRUE(opened.link) << opened.error.message;
  Descriptor peer(::accept(listener.get(), nullptr, nullptr));
  ASSERT_EQ(::write(peer.get(), "hello", 5), 5);
  EXPECT_EQ(read_text(*opened.link), "hello");
  peer.close();
  std::uint8_t byte = 0;
  EXPECT_TRUE(read_soon(*opened.link, {&byte, 1}).gone);
  EXPECT_EQ(opened.link->write({&byte, 1}), 0U);
}

TEST(UnixSocket, RefusesAPathThatIsTooLong) {
  const std::string long_path(200, 'x');
  EXPECT_EQ(open_unix_socket("/tmp/" + long_path).error.fault, LinkFault::kUnsuitable);
}

TEST(ReconnectingLink, WaitsLongerAfterEachFailureAndStartsOverAfterData) {
  std::unique_ptr<Pty> pty;
  ReconnectingLink link([&]() -> OpenedLink {
    if (!pty) return {nullptr, explain_open_error("/dev/ttyACM0", ENOENT)};
    return open_link(pty->path(), 115200);
  });
  std::vector<double> attempts;
  for (int ms = 0; ms < 20'000; ++ms) {
    const double now_s = 1e-3 * ms;
    const auto before = link.counters().attempts_failed;
    ASSERT_FALSE(link.service(now_s));
    if (link.counters().attempts_failed != before) attempts.push_back(now_s);
  }
  ASSERT_GE(attempts.size(), 6U);
  EXPECT_LT(attempts.size(), 14U);
  for (std::size_t i = 2; i < attempts.size(); ++i) {
    const double wait = attempts[i] - attempts[i - 1];
    EXPECT_GE(wait, attempts[i - 1] - attempts[i - 2] - 1e-9);
    EXPECT_LE(wait, ReconnectingLink::kLongestWait_s + 2e-3);
  }
  EXPECT_EQ(link.last_error().fault, LinkFault::kNoDevice);

  pty = std::make_unique<Pty>();
  double now_s = link.next_attempt_s();
  ASSERT_TRUE(link.service(now_s));
  ASSERT_FALSE(link.service(now_s)) << "already open";
  pty->send("x");
  std::uint8_t buffer[8];
  for (int i = 0; i < 100 && link.read(buffer, now_s).bytes == 0; ++i) ::usleep(1000);

  pty.reset();
  ReadResult result;
  for (int i = 0; i < 100 && !(result = link.read(buffer, now_s)).gone; ++i) ::usleep(1000);
  EXPECT_TRUE(result.gone);
  EXPECT_EQ(link.counters().lost, 1U);
  EXPECT_EQ(link.get(), nullptr);
  EXPECT_NEAR(link.next_attempt_s() - now_s, ReconnectingLink::kFirstWait_s, 1e-9);

  pty = std::make_unique<Pty>();
  now_s = link.next_attempt_s();
  EXPECT_TRUE(link.service(now_s));
  EXPECT_EQ(link.counters().opened, 2U);
}

}  // namespace
}  // namespace groma::link
