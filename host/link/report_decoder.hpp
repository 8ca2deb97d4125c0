// Decodes the bytes of one node's link: ranges with their times on the host's clock, and the node's reports
// about itself.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <span>
#include <vector>

#include "groma.pb.h"
#include "host/clock/time_mapper.hpp"
#include "host/model/types.hpp"
#include "proto/frame_codec.hpp"

namespace groma::link {

// The number in an enumeration's field. Read such fields with this function: nanopb stores any received
// number, and loading one that is not an enumerator is undefined behaviour.
template <typename Enum>
[[nodiscard]] std::uint32_t number_in(const Enum& field) noexcept {
  static_assert(sizeof(Enum) == sizeof(std::uint32_t));
  std::uint32_t number = 0;
  std::memcpy(&number, &field, sizeof(number));
  return number;
}

// "tag", "anchor", else "unconfigured".
[[nodiscard]] const char* role_word(const groma_Role& role) noexcept;
// "locked", "coasting", else "searching".
[[nodiscard]] const char* sync_word(const groma_SyncState& state) noexcept;

// Receives the messages of a ReportDecoder. Strings in them are zero-terminated.
class NodeSink {
 public:
  NodeSink(const NodeSink&) = delete;
  NodeSink& operator=(const NodeSink&) = delete;
  virtual ~NodeSink() = default;

  // range.t_s is the time of the range itself, in host time.
  virtual void on_range(const model::RangeSample& range) = 0;
  virtual void on_hello(const groma_Hello& /*hello*/) {}
  virtual void on_network_status(const groma_NetworkStatus& /*status*/) {}
  virtual void on_counters(const groma_Counters& /*counters*/) {}
  virtual void on_slack(const groma_Slack& /*slack*/) {}
  virtual void on_log(const groma_Log& /*log*/) {}
  virtual void on_reply(const groma_Reply& /*reply*/) {}
  // A message of another node than the wired one, received over the air; the calls above never give those.
  virtual void on_relayed(const groma_NodeToHost& /*message*/) {}

 protected:
  NodeSink() = default;
};

// Each received range is counted in exactly one of the four counters of ranges.
struct ReportCounters {
  std::uint64_t messages = 0;              // frames with a valid message
  std::uint64_t messages_malformed = 0;    // intact frames whose content is not a message of the schema
  std::uint64_t reports = 0;               // SlotReports and CompactReports, without repeated ones
  std::uint64_t reports_repeated = 0;      // received before: dropped
  std::uint64_t frames_lost = 0;           // reports missing in the sequence, lost on node or link
  std::uint64_t ranges = 0;                // delivered
  std::uint64_t ranges_not_ok = 0;         // with another status than RANGE_OK
  std::uint64_t ranges_out_of_bounds = 0;  // not finite, or not within (0, kMaxRange_m]
  // Further than kMaxInstantOffset_s from their report, or in a report whose own time is early.
  std::uint64_t ranges_bad_instant = 0;
  std::uint64_t time_replies = 0;            // to time_request()
  std::uint64_t time_replies_unmatched = 0;  // not to a request of this host, or later than kMaxRoundTrip_s
};

// A frame that requests a node's time, to be handed to the link at now_s: not negative, on the clock of
// ReportDecoder::take(). The decoder estimates the link's delay from the reply. One request a second is
// enough.
[[nodiscard]] std::vector<std::uint8_t> time_request(double now_s);
// The frame of any request; empty if the message cannot be encoded.
[[nodiscard]] std::vector<std::uint8_t> request_frame(const groma_HostToNode& message);

class ReportDecoder {
 public:
  static constexpr double kMaxRange_m = 1000.0;
  static constexpr double kMaxInstantOffset_s = 5.0;
  static constexpr double kMaxRoundTrip_s = 1.0;
  // A larger gap in the sequence of reports is no loss. Faster than any schedule.
  static constexpr double kMaxReports_hz = 1000.0;
  // Reports that a repeated one is recognized among: at least 3 s of them.
  static constexpr std::size_t kRememberedReports = 2048;

  // baud: bit rate of the link in bit/s, 10 bits a byte, for the transmission time; 0: none.
  explicit ReportDecoder(unsigned baud) noexcept : baud_(baud) {}

  // Decodes bytes that arrived at arrival_s (host time).
  void take(std::span<const std::uint8_t> bytes, double arrival_s, NodeSink& sink);

  // After the link was reopened: discards an incomplete frame and restarts the clock estimate.
  void link_reopened() noexcept;

  [[nodiscard]] const ReportCounters& counters() const noexcept { return counters_; }
  [[nodiscard]] const wire::FrameCounters& frame_counters() const noexcept { return frames_.counters(); }
  [[nodiscard]] const clock::TimeMapper& time() const noexcept { return time_; }
  // The tag of the last report.
  [[nodiscard]] std::optional<std::uint32_t> tag_id() const noexcept {
    return last_report_ ? std::optional(last_report_->tag_id) : std::nullopt;
  }

 private:
  // What identifies a report.
  struct ReportKey {
    std::uint64_t device_time_dtu = 0;
    std::uint32_t sequence = 0;
    std::uint32_t tag_id = 0;

    [[nodiscard]] bool operator==(const ReportKey&) const = default;
  };

  void take_message(double arrival_s, NodeSink& sink);
  void take_report(const groma_SlotReport& report, double arrival_s, NodeSink& sink);
  void take_time_reply(const groma_TimeReply& reply, double arrival_s);
  [[nodiscard]] bool is_repeated(const ReportKey& report) const noexcept;
  void count_lost(const ReportKey& report) noexcept;
  [[nodiscard]] double transmission_s(std::size_t bytes) const noexcept;

  double baud_;
  wire::FrameDecoder frames_;
  clock::TimeMapper time_{clock::kDeviceTicksPerSecond};
  groma_NodeToHost message_ = groma_NodeToHost_init_zero;
  groma_SlotReport expanded_ = groma_SlotReport_init_zero;  // a CompactReport's content
  std::optional<ReportKey> last_report_;
  std::array<ReportKey, kRememberedReports> remembered_{};  // a ring
  ReportCounters counters_;
};

}  // namespace groma::link
