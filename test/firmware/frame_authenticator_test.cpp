// A frame's MIC is valid in one session, superframe and slot, for one sender and one frame type, and nowhere
// else.
#include "firmware/core/mac/frame_authenticator.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <limits>
#include <vector>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/mac/replay_guard.hpp"
#include "firmware/sim/aes.hpp"
#include "test/support/frames.hpp"

namespace groma::mac {
namespace {

constexpr security::Key kKey = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
constexpr security::Key kOtherKey = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 17};
constexpr std::uint64_t kSession = 0x0065'0000'0007'0001;

constexpr std::array kTypes = {FrameType::kBeacon, FrameType::kPoll, FrameType::kResponse,
                               FrameType::kFinal,  FrameType::kJoin, FrameType::kData};

class FailingCipher final : public security::BlockCipher {
 public:
  bool encrypt(const security::Key& key, security::Block& block) noexcept override {
    return good && aes.encrypt(key, block);
  }
  bool good = true;
  sim::Aes aes;
};

// A body of the session's key.
constexpr Body kPlain = Final{};

Join challenge_of_nonce(std::uint64_t nonce) {
  return {.nonce = nonce, .wants_challenge_response = true};
}

// By the session's key; by that of a beacon or of a challenge.
bool fits(FrameAuthenticator& authenticator, std::span<const std::uint8_t> frame, Place place) {
  return authenticator.fits(frame, kPlain, place);
}
bool fits(FrameAuthenticator& authenticator, std::span<const std::uint8_t> frame, const Beacon& beacon,
          const MergeTarget& target = {}) {
  return authenticator.fits(frame, beacon, place_of(beacon), target);
}
bool fits_challenge(FrameAuthenticator& authenticator, std::span<const std::uint8_t> frame, Place place,
                    std::uint64_t nonce) {
  return authenticator.fits(frame, challenge_of_nonce(nonce), place);
}

class FrameAuthenticatorTest : public ::testing::Test {
 protected:
  FrameAuthenticatorTest() { authenticator.enter(kSession); }

