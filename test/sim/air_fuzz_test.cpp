// A running site receives invalid frames: random bytes, pieces of its own frames, its own frames with flipped
// bits, and frames of each type with random content, all with a valid frame check. Its ranges stay correct,
// and it recovers once the noise ends.
#include <gtest/gtest.h>

#include <array>
#include <memory>
#include <vector>

#include "firmware/sim/transmitter.hpp"
#include "test/sim/fault_campaign.hpp"
#include "test/support/random_bodies.hpp"

namespace groma::sim {
namespace {

constexpr std::uint16_t kNoise = kFirstStranger + 900;
constexpr int kTags = 2;
constexpr int kAnchors = 5;

// Ids are mostly those of the site.
class SiteBodies : public mac::RandomBodies {
 public:
  using RandomBodies::RandomBodies;
  std::uint16_t somebody() override {
    switch (below(8)) {
      case 0:
        return word<std::uint16_t>();
      case 1:
        return mac::kBroadcast;
      case 2:
      case 3:
        return nth_tag(static_cast<int>(below(kTags)));
      default:
        return nth_anchor(static_cast<int>(below(kAnchors)));
    }
  }
};

class Noise {
 public:
  Noise(FaultSite& site, bool secured, std::uint64_t seed)
      : site_(site), secured_(secured), bodies_(seed), transmitter_(kNoise, site.network.medium()) {
    site.hall.put(kNoise, {.centre = {1.0, 1.0, 1.5}});
    site.air.keep_sent = true;
  }

  using Maker = std::vector<std::uint8_t> (Noise::*)();

