#include "host/doctor/pose_stream.hpp"

#include <fmt/format.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <span>
#include <utility>

namespace groma::doctor {
namespace {

using Json = nlohmann::json;

constexpr std::size_t kLongestLine = 1U << 20U;  // beyond that, the other side is not gromad
constexpr double kLongerForStatus_s = 3.0;
constexpr double kMetrics_s = 2.0;

double monotonic_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

double unix_s() {
  return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

// Waits until the link can be read, and appends what it has. False: it has ended.
bool receive(link::ByteLink& link, double wait_s, std::string& text) {
  pollfd entry{link.poll_fd(), POLLIN, 0};
  static_cast<void>(::poll(&entry, 1, static_cast<int>(1000.0 * std::max(0.0, wait_s))));
  std::array<std::uint8_t, 65536> buffer{};
  while (true) {
    const link::ReadResult read = link.read(buffer);
    text.append(buffer.begin(), buffer.begin() + static_cast<std::ptrdiff_t>(read.bytes));
    if (read.gone) return false;
    if (read.bytes == 0 || text.size() > kLongestLine) return true;
  }
}

}  // namespace

std::string address_of(const daemon::Endpoint& endpoint) {
  std::string host = endpoint.address;
  if (host == "0.0.0.0") host = "127.0.0.1";
  if (host == "::") host = "::1";
  return "tcp://" + daemon::authority(host, endpoint.port);
}

PoseStream::Opened PoseStream::open(const std::string& address) {
  link::OpenedLink opened = link::open_link(address, 0);
  if (opened.error.fault == link::LinkFault::kNoDevice) {
    return {nullptr, fmt::format("{}: gromad does not answer there; start it, or give its address", address)};
  }
  if (!opened.link) return {nullptr, opened.error.message};
  return {std::unique_ptr<PoseStream>(new PoseStream(std::move(opened.link))), {}};
}

std::vector<Json> PoseStream::read(double wait_s) {
  lines_.clear();
  if (!ended_) ended_ = !receive(*link_, wait_s, rest_);
  std::vector<Json> objects;
  std::size_t begin = 0;
  for (std::size_t end = 0; (end = rest_.find('\n', begin)) != std::string::npos; begin = end + 1) {
    std::string line = rest_.substr(begin, end - begin);
    Json object = Json::parse(line, nullptr, false);
    const bool is_message = object.is_object() && object.value("class", Json()).is_string();
    if (!is_message) continue;
    objects.push_back(std::move(object));
    lines_.push_back(std::move(line));
  }
  rest_.erase(0, begin);
  if (rest_.size() > kLongestLine) ended_ = true;
  return objects;
}

double Observation::growth(const std::string& pointer) const {
  if (statuses.size() < 2) return 0.0;
  const Json::json_pointer at(pointer);
  const auto value = [&](const Json& status) {
    const Json found = status.contains(at) ? status.at(at) : Json();
    return found.is_number() ? found.get<double>() : 0.0;
  };
  return value(statuses.back()) - value(statuses.front());
}

double Observation::duration_s() const {
  return received_s.size() < 2 ? 0.0 : received_s.back() - received_s.front();
}

Observation observe(const std::string& address, double for_s) {
  Observation out;
  PoseStream::Opened opened = PoseStream::open(address);
  out.error = opened.error;
  if (!opened.stream) return out;
  out.is_served = true;
  const double begin_s = monotonic_s();
  std::size_t poses = 0;
  const auto goes_on = [&] {
    const double elapsed_s = monotonic_s() - begin_s;
    return elapsed_s < for_s || (out.statuses.size() < 2 && elapsed_s < for_s + kLongerForStatus_s);
  };
  while (!opened.stream->ended() && goes_on()) {
    const std::vector<Json> objects = opened.stream->read(0.1);
    for (std::size_t i = 0; i < objects.size(); ++i) {
      const std::string name = objects.at(i).at("class");
      if (name == "POSE") {
        out.pose = objects.at(i);
        if (!out.statuses.empty()) ++poses;
        continue;
      }
      out.lines.push_back(opened.stream->lines().at(i));
      if (name == "VERSION") out.version = objects.at(i);
      if (name != "STATUS") continue;
      out.statuses.push_back(objects.at(i));
      out.received_s.push_back(unix_s());
      out.poses = poses;
    }
  }
  if (out.version.is_null()) {
    out.error = fmt::format("{}: the program that listens there is not gromad; choose another port", address);
  } else if (out.statuses.size() < 2) {
    out.error = fmt::format("{}: gromad does not report its status; it hangs, or was stopped", address);
  }
  return out;
}

std::string read_metrics(const daemon::WebSettings& web) {
  const link::OpenedLink opened = link::open_link(address_of(web.endpoint), 0);
  if (!opened.link) return {};
  std::string text = "GET /metrics HTTP/1.0\r\nHost: localhost\r\nConnection: close\r\n";
  const std::string token = daemon::read_secrets(web).access.token;
  if (!token.empty()) text += "Authorization: Bearer " + token + "\r\n";
  text += "\r\n";
  const std::vector<std::uint8_t> request(text.begin(), text.end());
  if (opened.link->write(request) != request.size()) return {};
  std::string answer;
  const double end_s = monotonic_s() + kMetrics_s;
  while (monotonic_s() < end_s && receive(*opened.link, 0.1, answer)) {
  }
  const std::size_t body = answer.find("\r\n\r\n");
  const bool is_good = answer.starts_with("HTTP/1.") && answer.substr(8, 5).find(" 200") == 0;
  return is_good && body != std::string::npos ? answer.substr(body + 4) : std::string();
}

}  // namespace groma::doctor
