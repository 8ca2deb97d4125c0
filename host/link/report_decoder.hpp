// From the bytes of one node's link to what they say: ranges with instants in host time, and the node's own
// reports about itself.
#pragma once

#include <cstdint>
#include <cstring>
#include <span>
#include <vector>

#include "groma.pb.h"
#include "host/clock/time_mapper.hpp"
#include "host/model/types.hpp"
#include "proto/frame_codec.hpp"

namespace groma::link {

// An enumeration's field as the number that came. Read it by this: nanopb stores any number, and a number
// that the enumeration does not have must not be loaded as one.
template <typename Enum>
[[nodiscard]] std::uint32_t number_in(const Enum& field) noexcept {
  static_assert(sizeof(Enum) == sizeof(std::uint32_t));
  std::uint32_t number = 0;
  std::memcpy(&number, &field, sizeof(number));
  return number;
}

// Takes what a ReportDecoder finds. Strings in the messages end with a zero.
class NodeSink {
 public:
  NodeSink(const NodeSink&) = delete;
  NodeSink& operator=(const NodeSink&) = delete;
  virtual ~NodeSink() = default;

  // range.t_s is the range's own instant in host time.
  virtual void on_range(const model::RangeSample& range) = 0;
  virtual void on_hello(const groma_Hello& /*hello*/) {}
  virtual void on_network_status(const groma_NetworkStatus& /*status*/) {}
  virtual void on_counters(const groma_Counters& /*counters*/) {}
  virtual void on_log(const groma_Log& /*log*/) {}
  virtual void on_reply(const groma_Reply& /*reply*/) {}
  // What another node than the wired one said, over the air; nothing of that comes by the calls above.
  virtual void on_relayed(const groma_NodeToHost& /*message*/) {}

 protected:
  NodeSink() = default;
};

// Everything that arrived is counted; a range in exactly one of the four.
struct ReportCounters {
  std::uint64_t messages = 0;              // frames with a message in them
  std::uint64_t messages_malformed = 0;    // whole frames whose content is no message of the schema
  std::uint64_t reports = 0;               // SlotReports and CompactReports
  std::uint64_t frames_lost = 0;           // reports missing in the sequence, on the node or on the link
  std::uint64_t ranges = 0;                // delivered
  std::uint64_t ranges_not_ok = 0;         // with another status than RANGE_OK
  std::uint64_t ranges_out_of_bounds = 0;  // not finite, or not within (0, kMaxRange_m]
  // Further from their report than kMaxInstantOffset_s, or of a report whose own time is early.
  std::uint64_t ranges_bad_instant = 0;
  std::uint64_t time_replies = 0;      // to time_request()
  std::uint64_t time_replies_odd = 0;  // to none of this host's clock, or after more than kMaxRoundTrip_s
};

// A frame that asks a node for its time, as it is handed to the link at now_s (from 0) of the clock that
// ReportDecoder::take() is told of; the reply tells its decoder what delay the link has. Once a second will
// do.
[[nodiscard]] std::vector<std::uint8_t> time_request(double now_s);

class ReportDecoder {
 public:
  static constexpr double kMaxRange_m = 1000.0;
  static constexpr double kMaxInstantOffset_s = 5.0;
  static constexpr double kMaxRoundTrip_s = 1.0;

  // baud: bits per second of the link, 10 to a byte, for the time that a frame takes; 0 takes none.
  explicit ReportDecoder(unsigned baud) noexcept : baud_(baud) {}

  // Bytes that arrived at arrival_s of the host's clock.
  void take(std::span<const std::uint8_t> bytes, double arrival_s, NodeSink& sink);

  // After the link was opened anew: what was begun is forgotten, and the clocks are related anew.
  void link_reopened() noexcept;

  [[nodiscard]] const ReportCounters& counters() const noexcept { return counters_; }
  [[nodiscard]] const wire::FrameCounters& frame_counters() const noexcept { return frames_.counters(); }
  [[nodiscard]] const clock::TimeMapper& time() const noexcept { return time_; }

 private:
  void take_message(double arrival_s, NodeSink& sink);
  void take_report(const groma_SlotReport& report, double arrival_s, NodeSink& sink);
  void take_time_reply(const groma_TimeReply& reply, double arrival_s);
  void count_lost(const groma_SlotReport& report) noexcept;
  [[nodiscard]] double transmission_s(std::size_t bytes) const noexcept;

  double baud_;
  wire::FrameDecoder frames_;
  clock::TimeMapper time_{clock::kDeviceTicksPerSecond};
  groma_NodeToHost message_ = groma_NodeToHost_init_zero;
  groma_SlotReport expanded_ = groma_SlotReport_init_zero;  // a CompactReport's content
  bool has_report_ = false;
  std::uint32_t last_sequence_ = 0;
  std::uint64_t last_device_time_dtu_ = 0;
  std::uint32_t last_tag_id_ = 0;
  ReportCounters counters_;
};

}  // namespace groma::link
