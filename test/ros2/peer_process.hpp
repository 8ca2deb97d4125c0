// ros2-peer as a process (peer.cpp).
#pragma once

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <charconv>
#include <csignal>
#include <cstdint>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "host/io/descriptor.hpp"

namespace groma::test {

struct PeerMessage {
  std::int64_t arrived_ns = 0;  // CLOCK_MONOTONIC
  std::string cdr;
};

class Peer {
 public:
  // An endpoint as of the program's arguments, such as {"read", "rt/tf", "tf2_msgs::msg::dds_::TFMessage_",
  // "reliable", "volatile", "100"}.
  using Endpoint = std::array<std::string, 6>;

  // prefix: of the command, such as OtherHost::prefix().
  Peer(unsigned domain, const std::string& profile, const std::vector<Endpoint>& endpoints,
       std::vector<std::string> prefix = {}) {
    std::vector<std::string> arguments = std::move(prefix);
    arguments.insert(arguments.end(), {ROS2_PEER_PATH, std::to_string(domain), profile});
    for (const Endpoint& endpoint : endpoints)
      arguments.insert(arguments.end(), endpoint.begin(), endpoint.end());
    std::array<int, 2> in{};
    std::array<int, 2> out{};
    if (::pipe2(in.data(), O_CLOEXEC) != 0 || ::pipe2(out.data(), O_CLOEXEC) != 0)
      throw std::runtime_error("pipe2");
    std::vector<char*> argv;
    argv.reserve(arguments.size() + 1);
    for (std::string& argument : arguments) argv.push_back(argument.data());
    argv.push_back(nullptr);
    pid_ = ::fork();
    if (pid_ == 0) {
      ::dup2(in[0], STDIN_FILENO);
      ::dup2(out[1], STDOUT_FILENO);
      ::execvp(argv[0], argv.data());
      ::_exit(127);
    }
    ::close(in[0]);
    ::close(out[1]);
    in_ = io::Descriptor(in[1]);
    out_ = io::Descriptor(out[0]);
    ::fcntl(out_.get(), F_SETFL, O_NONBLOCK);
  }
  Peer(const Peer&) = delete;
  Peer& operator=(const Peer&) = delete;
  ~Peer() {
    ::kill(pid_, SIGKILL);
    ::waitpid(pid_, nullptr, 0);
  }

  void write(const std::string& topic, std::string_view cdr) const {
    constexpr std::string_view kDigits = "0123456789abcdef";
    std::string line = topic + ' ';
    for (const char c : cdr) {
      const auto byte = static_cast<unsigned char>(c);
      line += kDigits[byte >> 4U];
      line += kDigits[byte & 15U];
    }
    line += '\n';
    if (::write(in_.get(), line.data(), line.size()) != static_cast<ssize_t>(line.size()))
      throw std::runtime_error("the peer reads nothing");
  }

  // What it has printed so far.
  void read() {
    std::array<char, 65536> buffer{};
    ssize_t count = 0;
    while ((count = ::read(out_.get(), buffer.data(), buffer.size())) > 0)
      text_.append(buffer.data(), static_cast<std::size_t>(count));
    std::size_t begin = 0;
    for (std::size_t end = 0; (end = text_.find('\n', begin)) != std::string::npos; begin = end + 1)
      take(text_.substr(begin, end - begin));
    text_.erase(0, begin);
  }

  [[nodiscard]] const std::vector<PeerMessage>& of(const std::string& topic) { return messages_[topic]; }
  // All lines but those of messages.
  [[nodiscard]] const std::vector<std::string>& events() const { return events_; }
  [[nodiscard]] bool has_event(std::string_view part) const {
    for (const std::string& event : events_) {
      if (event.find(part) != std::string::npos) return true;
    }
    return false;
  }

 private:
  void take(const std::string& line) {
    if (!line.starts_with("message ")) {
      events_.push_back(line);
      return;
    }
    std::istringstream words(line);
    std::string word;
    std::string topic;
    PeerMessage message;
    std::string hex;
    words >> word >> topic >> message.arrived_ns >> hex;
    for (std::size_t i = 0; i + 1 < hex.size(); i += 2) {
      unsigned byte = 0;
      std::from_chars(hex.data() + i, hex.data() + i + 2, byte, 16);
      message.cdr += static_cast<char>(byte);
    }
    messages_[topic].push_back(std::move(message));
  }

  pid_t pid_ = -1;
  io::Descriptor in_;
  io::Descriptor out_;
  std::string text_;
  std::map<std::string, std::vector<PeerMessage>> messages_;
  std::vector<std::string> events_;
};

}  // namespace groma::test