  // About 1,000 frames a second, one after the other.
  void make(Maker maker, double for_s) {
    const SimTime end = site_.network.now() + from_seconds(for_s);
    SimTime at = site_.network.now() + kAhead;
    while (site_.network.now() < end) {
      while (at < site_.network.now() + kAhead + kStep) {
        transmitter_.send(at, (this->*maker)(), format_);
        at += from_seconds(1e-6 * static_cast<double>(400 + below(1'200)));
      }
      site_.run_for(to_seconds(kStep));
      remember();
    }
    site_.run_for(to_seconds(kAhead + kStep));  // until the last frames are on the air
  }
  [[nodiscard]] std::uint32_t frames() const { return transmitter_.frames_sent(); }

  std::vector<std::uint8_t> random_bytes() {
    std::vector<std::uint8_t> bytes(below(126));
    for (std::uint8_t& byte : bytes) byte = static_cast<std::uint8_t>(below(256));
    return bytes;
  }
  std::vector<std::uint8_t> fragment() {
    std::vector<std::uint8_t> bytes = heard();
    bytes.resize(below(bytes.size()));
    return bytes;
  }
  std::vector<std::uint8_t> flipped() {
    std::vector<std::uint8_t> bytes = heard();
    for (std::size_t i = 0, count = 1 + below(4); i < count; ++i) {
      // Flipping the same bit twice would change nothing.
      const std::size_t bit = 8 * bytes.size() * i / count + below(8 * bytes.size() / count);
      bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    }
    return bytes;
  }
  std::vector<std::uint8_t> beacon() { return framed(bodies_.beacon()); }
  std::vector<std::uint8_t> poll() { return framed(bodies_.poll()); }
  std::vector<std::uint8_t> response() { return framed(bodies_.response()); }
  std::vector<std::uint8_t> final() { return framed(bodies_.final()); }
  std::vector<std::uint8_t> join() { return framed(bodies_.join()); }
  std::vector<std::uint8_t> data() { return framed(bodies_.data()); }

 private:
  static constexpr SimTime kAhead = 2 * kUnitsPerMillisecond;
  static constexpr SimTime kStep = 4 * kUnitsPerMillisecond;

  std::size_t below(std::size_t bound) { return bodies_.below(bound); }
  // In a keyed site with a random MIC, and sometimes without one.
  std::vector<std::uint8_t> framed(const mac::Body& body) {
    const bool secured = secured_ ? below(4) != 0 : below(8) == 0;
    mac::FrameBytes out =
        mac::serialize({.sequence = bodies_.word<std::uint8_t>(),
                        .network = below(8) == 0 ? bodies_.word<std::uint16_t>() : std::uint16_t{7},
                        .destination = bodies_.somebody(),
                        .source = bodies_.somebody(),
                        .secured = secured,
                        .body = body});
    if (secured)
      for (std::uint8_t& byte : out.code()) byte = bodies_.word<std::uint8_t>();
    return {out.bytes().begin(), out.bytes().end()};
  }
  [[nodiscard]] const std::vector<std::uint8_t>& heard() { return heard_[below(heard_.size())]; }
  void remember() {
    constexpr std::size_t kMost = 100;
    for (const AirLog::Sent& sent : site_.air.sent) {
      if (sent.transmitter == kNoise) continue;
      if (heard_.size() == kMost) heard_.erase(heard_.begin());
      heard_.emplace_back(sent.frame.data.begin(),
                          sent.frame.data.begin() + static_cast<std::ptrdiff_t>(sent.frame.length - 2));
    }
    site_.air.sent.clear();
  }

  FaultSite& site_;
  bool secured_;
  SiteBodies bodies_;
  Transmitter transmitter_;
  AirFormat format_{};
  std::vector<std::vector<std::uint8_t>> heard_{{0}};
};

struct FuzzCase {
  bool keyed;
  groma_RangingMethod method;
  std::uint64_t seed = 0;
};

std::ostream& operator<<(std::ostream& out, const FuzzCase& of) {
  return out << (of.keyed ? "keyed" : "open") << " " << of.seed
             << (of.method == groma_RangingMethod_METHOD_DS_FINAL ? ", FINAL" : ", next POLL");
}

// Superframes until all nodes of an open site range again after forged frames. A node that could lead listens
// for up to 20 listening times (2 s) while it hears others, and the sessions started then have to merge.
constexpr double kRecovered = 250.0;

class AirFuzz : public testing::TestWithParam<FuzzCase> {};

FaultPhase noise_phase(const std::shared_ptr<Noise>& noise, const char* name, Noise::Maker maker,
                       double within = 3.0, double watched_s = 0.5) {
  constexpr double kFor_s = 0.5;
  return {.name = name,
          .begin = [=](FaultSite&) { noise->make(maker, kFor_s); },
          .within = within,
          .watched_s = watched_s};
}

TEST_P(AirFuzz, NoRangeIsWrongAndTheSiteRecovers) {
  const FuzzCase of = GetParam();
  FaultSiteSettings settings{
      .tags = kTags, .anchors = kAnchors, .backups = 2, .slots = 3, .method = of.method};
  if (of.keyed) settings.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  FaultSite site(settings);
  const auto noise = std::make_shared<Noise>(site, of.keyed, of.seed + (of.keyed ? 21 : 22));
  // In an open site a misplaced POLL may belong to another network; the nodes scan for it some time later.
  const double poll_recovered = of.keyed ? 3.0 : 2.5 / site.superframe_s();
  const double watched_s = of.keyed ? 0.5 : 3.0;
  // In an open site a forged JOIN may release any tag's slot and fill the table, and a beacon with flipped
  // bits may announce another time or session. The nodes recover within this many superframes.
  const double recovered = of.keyed ? 3.0 : kRecovered;
  FaultCampaign campaign(site);
  std::vector<FaultPhase> phases{
      {.name = "power on", .rise = all_of(kTags, kAnchors), .newcomers_within = 100.0, .watched_s = 2.5},
      no_fault(2.0),
      noise_phase(noise, "random bytes", &Noise::random_bytes),
      noise_phase(noise, "pieces of sent frames", &Noise::fragment),
      noise_phase(noise, "RESPONSEs with random content", &Noise::response),
      noise_phase(noise, "FINALs", &Noise::final),
      noise_phase(noise, "DATA", &Noise::data),
      noise_phase(noise, "BEACONs", &Noise::beacon),
      noise_phase(noise, "POLLs", &Noise::poll, poll_recovered, watched_s),
  };
  // Both kinds can disturb an open site, see above.
  phases.push_back(noise_phase(noise, "JOINs", &Noise::join, recovered, watched_s));
  phases.push_back(noise_phase(noise, "frames with flipped bits", &Noise::flipped, recovered, watched_s));
  phases.push_back(no_fault(2.0));
  campaign.run(phases);
  expect_no_harm(site, campaign);
  std::printf("%s%u frames of noise\n", campaign.table().c_str(), noise->frames());
  groma_Counters sum = groma_Counters_init_zero;
  for (const std::uint16_t id : site.ids()) {
    const groma_Counters counted = site.counters(id);
    EXPECT_EQ(counted.radio_recoveries, 0U) << id;
    sum.foreign_frames += counted.foreign_frames;
    sum.malformed_frames += counted.malformed_frames;
    sum.stale_frames += counted.stale_frames;
    sum.unsecured_frames += counted.unsecured_frames;
    sum.forged_frames += counted.forged_frames;
  }
  std::printf("foreign %u malformed %u stale %u unsecured %u forged %u\n", sum.foreign_frames,
              sum.malformed_frames, sum.stale_frames, sum.unsecured_frames, sum.forged_frames);
  constexpr std::uint32_t kMany = 50;
  EXPECT_GT(noise->frames(), 3'000U);
  EXPECT_GT(sum.foreign_frames, kMany);
  EXPECT_GT(sum.malformed_frames, kMany);
  if (of.keyed) {
    EXPECT_GT(sum.unsecured_frames, kMany);
    EXPECT_GT(sum.forged_frames, kMany);
  } else {
    EXPECT_GT(sum.stale_frames, kMany);
  }
}

INSTANTIATE_TEST_SUITE_P(Sites, AirFuzz,
                         testing::Values(FuzzCase{false, groma_RangingMethod_METHOD_DS_NEXT_POLL},
                                         FuzzCase{false, groma_RangingMethod_METHOD_DS_NEXT_POLL, 6},
                                         FuzzCase{false, groma_RangingMethod_METHOD_DS_FINAL},
                                         FuzzCase{false, groma_RangingMethod_METHOD_DS_FINAL, 2},
                                         FuzzCase{true, groma_RangingMethod_METHOD_DS_NEXT_POLL},
                                         FuzzCase{true, groma_RangingMethod_METHOD_DS_FINAL}));

}  // namespace
}  // namespace groma::sim
