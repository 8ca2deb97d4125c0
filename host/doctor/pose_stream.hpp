// A client of gromad's pose stream.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/daemon/web_settings.hpp"
#include "host/link/byte_link.hpp"

namespace groma::doctor {

// "tcp://HOST:PORT" of this server as seen from this computer: all interfaces become loopback.
[[nodiscard]] std::string address_of(const daemon::Endpoint& endpoint);

class PoseStream {
 public:
  struct Opened {
    std::unique_ptr<PoseStream> stream;
    std::string error;  // with what to do, if there is none
  };
  // address: tcp://HOST:PORT. Waits for some seconds at most.
  [[nodiscard]] static Opened open(const std::string& address);

  // Waits for at most wait_s; returns the complete lines that have arrived. Lines that are no JSON objects
  // with a class are left out.
  [[nodiscard]] std::vector<nlohmann::json> read(double wait_s);
  [[nodiscard]] bool ended() const noexcept { return ended_; }
  // For poll(2).
  [[nodiscard]] int fd() const noexcept { return link_->poll_fd(); }
  // The lines that read() returned last, as they came.
  [[nodiscard]] const std::vector<std::string>& lines() const noexcept { return lines_; }

 private:
  explicit PoseStream(std::unique_ptr<link::ByteLink> link) : link_(std::move(link)) {}

  std::unique_ptr<link::ByteLink> link_;
  std::string rest_;  // an incomplete line
  std::vector<std::string> lines_;
  bool ended_ = false;
};

// What a running gromad reported for a while.
struct Observation {       // NOLINT(bugprone-exception-escape): moving JSON does not throw
  std::string error{};     // why there is nothing; empty: VERSION and at least one STATUS came
  bool is_served = false;  // some program serves that address
  nlohmann::json version;
  std::vector<nlohmann::json> statuses{};
  std::vector<double> received_s{};  // of each status, by this computer's clock since 1970
  nlohmann::json pose;               // the last one; null: none
  std::size_t poses = 0;             // from the first to the last status
  std::vector<std::string> lines{};  // VERSION, and all STATUS and CALIBRATION lines, as they came

  // Of a counter of STATUS, such as "/odometry": the last value less the first.
  [[nodiscard]] double growth(const std::string& pointer) const;
  // From the first to the last status.
  [[nodiscard]] double duration_s() const;
};
// Listens for for_s, and up to 3 s more until there are two statuses.
[[nodiscard]] Observation observe(const std::string& address, double for_s);

// The body of gromad's /metrics; empty if there is none. Not over TLS. Throws as read_secrets().
[[nodiscard]] std::string read_metrics(const daemon::WebSettings& web);

}  // namespace groma::doctor