  static Frame frame_with(const Body& body) {
    return {
        .sequence = 9, .network = 7, .destination = kBroadcast, .source = 101, .secured = true, .body = body};
  }
  static std::vector<Body> bodies() {
    Beacon beacon{.superframe = 1'000, .session = kSession, .master = 101, .slots = 3, .owners = {1, 2, 3}};
    beacon.challenge_response = ChallengeResponse{5, 6};
    Poll poll{.exchange = 4, .superframe = 1'000, .slot = 2, .count = 3, .anchors = {101, 102, 103}};
    Response response{
        .exchange = 4, .reply = ranging::Ticks(1234567), .closing_valid = true, .closed_exchange = 3};
    return {beacon,
            poll,
            response,
            Final{4},
            Join{.origin = 3, .nonce = 77},
            Data{.origin = 3, .fragments = 1, .size = 9}};
  }
  // Signs it even if its nonce was used.
  std::vector<std::uint8_t> signed_bytes(const Frame& frame, Place at) {
    signed_places = {};
    FrameBytes bytes = serialize(frame);
    sign(authenticator, bytes, kPlain, at);
    return {bytes.bytes().begin(), bytes.bytes().end()};
  }

  FailingCipher cipher;
  SignedPlaces signed_places;
  FrameAuthenticator authenticator{&cipher, kKey, &signed_places};
  const Place place{1'000, 2};
};

TEST_F(FrameAuthenticatorTest, VerifiesItsOwnMicForEachFrameType) {
  for (const Body& body : bodies()) {
    const auto bytes = signed_bytes(frame_with(body), place);
    EXPECT_TRUE(fits(authenticator, bytes, place)) << body.index();
    EXPECT_TRUE(parse(bytes).frame.has_value()) << body.index();
  }
}

TEST_F(FrameAuthenticatorTest, RejectsItsMicAnywhereElse) {
  for (const Body& body : bodies()) {
    const auto bytes = signed_bytes(frame_with(body), place);
    for (const std::uint32_t superframe :
         {0U, 999U, 1'001U, 1'000U + (1U << 8), 1'000U + (1U << 16), 1'000U + (1U << 24)}) {
      EXPECT_FALSE(fits(authenticator, bytes, Place{superframe, place.slot})) << body.index();
    }
    for (const std::uint8_t slot :
         {std::uint8_t{0}, std::uint8_t{1}, std::uint8_t{3}, Place::kBeacon, Place::kShared}) {
      EXPECT_FALSE(fits(authenticator, bytes, Place{place.superframe, slot})) << body.index();
    }
    for (unsigned bit = 0; bit < 64; ++bit) {
      FrameAuthenticator other(&cipher, kKey);
      other.enter(kSession ^ std::uint64_t{1} << bit);
      EXPECT_FALSE(fits(other, bytes, place)) << bit;
    }
    FrameAuthenticator stranger(&cipher, kOtherKey);
    stranger.enter(kSession);
    EXPECT_FALSE(fits(stranger, bytes, place)) << body.index();
    FrameAuthenticator searching(&cipher, kKey);
    EXPECT_FALSE(fits(searching, bytes, place)) << body.index();
  }
}

TEST_F(FrameAuthenticatorTest, DetectsEachFlippedBit) {
  for (const Body& body : bodies()) {
    auto bytes = signed_bytes(frame_with(body), place);
    for (std::size_t bit = 0; bit < 8 * bytes.size(); ++bit) {
      bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
      EXPECT_FALSE(fits(authenticator, bytes, place)) << body.index() << ", bit " << bit;
      bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    }
    for (std::size_t size = 0; size < bytes.size(); ++size) {
      EXPECT_FALSE(fits(authenticator, std::span(bytes).first(size), place)) << body.index() << ", " << size;
    }
  }
}

// A precomputed MIC equals the plain one, for each frame type and whichever type was expected.
TEST_F(FrameAuthenticatorTest, PrecomputationGivesTheSameMic) {
  for (const Body& body : bodies()) {
    const auto plain = signed_bytes(frame_with(body), place);
    for (const FrameType type : kTypes) {
      SignedPlaces places;
      FrameAuthenticator precomputed(&cipher, kKey, &places);
      precomputed.enter(kSession);
      precomputed.expect_sent(101, type, place);
      precomputed.expect_received(101, type, place);
      FrameBytes bytes = serialize(frame_with(body));
      sign(precomputed, bytes, kPlain, place);
      EXPECT_TRUE(std::equal(plain.begin(), plain.end(), bytes.bytes().begin(), bytes.bytes().end()));
      precomputed.begin_verify(plain, place);
      EXPECT_TRUE(fits(precomputed, plain, place));
      EXPECT_TRUE(fits(precomputed, plain, place));
      // Frames of another session are not expected.
      precomputed.enter(kSession + 1);
      precomputed.begin_verify(plain, place);
      EXPECT_FALSE(fits(precomputed, plain, place));
    }
  }
}

TEST_F(FrameAuthenticatorTest, DiscardsPrecomputationsOfThePreviousSession) {
  for (const Body& body : bodies()) {
    const auto plain = signed_bytes(frame_with(body), place);
    for (const FrameType type : kTypes) {
      SignedPlaces places;
      FrameAuthenticator node(&cipher, kKey, &places);
      node.enter(kSession + 1);
      node.expect_sent(101, type, place);
      node.expect_received(101, type, place);
      node.enter(kSession);
      FrameBytes bytes = serialize(frame_with(body));
      sign(node, bytes, kPlain, place);
      EXPECT_TRUE(std::equal(plain.begin(), plain.end(), bytes.bytes().begin(), bytes.bytes().end()));
      EXPECT_TRUE(fits(node, plain, place));
    }
  }
}

TEST_F(FrameAuthenticatorTest, DetectsAForgeryWhoseVerificationBeganEarly) {
  authenticator.expect_received(101, FrameType::kPoll, place);
  const auto good = signed_bytes(frame_with(bodies()[1]), place);
  auto bytes = good;
  for (std::size_t bit = 0; bit < 8 * bytes.size(); ++bit) {
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    authenticator.begin_verify(bytes, place);
    EXPECT_FALSE(fits(authenticator, bytes, place)) << bit;
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
  }
  for (std::size_t size = 0; size < bytes.size(); ++size) {
    authenticator.begin_verify(std::span(bytes).first(size), place);
    EXPECT_FALSE(fits(authenticator, std::span(bytes).first(size), place)) << size;
  }
  authenticator.begin_verify(bytes, place);
  EXPECT_FALSE(fits(authenticator, bytes, Place{place.superframe + 1, place.slot}));
  authenticator.begin_verify(bytes, place);
  EXPECT_TRUE(fits(authenticator, bytes, place));
}

// The previous frame was never verified, and its bytes were at the same address.
TEST_F(FrameAuthenticatorTest, CarriesNoResultOverFromThePreviousFrame) {
  authenticator.expect_received(101, FrameType::kPoll, place);
  const auto good = signed_bytes(frame_with(bodies()[1]), place);
  const auto change = [](std::vector<std::uint8_t>& bytes) { bytes.at(kHeaderBytes) ^= 1; };
  auto bytes = good;
  authenticator.begin_verify(bytes, place);
  change(bytes);
  authenticator.begin_verify(bytes, Place{place.superframe, 5});
  EXPECT_FALSE(fits(authenticator, bytes, place));

  bytes = good;
  authenticator.begin_verify(bytes, place);
  FrameBytes own = serialize(frame_with(bodies()[2]));
  sign(authenticator, own, bodies()[2], place);
  change(bytes);
  EXPECT_FALSE(fits(authenticator, bytes, place));

  bytes = good;
  authenticator.begin_verify(bytes, place);
  authenticator.expect_received(102, FrameType::kPoll, place);
  change(bytes);
  EXPECT_FALSE(fits(authenticator, bytes, place));
}

TEST_F(FrameAuthenticatorTest, VerifiesABeaconByItsOwnSessionAndSuperframe) {
  Beacon beacon = std::get<Beacon>(bodies()[0]);
  const auto own = signed_bytes(frame_with(beacon), place_of(beacon));
  FrameAuthenticator searching(&cipher, kKey);
  EXPECT_TRUE(fits(searching, own, beacon));
  EXPECT_TRUE(fits(authenticator, own, beacon));
  // A relayed beacon goes out in the shared slot.
  beacon.hop = 1;
  beacon.shared = true;
  const auto relayed = signed_bytes(frame_with(beacon), {1'000, Place::kShared});
  EXPECT_TRUE(fits(authenticator, relayed, beacon));
  EXPECT_FALSE(fits(authenticator, signed_bytes(frame_with(beacon), {1'000, Place::kBeacon}), beacon));
  // Another session has another key.
  beacon.session ^= 1;
  EXPECT_FALSE(fits(authenticator, signed_bytes(frame_with(beacon), place_of(beacon)), beacon));
  SignedPlaces places;
  FrameAuthenticator other(&cipher, kKey, &places);
  other.enter(beacon.session);
  FrameBytes bytes = serialize(frame_with(beacon));
  sign(other, bytes, beacon, place_of(beacon));
  EXPECT_TRUE(fits(authenticator, bytes.bytes(), beacon));
}

TEST_F(FrameAuthenticatorTest, AMergeRequestIsValidOnlyForItsTargetSessionAndSuperframe) {
  Beacon beacon = std::get<Beacon>(bodies()[0]);
  beacon.shared = beacon.merge_request = true;
  beacon.place = ranging::Ticks(12'345);
  const MergeTarget target{kSession + 5, 77};
  FrameBytes bytes = serialize(frame_with(beacon));
  sign(authenticator, bytes, beacon, place_of(beacon), target);
  FrameAuthenticator receiver(&cipher, kKey);
  receiver.enter(target.session);
  const auto frame = bytes.bytes();
  EXPECT_TRUE(fits(receiver, frame, beacon, target));
  EXPECT_TRUE(fits(authenticator, frame, beacon, target));
  EXPECT_FALSE(fits(receiver, frame, beacon, {target.session, target.superframe + 1}));
  EXPECT_FALSE(fits(receiver, frame, beacon, {target.session, target.superframe + 256}));
  EXPECT_FALSE(fits(receiver, frame, beacon, {target.session + 1, target.superframe}));
  EXPECT_FALSE(fits(receiver, frame, beacon, {target.session ^ (std::uint64_t{1} << 60), target.superframe}));
  // It does not verify as a beacon of its own session, nor does such a beacon verify as a merge request.
  EXPECT_FALSE(fits(receiver, frame, beacon));
  EXPECT_FALSE(fits(receiver, signed_bytes(frame_with(beacon), place_of(beacon)), beacon, target));
  for (std::size_t i = 0; i < frame.size(); ++i) {
    std::vector<std::uint8_t> changed(frame.begin(), frame.end());
    changed[i] ^= 1;
    EXPECT_FALSE(fits(receiver, changed, beacon, target)) << i;
  }
  // A node with another key cannot make one.
  SignedPlaces places;
  FrameAuthenticator stranger(&cipher, kOtherKey, &places);
  stranger.enter(kSession);
  FrameBytes forged = serialize(frame_with(beacon));
  sign(stranger, forged, beacon, place_of(beacon), target);
  EXPECT_FALSE(fits(receiver, forged.bytes(), beacon, target));
  cipher.good = false;
  EXPECT_FALSE(fits(receiver, frame, beacon, target));
  FrameBytes unsigned_frame = serialize(frame_with(beacon));
  signed_places = {};
  sign(authenticator, unsigned_frame, beacon, place_of(beacon), target);
  cipher.good = true;
  EXPECT_FALSE(fits(receiver, unsigned_frame.bytes(), beacon, target));
}

// Two MICs with one nonce would help to forge a third one.
TEST_F(FrameAuthenticatorTest, RefusesToUseANonceTwice) {
  const auto signs = [&](FrameAuthenticator& signer, const Body& body, Place at) {
    FrameBytes bytes = serialize(frame_with(body));
    sign(signer, bytes, body, at);
    return signer.fits(bytes.bytes(), body, at);
  };
  const auto signed_at = [&](const Body& body, Place at) { return signs(authenticator, body, at); };
  EXPECT_TRUE(signed_at(Final{4}, place));
  EXPECT_FALSE(signed_at(Final{4}, place));
  EXPECT_FALSE(signed_at(Final{5}, place));
  EXPECT_FALSE(signed_at(Final{5}, {place.superframe, 1})) << "an earlier place may have been used";
  EXPECT_FALSE(signed_at(Final{5}, {place.superframe - 1, Place::kShared}));
  EXPECT_TRUE(signed_at(Response{.exchange = 5}, place)) << "another type";
  EXPECT_TRUE(signed_at(Final{5}, {place.superframe, 3}));
  EXPECT_TRUE(signed_at(Final{6}, {place.superframe + 1, 0}));
  FrameAuthenticator restarted(&cipher, kKey, &signed_places);
  restarted.enter(kSession);
  EXPECT_FALSE(signs(restarted, Final{7}, place)) << "as after a radio recovery";
  FrameAuthenticator verifier(&cipher, kKey);
  verifier.enter(kSession);
  EXPECT_FALSE(signs(verifier, Final{7}, {place.superframe + 9, 0})) << "it could not know what was used";
  // Merge requests are beacons with keys of their own.
  Beacon beacon = std::get<Beacon>(bodies()[0]);
  beacon.shared = beacon.merge_request = true;
  const MergeTarget target{kSession + 5, 77};
  for (const bool first : {true, false}) {
    FrameBytes bytes = serialize(frame_with(beacon));
    sign(authenticator, bytes, beacon, place_of(beacon), target);
    EXPECT_EQ(fits(authenticator, bytes.bytes(), beacon, target), first);
  }
  beacon.merge_request = false;
  EXPECT_TRUE(signed_at(beacon, place_of(beacon)));
  authenticator.enter(kSession + 1);
  EXPECT_TRUE(signed_at(Final{7}, place)) << "another session's key";
  EXPECT_FALSE(signed_at(Final{8}, place));
}

// A challenge's key depends on the session and on the challenge's nonce.
TEST_F(FrameAuthenticatorTest, SignsAChallengeWithAKeyOfItsOwn) {
  constexpr std::uint64_t kNonce = 0x0000'0005'0000'0003;
  const Frame frame =
      frame_with(Join{.origin = 101, .nonce = kNonce, .tag = true, .wants_challenge_response = true});
  FrameBytes out = serialize(frame);
  // What was precomputed is of another key.
  authenticator.expect_sent(101, FrameType::kJoin, place);
  sign(authenticator, out, challenge_of_nonce(kNonce), place);
  const auto bytes = out.bytes();

  security::Block session_key = {1, 0, 7, 0, 0, 0, 0x65, 0, 'g', 'r', 'o', 'm', 'a'};
  ASSERT_TRUE(cipher.encrypt(kKey, session_key));
  security::Block key = {3, 0, 0, 0, 5, 0, 0, 0, 'j', 'o', 'i', 'n'};
  ASSERT_TRUE(cipher.encrypt(session_key, key));
  const security::Nonce nonce = {101, 0, 0xE8, 0x03, 0, 0, 2, 0x85};
  const auto code = security::code_of(cipher, key, nonce, bytes.first(bytes.size() - kCodeBytes));
  ASSERT_TRUE(code.has_value());
  EXPECT_TRUE(security::equal(*code, bytes.last(kCodeBytes)));

  FrameAuthenticator receiver(&cipher, kKey);
  EXPECT_FALSE(fits_challenge(receiver, bytes, place, kNonce)) << "it follows no session";
  receiver.enter(kSession);
  receiver.expect_received(101, FrameType::kJoin, place);
  receiver.begin_verify(bytes, place);
  EXPECT_TRUE(fits_challenge(receiver, bytes, place, kNonce));
  EXPECT_TRUE(fits_challenge(authenticator, bytes, place, kNonce));
  EXPECT_FALSE(fits(receiver, bytes, place)) << "the session's key";
  EXPECT_FALSE(fits_challenge(receiver, signed_bytes(frame, place), place, kNonce));
  EXPECT_FALSE(fits_challenge(receiver, bytes, {place.superframe + 1, place.slot}, kNonce));
  EXPECT_FALSE(fits_challenge(receiver, bytes, {place.superframe, 3}, kNonce));
  for (unsigned bit = 0; bit < 64; ++bit)
    EXPECT_FALSE(fits_challenge(receiver, bytes, place, kNonce ^ std::uint64_t{1} << bit)) << bit;
  for (std::size_t i = 0; i < bytes.size(); ++i) {
    std::vector<std::uint8_t> changed(bytes.begin(), bytes.end());
    changed[i] ^= 1;
    EXPECT_FALSE(fits_challenge(receiver, changed, place, kNonce)) << i;
  }
  receiver.enter(kSession + 1);
  EXPECT_FALSE(fits_challenge(receiver, bytes, place, kNonce));
  receiver.enter(kSession);
  cipher.good = false;
  EXPECT_FALSE(fits_challenge(receiver, bytes, place, kNonce));
  FrameBytes unsigned_frame = serialize(frame);
  signed_places = {};
  sign(authenticator, unsigned_frame, challenge_of_nonce(kNonce), place);
  cipher.good = true;
  EXPECT_FALSE(fits_challenge(receiver, unsigned_frame.bytes(), place, kNonce));
}

TEST_F(FrameAuthenticatorTest, SignsAChallengeOnceInAPlace) {
  const auto signs = [&](FrameAuthenticator& signer, std::uint64_t nonce, std::uint32_t superframe) {
    const Place at{superframe, Place::kShared};
    FrameBytes bytes = serialize(frame_with(Join{.nonce = nonce, .wants_challenge_response = true}));
    sign(signer, bytes, challenge_of_nonce(nonce), at);
    return fits_challenge(signer, bytes.bytes(), at, nonce);
  };
  EXPECT_TRUE(signs(authenticator, 7, 10));
  EXPECT_FALSE(signs(authenticator, 7, 10));
  EXPECT_FALSE(signs(authenticator, 7, 9)) << "an earlier place may have been used";
  EXPECT_TRUE(signs(authenticator, 7, 12));
  EXPECT_TRUE(signs(authenticator, 8, 3)) << "another challenge";
  EXPECT_FALSE(signs(authenticator, 8, 3));
  EXPECT_TRUE(signs(authenticator, 8, 4));
  EXPECT_FALSE(signs(authenticator, 7, 20)) << "a former challenge";
  FrameAuthenticator restarted(&cipher, kKey, &signed_places);
  restarted.enter(kSession);
  EXPECT_FALSE(signs(restarted, 8, 4)) << "as after a radio recovery";
  FrameAuthenticator verifier(&cipher, kKey);
  verifier.enter(kSession);
  EXPECT_FALSE(signs(verifier, 9, 30)) << "it could not know what was used";
}

// Before it excludes a replay, a node signs nothing but challenges in another session.
TEST_F(FrameAuthenticatorTest, ChallengesInAnotherSessionKeepTheRecordOfThisOne) {
  EXPECT_TRUE(signed_places.take(kSession, 5, {1'000, Place::kShared}));
  EXPECT_TRUE(signed_places.take_challenge(7, {20, Place::kShared}));
  EXPECT_TRUE(signed_places.take_challenge(8, {21, Place::kShared}));
  EXPECT_FALSE(signed_places.take(kSession, 5, {1'000, Place::kShared}));
  EXPECT_FALSE(signed_places.take(kSession, 5, {30, Place::kShared}));
  EXPECT_TRUE(signed_places.take(kSession, 5, {1'001, Place::kShared}));
}

TEST_F(FrameAuthenticatorTest, VerifiesNothingIfTheCipherFails) {
  const auto bytes = signed_bytes(frame_with(Final{4}), place);
  cipher.good = false;
  EXPECT_FALSE(fits(authenticator, bytes, place));
  const auto unsigned_frame = signed_bytes(frame_with(Final{4}), place);
  authenticator.enter(kSession + 1);
  cipher.good = true;
  // That session then has no key, not one of zeros.
  EXPECT_EQ(signed_bytes(frame_with(Final{4}), place), unsigned_frame);
  EXPECT_FALSE(fits(authenticator, bytes, place));
  EXPECT_FALSE(fits(authenticator, unsigned_frame, place));
  authenticator.enter(kSession);
  EXPECT_FALSE(fits(authenticator, unsigned_frame, place));
  EXPECT_TRUE(fits(authenticator, bytes, place));

  // Nor with a precomputed MIC.
  cipher.good = false;
  authenticator.expect_received(101, FrameType::kFinal, place);
  authenticator.begin_verify(bytes, place);
  EXPECT_FALSE(fits(authenticator, bytes, place));
  cipher.good = true;
  authenticator.expect_received(101, FrameType::kFinal, place);
  cipher.good = false;
  authenticator.begin_verify(bytes, place);
  cipher.good = true;
  EXPECT_FALSE(fits(authenticator, bytes, place));
  EXPECT_TRUE(fits(authenticator, bytes, place));
}

TEST(FrameAuthenticator, OfAnOpenNetworkDoesNothing) {
  sim::Aes aes;
  FrameAuthenticator open;
  FrameAuthenticator keyless(&aes, {});
  open.enter(kSession);
  keyless.enter(kSession);
  EXPECT_FALSE(open.on());
  EXPECT_FALSE(keyless.on());
  const FrameBytes bytes = serialize({.secured = true, .body = Final{4}});
  EXPECT_FALSE(fits(open, bytes.bytes(), Place{}));
  EXPECT_FALSE(fits(keyless, bytes.bytes(), Beacon{}));
}

// ---- challenge and response against replay ------------------------------------------------------------

class ReplayGuardTest : public ::testing::Test {
 protected:
  // Of four turns node 7 has the third.
  static groma_Schedule schedule_of_four() {
    groma_Schedule four = groma_Schedule_init_zero;
    for (const std::uint16_t id : std::vector<std::uint16_t>{1'001, 1'002, 7})
      four.anchor_ids[four.anchor_ids_count++] = id;
    four.tag_ids[four.tag_ids_count++] = 1;
    four.backup_ids[four.backup_ids_count++] = 1'002;
    return four;
  }
  Site site_of(std::uint16_t id, std::uint32_t* counter) {
    return {.id = id,
            .phy = dw1000::phy_of(radio::Preamble::k128),
            .schedule = &schedule,
            .boot_count = 5,
            .network_key = kKey,
            .nonces = counter};
  }
  static Frame frame_of(const Body& body) { return {.source = 101, .secured = true, .body = body}; }
  static void hear(ReplayGuard& node, std::optional<ChallengeResponse> challenge_response) {
    Beacon beacon;
    beacon.challenge_response = challenge_response;
    node.on_beacon(frame_of(beacon), beacon);
  }
  static Join challenge(ReplayGuard& node, std::uint32_t number) {
    const auto outgoing = node.open_slot(number);
    EXPECT_TRUE(outgoing.has_value());
    node.on_sent(number, true);
    return outgoing ? std::get<Join>(outgoing->body) : Join{};
  }

  const groma_Schedule schedule = schedule_of_four();
  std::uint32_t nonces = 0;
  const Site site = site_of(7, &nonces);
  ReplayGuard node{site};
};

TEST_F(ReplayGuardTest, AcceptsABeaconThatReturnsItsNonce) {
  EXPECT_FALSE(node.fresh());
  hear(node, std::nullopt);
  hear(node, ChallengeResponse{7, 0});
  EXPECT_FALSE(node.fresh());
  const Join join = challenge(node, 0);
  EXPECT_EQ(join.origin, 7);
  EXPECT_TRUE(join.wants_challenge_response);
  hear(node, std::nullopt);
  hear(node, ChallengeResponse{8, join.nonce});
  hear(node, ChallengeResponse{7, join.nonce + 1});
  EXPECT_FALSE(node.fresh());
  hear(node, ChallengeResponse{7, join.nonce});
  EXPECT_TRUE(node.fresh());
  // Only until it searches again.
  ReplayGuard lost = node;
  lost.forget();
  EXPECT_FALSE(lost.fresh());
  // It sends no further challenge.
  for (std::uint32_t number = 1; number < 20; ++number) EXPECT_FALSE(node.open_slot(number).has_value());
}

TEST_F(ReplayGuardTest, NeverRepeatsANonce) {
  const Join first = challenge(node, 0);
  node.forget();
  EXPECT_FALSE(node.fresh());
  const Join second = challenge(node, 0);
  EXPECT_NE(first.nonce, second.nonce);
  hear(node, ChallengeResponse{7, first.nonce});
  EXPECT_FALSE(node.fresh());
  // A second station in the same boot.
  ReplayGuard again(site);
  const Join third = challenge(again, 0);
  EXPECT_NE(third.nonce, first.nonce);
  EXPECT_NE(third.nonce, second.nonce);
  // After a reboot the count of nonces restarts.
  std::uint32_t none = 0;
  Site later = site_of(7, &none);
  later.boot_count = 6;
  ReplayGuard rebooted(later);
  EXPECT_NE(challenge(rebooted, 0).nonce, first.nonce);
  // Without a boot count it sends no challenge and so accepts no beacon.
  later.boot_count = 0;
  ReplayGuard uncounted(later);
  for (std::uint32_t number = 0; number < 20; ++number) EXPECT_FALSE(uncounted.open_slot(number).has_value());
}

TEST_F(ReplayGuardTest, SendsNoChallengeWhenItsNoncesAreUsedUp) {
  nonces = std::numeric_limits<std::uint32_t>::max() - 1;
  const Join last = challenge(node, 0);
  EXPECT_EQ(last.nonce, 5ULL << 32 | 0xFFFF'FFFEU);
  node.forget();
  for (std::uint32_t number = 0; number < 20; ++number) EXPECT_FALSE(node.open_slot(number).has_value());
}

TEST_F(ReplayGuardTest, SendsAChallengeAtOnceAndThenInTurn) {
  (void)challenge(node, 12);
  std::vector<std::uint32_t> turns;
  for (std::uint32_t number = 14; number < 46; number += 2) {
    if (!node.open_slot(number)) continue;
    node.on_sent(number, true);
    turns.push_back(number);
  }
  // Every second superframe has an open slot. One of four of these is this node's, one place earlier each
  // round.
  EXPECT_EQ(turns, (std::vector<std::uint32_t>{16, 30, 36, 42}));
}

TEST_F(ReplayGuardTest, GivesUpOnANetworkThatNeverAnswers) {
  std::uint32_t number = 0;
  while (!node.hopeless() && number < 1'000) {
    if (node.open_slot(number)) node.on_sent(number, true);
    number += 2;
  }
  EXPECT_LT(number, 100U);
  node.forget();
  EXPECT_FALSE(node.hopeless());
}

TEST_F(ReplayGuardTest, AnswersTheLastChallengeOnceIfItIsVerifiedItself) {
  std::uint32_t others = 0;
  const Site other = site_of(101, &others);
  ReplayGuard master(other);
  const Join join{.origin = 7, .nonce = 99, .wants_challenge_response = true};
  Beacon beacon;
  master.on_control(frame_of(join), 0, true);
  master.on_beacon_out(beacon, true);
  EXPECT_FALSE(beacon.challenge_response.has_value());

  master.found();
  master.on_control(frame_of(Join{.origin = 8, .nonce = 98, .wants_slot = true}), 0, true);
  master.on_beacon_out(beacon, true);
  EXPECT_FALSE(beacon.challenge_response.has_value());
  master.on_control(frame_of(Join{.origin = 8, .nonce = 98, .wants_challenge_response = true}), 0, true);
  master.on_control(frame_of(join), 0, true);
  master.on_beacon_out(beacon, true);
  ASSERT_TRUE(beacon.challenge_response.has_value());
  EXPECT_EQ(beacon.challenge_response->id, 7);
  EXPECT_EQ(beacon.challenge_response->nonce, 99U);
  beacon.challenge_response.reset();
  master.on_beacon_out(beacon, true);
  EXPECT_FALSE(beacon.challenge_response.has_value());
}

TEST_F(ReplayGuardTest, NeedsNoChallengeInAnOpenNetwork) {
  Site open = site;
  open.network_key = {};
  ReplayGuard free(open);
  EXPECT_TRUE(free.fresh());
  free.forget();
  EXPECT_TRUE(free.fresh());
  EXPECT_FALSE(free.open_slot(0).has_value());
}

}  // namespace
}  // namespace groma::mac
