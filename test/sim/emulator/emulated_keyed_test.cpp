// The shipped image in a keyed network: its ECB computes and verifies the same MICs as the native nodes'
// software.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/frame_authenticator.hpp"
#include "firmware/sim/aes.hpp"
#include "firmware/sim/transmitter.hpp"
#include "test/sim/emulator/emulated_site.hpp"
#include "test/support/frames.hpp"

namespace groma::sim {
namespace {

constexpr security::Key kKey{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};

TEST(ShippedImageWithAKey, RangesWithNativeNodesWithoutLateTransmits) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  SiteSettings settings{.tags = 1, .anchors = 2, .method = groma_RangingMethod_METHOD_DS_NEXT_POLL};
  settings.network_key = kKey;
  // The tag and the second anchor are emulated; the master is native.
  SiteBench site(emulating(settings, {}, [](std::uint16_t id) { return id != nth_anchor(0); }));
  site.run_until(2.2);
  const double rate = 2.0 / seconds_of(site.superframe());
  EXPECT_GT(site.good_ranges(1.2), 0.95 * rate);
  site.each_range([&](const groma_SlotReport&, const groma_Range& range) {
    if (range.status != groma_RangeStatus_RANGE_OK) return;
    const double truth = site.space.distance_m(1, static_cast<std::uint16_t>(range.anchor_id));
    EXPECT_NEAR(static_cast<double>(range.range_m), truth, 0.1);
  });
  for (const Listener& listener : site.listeners) {
    EXPECT_EQ(listener.counters.forged_frames, 0U);
    EXPECT_EQ(listener.counters.unsecured_frames, 0U);
    EXPECT_EQ(listener.counters.late_transmits, 0U);
    EXPECT_EQ(listener.counters.late_receives, 0U);
  }
  EXPECT_GT(emulated(site, 0).soc().ecb().blocks(), 1'000U);
  EXPECT_GT(emulated(site, 2).soc().ecb().blocks(), 1'000U);
}

// Records tag 1's POLLs and counts the RESPONSEs to them.
class Recorder final : public Witness {
 public:
  explicit Recorder(Medium& medium) { medium.set_witness(this); }
  void announced(const AirFrame& frame) override {
    const auto bytes = std::span(frame.data).first(frame.length - 2U);
    const auto parsed = mac::parse(bytes);
    if (!parsed.frame) return;
    if (std::holds_alternative<mac::Response>(parsed.frame->body) && parsed.frame->destination == nth_tag(0))
      ++responses;
    if (!std::holds_alternative<mac::Poll>(parsed.frame->body) || parsed.frame->source != nth_tag(0)) return;
    poll_start = frame.preamble_start;
    poll = *parsed.frame;
    poll_bytes.assign(bytes.begin(), bytes.end());
  }
  int responses = 0;
  SimTime poll_start = 0;
  mac::Frame poll;
  std::vector<std::uint8_t> poll_bytes;
};

// The tag is off, and an attacker without the key polls in its place. It replays the tag's last POLL, or
// sends a current one with the last one's MIC or with a MIC by another key. Another tag keeps ranging, so
// that the anchors do not search for other networks.
TEST(ShippedImageWithAKey, AnswersNoForgedPollAndCountsEach) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  constexpr std::uint16_t kAttacker = 900;
  constexpr int kAnchors = 2;
  constexpr int kTags = 2;
  SiteSettings settings{
      .tags = kTags, .anchors = kAnchors, .method = groma_RangingMethod_METHOD_DS_NEXT_POLL};
  settings.network_key = kKey;
  SiteBench site(emulating(settings));
  site.space.put(kAttacker, {2.0, 2.0, 1.5});
  Recorder recorder(site.network.medium());
  Transmitter attacker(kAttacker, site.network.medium());
  site.run_until(1.5);
  ASSERT_GT(recorder.responses, 100);
  site.network.set_power(0, false);
  site.run_until(1.51);
  const SimTime start = recorder.poll_start;
  const mac::Frame last = recorder.poll;
  const std::vector<std::uint8_t> last_bytes = recorder.poll_bytes;
  const int answered = recorder.responses;
  const auto& body = std::get<mac::Poll>(last.body);
  const SimTime duration = site.superframe().duration().count() * kUnitsPerTick;

  Aes aes;
  const security::Key another_key{9, 9, 9};
  mac::SignedPlaces signed_places;
  mac::FrameAuthenticator other(&aes, another_key, &signed_places);
  other.enter(1);
  constexpr std::uint32_t kForged = 12;
  std::uint32_t ahead = 0;
  for (std::uint32_t sent = 0; sent < kForged; ++sent) {
    do ++ahead;
    while (start + ahead * duration < site.network.now() + 2 * kUnitsPerMillisecond);
    mac::Frame now = last;
    mac::Poll poll = body;
    poll.superframe += ahead;
    poll.exchange = static_cast<std::uint16_t>(poll.exchange + ahead);
    now.body = poll;
    mac::FrameBytes made = mac::serialize(now);
    sign(other, made, poll, {poll.superframe, poll.slot});
    std::vector<std::uint8_t> bytes(made.bytes().begin(), made.bytes().end());
    if (sent % 3 == 0) bytes = last_bytes;
    if (sent % 3 == 1)
      std::copy(last_bytes.end() - mac::kCodeBytes, last_bytes.end(), bytes.end() - mac::kCodeBytes);
    attacker.send(start + ahead * duration + kUnitsPerMicrosecond, bytes);
    site.run_until(to_seconds(start + ahead * duration + duration / 2));
  }
  site.run_until(to_seconds(site.network.now()) + 1.2);
  EXPECT_EQ(recorder.responses, answered);
  for (int i = 0; i < kAnchors; ++i) {
    EXPECT_EQ(site.listeners[static_cast<std::size_t>(kTags + i)].counters.forged_frames, kForged) << i;
  }
}

}  // namespace
}  // namespace groma::sim
