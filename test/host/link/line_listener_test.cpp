#include "host/link/line_listener.hpp"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <chrono>
#include <filesystem>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "test/host/daemon/temporary_folder.hpp"

namespace groma::link {
namespace {

using ::testing::HasSubstr;

// A program that sends lines to a listener.
class Sender {
 public:
  explicit Sender(const std::filesystem::path& file) : fd_(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    file.string().copy(address.sun_path, sizeof(address.sun_path) - 1);
    if (::connect(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
      throw std::runtime_error("connect");
    }
  }
  Sender(int type, std::uint16_t port) : fd_(::socket(AF_INET, type | SOCK_CLOEXEC, 0)) {
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (::connect(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
      throw std::runtime_error("connect");
    }
  }
  void send(const std::string& text) const {
    ASSERT_EQ(::send(fd_.get(), text.data(), text.size(), MSG_NOSIGNAL), static_cast<ssize_t>(text.size()));
  }
  void leave() { fd_.close(); }
  // The listener has closed the connection.
  [[nodiscard]] bool is_dropped() const {
    char byte = 0;
    return ::recv(fd_.get(), &byte, 1, MSG_DONTWAIT) == 0;
  }

 private:
  Descriptor fd_;
};

// Everything that comes until the text has that size.
std::string read_text(ByteLink& link, std::size_t size) {
  std::string text;
  const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(20);
  while (text.size() < size && std::chrono::steady_clock::now() < deadline) {
    std::uint8_t buffer[7];
    const ReadResult result = link.read(buffer);
    EXPECT_FALSE(result.gone);
    text.append(buffer, buffer + result.bytes);
    if (result.bytes == 0) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  return text;
}

class UnixListener : public ::testing::Test {
 protected:
  UnixListener() : opened_(open_line_listener(path_.string())) {
    if (!opened_.link) throw std::runtime_error(opened_.error.message);
  }
  [[nodiscard]] std::size_t clients() const {
    return dynamic_cast<const LineListener&>(*opened_.link).client_count();
  }

  groma::test::TemporaryFolder folder_;
  std::filesystem::path path_ = folder_ / "robot.sock";
  OpenedLink opened_;
};

TEST_F(UnixListener, PassesOnWholeLinesOfSeveralClients) {
  const Sender first(path_);
  Sender second(path_);
  first.send("{\"half\":");
  second.send("{\"two\":2}\n{\"three\":");
  EXPECT_EQ(read_text(*opened_.link, 10), "{\"two\":2}\n");
  first.send("1}\n");
  EXPECT_EQ(read_text(*opened_.link, 11), "{\"half\":1}\n");
  EXPECT_EQ(clients(), 2U);
  second.send("3}");
  second.leave();
  EXPECT_EQ(read_text(*opened_.link, 12), "{\"three\":3}\n") << "the last line needs no line feed";
  EXPECT_EQ(clients(), 1U);
}

TEST_F(UnixListener, CutsALineThatIsTooLong) {
  const Sender sender(path_);
  const std::string part(1000, 'x');
  for (int i = 0; i < 20; ++i) sender.send(part);
  sender.send("\nnext\n");
  std::string text;
  for (std::string more = "-"; !more.empty() && !text.ends_with("next\n"); text += more)
    more = read_text(*opened_.link, 1);
  ASSERT_TRUE(text.ends_with("next\n"));
  text.resize(text.size() - 5);
  EXPECT_GT(text.size(), LineListener::kMaxLine + 1);
  EXPECT_LE(text.size(), 2 * LineListener::kMaxLine + 1);
  EXPECT_EQ(text.find('\n'), text.size() - 1);
}

TEST_F(UnixListener, ReplacesTheClientThatIsSilentForLongest) {
  std::vector<std::unique_ptr<Sender>> senders;
  for (std::size_t i = 0; i < LineListener::kMaxClients; ++i) {
    senders.push_back(std::make_unique<Sender>(path_));
    senders.back()->send("a\n");
    ASSERT_EQ(read_text(*opened_.link, 2), "a\n");
  }
  senders[0]->send("b\n");
  ASSERT_EQ(read_text(*opened_.link, 2), "b\n");
  const Sender late(path_);
  late.send("c\n");
  EXPECT_EQ(read_text(*opened_.link, 2), "c\n");
  EXPECT_EQ(clients(), LineListener::kMaxClients);
  EXPECT_FALSE(senders[0]->is_dropped());
  EXPECT_TRUE(senders[1]->is_dropped());
  EXPECT_FALSE(senders[2]->is_dropped());
}

TEST_F(UnixListener, ReplacesAStaleFileButNoServedOne) {
  struct stat status {};
  ASSERT_EQ(::stat(path_.c_str(), &status), 0);
  EXPECT_EQ(status.st_mode & 0777U, 0660U);
  const OpenedLink second = open_line_listener(path_.string());
  EXPECT_FALSE(second.link);
  EXPECT_EQ(second.error.fault, LinkFault::kBusy);
  opened_.link.reset();
  EXPECT_FALSE(std::filesystem::exists(path_));
  {
    // As a killed program leaves it.
    const Descriptor stale(::socket(AF_UNIX, SOCK_STREAM, 0));
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    path_.string().copy(address.sun_path, sizeof(address.sun_path) - 1);
    ASSERT_EQ(::bind(stale.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
  }
  EXPECT_TRUE(open_line_listener(path_.string()).link);
  const std::string file = folder_.write("file", "text").string();
  EXPECT_EQ(open_line_listener(file).error.fault, LinkFault::kBusy) << "no socket: not removed";
  EXPECT_TRUE(std::filesystem::exists(file));
  EXPECT_EQ(open_line_listener((folder_ / "none" / "x").string()).error.fault, LinkFault::kNoDevice);
  EXPECT_EQ(open_line_listener("/tmp/" + std::string(200, 'x')).error.fault, LinkFault::kUnsuitable);
}

// A listener at a free port.
OpenedLink open_at_free_port(const std::string& scheme, std::uint16_t& port) {
  OpenedLink opened;
  for (port = 40'000; !opened.link && port < 40'200; ++port)
    opened = open_line_listener(scheme + "://127.0.0.1:" + std::to_string(port));
  --port;
  return opened;
}

TEST(TcpListener, PassesOnLines) {
  std::uint16_t port = 0;
  const OpenedLink opened = open_at_free_port("tcp", port);
  ASSERT_TRUE(opened.link) << opened.error.message;
  const Sender sender(SOCK_STREAM, port);
  sender.send("one\ntwo\n");
  EXPECT_EQ(read_text(*opened.link, 8), "one\ntwo\n");
  const OpenedLink second = open_line_listener("tcp://127.0.0.1:" + std::to_string(port));
  EXPECT_EQ(second.error.fault, LinkFault::kBusy);
  EXPECT_THAT(second.error.message, HasSubstr("another program listens here"));
  EXPECT_EQ(open_line_listener("tcp://192.0.2.1:4000").error.fault, LinkFault::kNoDevice);
  EXPECT_EQ(open_line_listener("tcp://host:4000").error.fault, LinkFault::kNoDevice);
}

TEST(UdpListener, EndsEachDatagramsLastLine) {
  std::uint16_t port = 0;
  const OpenedLink opened = open_at_free_port("udp", port);
  ASSERT_TRUE(opened.link) << opened.error.message;
  const Sender sender(SOCK_DGRAM, port);
  sender.send("one");
  sender.send("two\nthree\n");
  sender.send("four");
  EXPECT_EQ(read_text(*opened.link, 19), "one\ntwo\nthree\nfour\n");
}

}  // namespace
}  // namespace groma::link
