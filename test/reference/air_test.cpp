// docs/reference/air.md against the code: the offset of each field, sizes, constants, formulas and examples.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <span>
#include <string>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/mac/coexistence.hpp"
#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/frame_authenticator.hpp"
#include "firmware/core/mac/master_election.hpp"
#include "firmware/core/mac/replay_guard.hpp"
#include "firmware/core/mac/slot_map.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/air_link.hpp"
#include "firmware/core/ranging/twr.hpp"
#include "firmware/core/security/ccm.hpp"
#include "firmware/sim/aes.hpp"
#include "firmware/sim/frame_check.hpp"
#include "test/reference/formulas.hpp"
#include "test/reference/page.hpp"
#include "test/support/frames.hpp"

namespace groma::mac {
namespace {

using dw1000::Preamble;
using ranging::Ticks;
using reference::Bytes;
using reference::Formulas;
using reference::little_endian;
using reference::number;
using reference::Page;
using reference::Table;
using ::testing::UnorderedElementsAreArray;

const Page& page() {
  static const Page page("air.md");
  return page;
}

Bytes bytes_of(const Frame& frame) {
  const FrameBytes out = serialize(frame);
  return {out.bytes().begin(), out.bytes().end()};
}

std::size_t evaluated(const std::string& cell, std::size_t n) {
  Formulas formulas;
  formulas.set("n", static_cast<double>(n));
  return static_cast<std::size_t>(formulas.value(cell));
}

// ---- frames

constexpr std::size_t kSome = 3;  // slots, anchors or bytes of payload

template <class T>
T& body_of(Frame& frame) {
  return std::get<T>(frame.body);
}

Ticks ticks(const Bytes& bytes) {
  return Ticks(static_cast<std::int64_t>(little_endian(bytes)));
}

// Sets a field so that it is sent as these bytes.
using Setter = std::function<void(Frame&, const Bytes&)>;

template <class T, class Member>
Setter to(Member T::*member) {
  return [=](Frame& frame, const Bytes& bytes) {
    if constexpr (std::is_same_v<Member, Ticks>) {
      body_of<T>(frame).*member = ticks(bytes);
    } else {
      body_of<T>(frame).*member = static_cast<Member>(little_endian(bytes));
    }
  };
}

template <class T, std::size_t N>
Setter to_ids(std::array<std::uint16_t, N> T::*member) {
  return [=](Frame& frame, const Bytes& bytes) {
    for (std::size_t i = 0; i < bytes.size() / 2; ++i)
      (body_of<T>(frame).*member)[i] = static_cast<std::uint16_t>(bytes[2 * i] | bytes[2 * i + 1] << 8);
  };
}

template <class T>
Setter flag(bool T::*member) {
  return [=](Frame& frame, const Bytes&) { body_of<T>(frame).*member = true; };
}

struct Layout {
  FrameType type{};
  Frame frame{};  // all numbers 0, kSome elements
  std::map<std::string, Setter> fields{};
  std::map<std::string, Setter> flags{};
  // Fields that give the number of elements.
  std::string count{};
};

Frame with(const Body& body) {
  Frame frame;
  frame.body = body;
  return frame;
}

std::map<std::string, Layout> layouts() {
  Beacon beacon{.slots = kSome};
  beacon.challenge_response = ChallengeResponse{};
  std::map<std::string, Layout> all;
  all["BEACON"] = {.type = FrameType::kBeacon,
                   .frame = with(beacon),
                   .fields = {{"superframe", to(&Beacon::superframe)},
                              {"session", to(&Beacon::session)},
                              {"epoch", to(&Beacon::epoch)},
                              {"schedule_hash", to(&Beacon::schedule_hash)},
                              {"master", to(&Beacon::master)},
                              {"hop", to(&Beacon::hop)},
                              {"age", to(&Beacon::age)},
                              {"tx_offset_dtu", to(&Beacon::tx_offset_dtu)},
                              {"owners", to_ids(&Beacon::owners)},
                              {"challenge_response.id",
                               [](Frame& frame, const Bytes& bytes) {
                                 body_of<Beacon>(frame).challenge_response->id =
                                     static_cast<std::uint16_t>(little_endian(bytes));
                               }},
                              {"challenge_response.nonce",
                               [](Frame& frame, const Bytes& bytes) {
                                 body_of<Beacon>(frame).challenge_response->nonce = little_endian(bytes);
                               }},
                              {"place", to(&Beacon::place)}},
                   .flags = {{"dissolving", flag(&Beacon::dissolving)},
                             {"challenge_response",
                              [](Frame& frame, const Bytes&) {
                                body_of<Beacon>(frame).challenge_response = ChallengeResponse{};
                              }},
                             {"shared", flag(&Beacon::shared)},
                             {"merge_request", flag(&Beacon::merge_request)},
                             {"quiet", flag(&Beacon::quiet)}},
                   .count = "slots"};
  all["POLL"] = {.type = FrameType::kPoll,
                 .frame = with(Poll{.count = kSome}),
                 .fields = {{"exchange", to(&Poll::exchange)},
                            {"superframe", to(&Poll::superframe)},
                            {"slot", to(&Poll::slot)},
                            {"anchors", to_ids(&Poll::anchors)}},
                 .count = "count"};
  all["RESPONSE"] = {.type = FrameType::kResponse,
                     .frame = with(Response{.health = {.temperature_c = 0}}),
                     .fields = {{"exchange", to(&Response::exchange)},
                                {"reply", to(&Response::reply)},
                                {"closed_exchange", to(&Response::closed_exchange)},
                                {"closing", to(&Response::closing)},
                                {"temperature_c",
                                 [](Frame& frame, const Bytes& bytes) {
                                   body_of<Response>(frame).health.temperature_c =
                                       static_cast<std::int8_t>(bytes[0]);
                                 }},
                                {"supply_64ths_v",
                                 [](Frame& frame, const Bytes& bytes) {
                                   body_of<Response>(frame).health.supply_64ths_v = bytes[0];
                                 }}},
                     .flags = {{"closing_valid", flag(&Response::closing_valid)}}};
  all["FINAL"] = {
      .type = FrameType::kFinal, .frame = with(Final{}), .fields = {{"exchange", to(&Final::exchange)}}};
  all["JOIN"] = {.type = FrameType::kJoin,
                 .frame = with(Join{}),
                 .fields = {{"origin", to(&Join::origin)}, {"nonce", to(&Join::nonce)}},
                 .flags = {{"tag", flag(&Join::tag)},
                           {"wants_slot", flag(&Join::wants_slot)},
                           {"wants_challenge_response", flag(&Join::wants_challenge_response)},
                           {"leaving", flag(&Join::leaving)}}};
  all["DATA"] = {
      .type = FrameType::kData,
      .frame = with(Data{.size = kSome}),
      .fields = {{"origin", to(&Data::origin)},
                 {"target", to(&Data::target)},
                 {"message", to(&Data::message)},
                 {"fragment", to(&Data::fragment)},
                 {"fragments", to(&Data::fragments)},
                 {"payload",
                  [](Frame& frame, const Bytes& bytes) {
                    std::copy(bytes.begin(), bytes.end(), body_of<Data>(frame).payload.begin());
                  }}},
      .flags = {{"acknowledgement", flag(&Data::acknowledgement)},
                {"to_host", flag(&Data::to_host)},
                {"asks", flag(&Data::asks)},
                {"hops_left", [](Frame& frame, const Bytes&) { body_of<Data>(frame).hops_left = 3; }},
                {"round", [](Frame& frame, const Bytes&) { body_of<Data>(frame).round = 7; }}}};
  return all;
}

Table fields_of(const std::string& heading) {
  return page().table("offset", "values", heading);
}

// A field with its own bytes, all different, changes those bytes of the frame and no others.
void expect_field(const Frame& base, const std::vector<std::string>& row, const Setter& set) {
  const std::size_t offset = evaluated(row[0], kSome);
  const std::size_t size = evaluated(row[1], kSome);
  Bytes value(size);
  for (std::size_t i = 0; i < size; ++i) value[i] = static_cast<std::uint8_t>(0x21 + i);
  Frame changed = base;
  set(changed, value);
  Bytes expected = bytes_of(base);
  ASSERT_LE(offset + size, expected.size()) << row[2];
  std::copy(value.begin(), value.end(), expected.begin() + static_cast<std::ptrdiff_t>(offset));
  EXPECT_EQ(bytes_of(changed), expected) << row[2];
}

TEST(AirReference, EachHeaderFieldIsAtItsOffset) {
  const std::map<std::string, Setter> setters = {
      {"sequence", [](Frame& frame, const Bytes& b) { frame.sequence = b[0]; }},
      {"network",
       [](Frame& frame, const Bytes& b) { frame.network = static_cast<std::uint16_t>(little_endian(b)); }},
      {"destination",
       [](Frame& frame, const Bytes& b) {
         frame.destination = static_cast<std::uint16_t>(little_endian(b));
       }},
      {"source",
       [](Frame& frame, const Bytes& b) { frame.source = static_cast<std::uint16_t>(little_endian(b)); }}};
  std::size_t end = 0;
  std::set<std::string> seen;
  for (const auto& row : fields_of("Header").rows) {
    EXPECT_EQ(evaluated(row[0], 0), end) << row[2];
    end += evaluated(row[1], 0);
    seen.insert(row[2]);
    const Frame base = with(Final{});
    if (const auto found = setters.find(row[2]); found != setters.end()) {
      expect_field(base, row, found->second);
    } else if (row[2] == "frame control") {
      const Bytes bytes = bytes_of(base);
      EXPECT_EQ(bytes[0] | bytes[1] << 8, number(row[4]));
    } else {
      EXPECT_EQ(row[2], "type");
      EXPECT_EQ(bytes_of(base)[evaluated(row[0], 0)], static_cast<std::uint8_t>(FrameType::kFinal));
    }
  }
  EXPECT_EQ(seen.size(), setters.size() + 2);
  EXPECT_EQ(end, kHeaderBytes);
}

TEST(AirReference, EachFieldOfABodyIsAtItsOffset) {
  for (const auto& [name, layout] : layouts()) {
    SCOPED_TRACE(name);
    std::vector<std::string> named;
    std::size_t end = kHeaderBytes;
    for (const auto& row : fields_of(name).rows) {
      const std::size_t offset = evaluated(row[0], kSome);
      const std::size_t size = evaluated(row[1], kSome);
      Frame base = layout.frame;
      if (row[2] == "place") {
        body_of<Beacon>(base).challenge_response.reset();
        body_of<Beacon>(base).merge_request = true;
        EXPECT_EQ(offset + size, bytes_of(base).size());
      } else {
        EXPECT_EQ(offset, end) << row[2];
        end += size;
      }
      if (row[2] == "flags") continue;
      if (row[2] == layout.count) {
        EXPECT_EQ(bytes_of(base)[offset], kSome);
        continue;
      }
      named.push_back(row[2]);
      const auto found = layout.fields.find(row[2]);
      ASSERT_NE(found, layout.fields.end()) << row[2];
      expect_field(base, row, found->second);
    }
    EXPECT_EQ(end, bytes_of(layout.frame).size());
    std::vector<std::string> all;
    for (const auto& [field, setter] : layout.fields) all.push_back(field);
    EXPECT_THAT(named, UnorderedElementsAreArray(all));
  }
}

TEST(AirReference, EachFlagIsAtItsBitAndNoOtherIsAccepted) {
  for (const auto& [name, layout] : layouts()) {
    if (layout.flags.empty()) continue;
    SCOPED_TRACE(name);
    const auto rows = fields_of(name).rows;
    const auto row_of_flags =
        std::find_if(rows.begin(), rows.end(), [](const auto& row) { return row[2] == "flags"; });
    ASSERT_NE(row_of_flags, rows.end());
    const std::size_t offset = evaluated((*row_of_flags)[0], kSome);
    Frame base = layout.frame;
    if (name == "BEACON") body_of<Beacon>(base).challenge_response.reset();
    if (name == "DATA") body_of<Data>(base).fragments = 1;
    unsigned covered = 0;
    std::size_t named = 0;
    for (const auto& row : page().table("bit of flags", "set if", name).rows) {
      unsigned mask = 0;
      const auto to_at = row[0].find(" to ");
      const auto first = static_cast<unsigned>(number(row[0]));
      const auto last =
          to_at == std::string::npos ? first : static_cast<unsigned>(number(row[0].substr(to_at + 4)));
      for (unsigned bit = first; bit <= last; ++bit) mask |= 1U << bit;
      EXPECT_EQ(covered & mask, 0U);
      covered |= mask;
      if (row[1].empty()) {
        for (unsigned bit = first; bit <= last; ++bit) {
          Bytes bytes = bytes_of(base);
          bytes[offset] = static_cast<std::uint8_t>(bytes[offset] | 1U << bit);
          EXPECT_EQ(parse(bytes).error, ParseError::kMalformed) << bit;
          EXPECT_FALSE(parse(bytes).frame.has_value()) << bit;
        }
        continue;
      }
      ++named;
      const auto found = layout.flags.find(row[1]);
      ASSERT_NE(found, layout.flags.end()) << row[1];
      Frame changed = base;
      found->second(changed, {});
      EXPECT_EQ(bytes_of(changed)[offset] ^ bytes_of(base)[offset], static_cast<int>(mask)) << row[1];
      EXPECT_TRUE(parse(bytes_of(changed)).frame.has_value()) << row[1];
    }
    EXPECT_EQ(covered, 0xFFU);
    EXPECT_EQ(named, layout.flags.size());
  }
}

TEST(AirReference, ALentSlotIsMarkedByItsTopBit) {
  Frame frame = with(Poll{.count = 1});
  const Bytes owned = bytes_of(frame);
  body_of<Poll>(frame).lent = true;
  const Bytes lent = bytes_of(frame);
  for (const auto& row : fields_of("POLL").rows) {
    if (row[2] == "slot") EXPECT_EQ(lent[evaluated(row[0], 1)] ^ owned[evaluated(row[0], 1)], 0x80);
  }
}

TEST(AirReference, FramesHaveTheirTypesAndSizes) {
  const auto all = layouts();
  std::set<std::string> seen;
  for (const auto& row : page().table("frame", "bytes, with MIC").rows) {
    SCOPED_TRACE(row[0]);
    seen.insert(row[0]);
    for (const std::size_t n : {std::size_t{0}, std::size_t{1}, std::size_t{16}}) {
      Frame frame = all.at(row[0]).frame;
      if (auto* beacon = std::get_if<Beacon>(&frame.body)) {
        beacon->slots = static_cast<std::uint8_t>(n);
        beacon->challenge_response.reset();
      }
      if (auto* poll = std::get_if<Poll>(&frame.body)) poll->count = static_cast<std::uint8_t>(n);
      if (auto* data = std::get_if<Data>(&frame.body)) data->size = static_cast<std::uint8_t>(n);
      EXPECT_EQ(bytes_of(frame)[kHeaderBytes - 1], number(row[1]));
      EXPECT_EQ(bytes_of(frame).size() + dw1000::kFrameCheckBytes, evaluated(row[4], n));
      frame.secured = true;
      EXPECT_EQ(bytes_of(frame)[kHeaderBytes - 1], static_cast<unsigned>(number(row[1])) | kSecuredFlag);
      EXPECT_EQ(bytes_of(frame).size() + dw1000::kFrameCheckBytes, evaluated(row[5], n));
    }
  }
  EXPECT_EQ(seen.size(), all.size());
  // The next type is unknown.
  Bytes bytes = bytes_of(with(Final{}));
  bytes[kHeaderBytes - 1] = static_cast<std::uint8_t>(all.size() + 1);
  EXPECT_EQ(parse(bytes).error, ParseError::kMalformed);
}

// ---- schedules

// The schedule of the page's example.
groma_Schedule example_schedule() {
  groma_Schedule schedule = groma_Schedule_init_zero;
  schedule.epoch = 1;
  schedule.master_id = 101;
  for (const int id : {1, 2}) schedule.tag_ids[schedule.tag_ids_count++] = static_cast<std::uint16_t>(id);
  for (const int id : {101, 102, 103})
    schedule.anchor_ids[schedule.anchor_ids_count++] = static_cast<std::uint16_t>(id);
  schedule.method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  schedule.turn_round_us = 350;
  schedule.response_gap_us = 300;
  schedule.guard_us = 30;
  schedule.backup_ids[schedule.backup_ids_count++] = 102;
  return schedule;
}

groma_Schedule schedule_with(std::size_t tags, std::size_t anchors, groma_RangingMethod method,
                             std::uint32_t turnaround_us, std::uint32_t gap_us, std::uint32_t guard_us) {
  groma_Schedule schedule = groma_Schedule_init_zero;
  schedule.epoch = 1;
  schedule.master_id = 101;
  schedule.tag_ids_count = static_cast<pb_size_t>(tags);
  for (std::size_t i = 0; i < tags; ++i) schedule.tag_ids[i] = static_cast<std::uint16_t>(1 + i);
  schedule.anchor_ids_count = static_cast<pb_size_t>(anchors);
  for (std::size_t i = 0; i < anchors; ++i) schedule.anchor_ids[i] = static_cast<std::uint16_t>(101 + i);
  schedule.method = method;
  schedule.turn_round_us = turnaround_us;
  schedule.response_gap_us = gap_us;
  schedule.guard_us = guard_us;
  return schedule;
}

Formulas formulas_for(const groma_Schedule& schedule, Preamble preamble, bool secured) {
  EXPECT_TRUE(page().contains("has (638976 u + 5) / 10 ticks, rounded"));
  const auto ticks_of = [](std::uint32_t us) { return std::floor((638'976.0 * us + 5.0) / 10.0); };
  Formulas formulas;
  formulas.define(page().indented("Ticks and durations"));
  formulas.define(page().indented("The superframe"));
  formulas.set("p", dw1000::preamble_symbols(preamble));
  formulas.set("g", ticks_of(schedule.guard_us));
  formulas.set("t", ticks_of(schedule.turn_round_us));
  formulas.set("a", ticks_of(schedule.response_gap_us));
  formulas.set("s", static_cast<double>(schedule.slots == 0 ? schedule.tag_ids_count : schedule.slots));
  formulas.set("m", static_cast<double>(schedule.responses != 0
                                            ? schedule.responses
                                            : std::min<std::size_t>(schedule.anchor_ids_count, 16)));
  const Table symbols = page().table("symbol", "", "The superframe");
  double c = 0.0;
  for (const auto& row : symbols.rows) {
    if (row[0] == "c") c = number(row[1]);
  }
  formulas.set("c", c);
  formulas.set("e", secured ? 3.0 * c : 0.0);
  formulas.set("k", secured ? 8.0 : 0.0);
  return formulas;
}

double count(Ticks t) {
  return static_cast<double>(t.count());
}

TEST(AirReference, TheFormulasGiveEachInstantOfASuperframe) {
  for (const auto method : {groma_RangingMethod_METHOD_DS_NEXT_POLL, groma_RangingMethod_METHOD_DS_FINAL}) {
    for (const Preamble preamble : {Preamble::k64, Preamble::k128, Preamble::k256}) {
      for (const bool secured : {false, true}) {
        for (const std::size_t size : {1U, 3U, 16U}) {
          for (const std::uint32_t gap_us : {35U, 301U, 2000U}) {
            groma_Schedule schedule = schedule_with(size, 4 * size, method, 353, gap_us, 31);
            schedule.slots = static_cast<std::uint32_t>(size == 3 ? 5 : 0);
            schedule.responses = size == 3 ? 7 : 0;
            ASSERT_STREQ(fault_of(schedule), "");
            const Superframe superframe(schedule, dw1000::phy_of(preamble), secured);
            const Formulas page_says = formulas_for(schedule, preamble, secured);
            const std::string end = superframe.has_final() ? "_final" : "";
            EXPECT_EQ(page_says.value("size"), superframe.control_bytes());
            EXPECT_EQ(page_says.value("beacon"), count(superframe.beacon()));
            EXPECT_EQ(page_says.value("shared"), count(superframe.shared()));
            EXPECT_EQ(page_says.value("tag_slot" + end), count(superframe.tag_slot()));
            EXPECT_EQ(page_says.value("duration" + end), count(superframe.duration()));
            EXPECT_EQ(page_says.value("poll" + end + "(0)"), count(superframe.poll(0)));
            EXPECT_EQ(page_says.value("poll" + end + "(4)"), count(superframe.poll(4)));
            const std::size_t anchors = superframe.responses();
            for (const std::size_t n : {std::size_t{1}, anchors}) {
              const std::string all = std::to_string(n);
              const std::string last = std::to_string(n - 1);
              EXPECT_EQ(page_says.value("response(0, " + all + ")"), count(superframe.response(0, n)));
              EXPECT_EQ(
                  page_says.value(std::string("response(").append(last).append(", ").append(all).append(")")),
                  count(superframe.response(n - 1, n)));
              EXPECT_EQ(page_says.value("final(" + all + ")"), count(superframe.final(n)));
            }
          }
        }
      }
    }
  }
}

TEST(AirReference, TheDefaultSchedulesNumbersAreThoseOfTheFormulas) {
  const Table table = page().table("quantity", "arm_ahead, key");
  EXPECT_EQ(table.rows.size(), 10U);
  for (std::size_t column = 1; column < table.columns.size(); ++column) {
    const bool secured = table.columns[column].find("key") != std::string::npos;
    const bool arm_ahead = table.columns[column].find("arm_ahead") != std::string::npos;
    const groma_Schedule schedule =
        schedule_with(3, 12, groma_RangingMethod_METHOD_DS_NEXT_POLL, kUsualTurnaround_us,
                      usual_gap_us(arm_ahead, secured), kUsualGuard_us);
    const Formulas formulas = formulas_for(schedule, Preamble::k128, secured);
    for (const auto& row : table.rows) {
      EXPECT_EQ(number(row[column]), formulas.value(row[0])) << row[0] << ", " << table.columns[column];
    }
  }
}

TEST(AirReference, FormulasOfAirTimeHoldForEachFrame) {
  for (const Preamble preamble : {Preamble::k64, Preamble::k128, Preamble::k256}) {
    const Formulas formulas = formulas_for(example_schedule(), preamble, false);
    EXPECT_EQ(formulas.value("before(p)"), count(dw1000::phy_of(preamble).before_rmarker()));
    for (std::size_t n = 0; n <= dw1000::kMaxFrameBytes; ++n)
      ASSERT_EQ(formulas.value("after(" + std::to_string(n) + ")"),
                count(dw1000::phy_of(preamble).after_rmarker(n)))
          << n;
  }
}

// FNV-1a over the page's example words, by its definition there.
TEST(AirReference, TheScheduleHashIsThatOfTheWords) {
  EXPECT_TRUE(page().contains("initial value 2166136261; for each byte, h = ((h xor byte) · 16777619)"));
  std::uint32_t hash = 2'166'136'261U;
  for (const auto& row : page().table("words", "example").rows) {
    std::string left = row[2];
    while (!left.empty()) {
      const auto word = static_cast<std::uint32_t>(number(left));
      for (unsigned shift = 0; shift < 32; shift += 8) hash = (hash ^ (word >> shift & 0xFFU)) * 16'777'619U;
      const auto comma = left.find(',');
      left = comma == std::string::npos ? "" : left.substr(comma + 1);
    }
  }
  EXPECT_EQ(hash, schedule_hash(example_schedule(), 7, Preamble::k128));
}

TEST(AirReference, PreamblesHaveTheirNumbers) {
  const std::map<int, std::pair<Preamble, groma_Preamble>> preambles = {
      {64, {Preamble::k64, groma_Preamble_PREAMBLE_64}},
      {128, {Preamble::k128, groma_Preamble_PREAMBLE_128}},
      {256, {Preamble::k256, groma_Preamble_PREAMBLE_256}}};
  const Table table = page().table("preamble, symbols", "number in the [schedule hash](#schedule-hash)");
  ASSERT_EQ(table.rows.size(), preambles.size());
  for (const auto& row : table.rows) {
    const auto& [preamble, configured] = preambles.at(static_cast<int>(number(row[0])));
    EXPECT_EQ(number(row[1]), static_cast<int>(configured));
    EXPECT_EQ(number(row[2]), dw1000::acquisition_chunk_symbols(preamble));
    EXPECT_EQ(number(row[3]), static_cast<int>(preamble));
  }
}

// ---- registers

void expect_register(const std::vector<std::string>& row, const std::string& value,
                     std::span<const dw1000::Setting> settings) {
  const double id = number(row[1]);
  const double sub = number(row[1].substr(row[1].find(':') + 1));
  const auto found = std::find_if(settings.begin(), settings.end(),
                                  [&](const dw1000::Setting& s) { return s.id == id && s.sub == sub; });
  ASSERT_NE(found, settings.end()) << row[0];
  EXPECT_EQ(found->length, number(row[2])) << row[0];
  EXPECT_EQ(found->value, number(value)) << row[0];
}

TEST(AirReference, RegistersAreThoseOfTheDriver) {
  const Table fixed = page().table("register", "value");
  // The interrupt mask and the lock detection have no effect on the air.
  EXPECT_EQ(fixed.rows.size() + 2, dw1000::kFixedSettings.size());
  for (const auto& row : fixed.rows) expect_register(row, row[3], dw1000::kFixedSettings);
  const Table by_preamble = page().table("register", "256 symbols");
  for (const auto& row : by_preamble.rows) {
    expect_register(row, row[3], dw1000::preamble_settings(Preamble::k64));
    expect_register(row, row[4], dw1000::preamble_settings(Preamble::k128));
    expect_register(row, row[5], dw1000::preamble_settings(Preamble::k256));
  }
  EXPECT_EQ(by_preamble.rows.size(), dw1000::preamble_settings(Preamble::k128).size());
  EXPECT_TRUE(page().contains("TX_POWER is 0x85858585 unless"));
  EXPECT_EQ(dw1000::kDefaultTransmitPower, 0x85858585U);
}

std::uint32_t channel_control() {
  for (const auto& setting : dw1000::kFixedSettings) {
    if (setting.id == dw1000::reg::ChanCtrl::kId) return setting.value;
  }
  return 0;
}

// ---- constants

ranging::DoubleSidedIntervals example_intervals() {
  std::map<std::string, Ticks> intervals;
  for (const auto& row : page().table("example", "code", "Ranging").rows)
    intervals[row[2]] = Ticks(static_cast<std::int64_t>(number(row[1])));
  return {.tag_round = intervals["tag_round"],
          .anchor_reply = intervals["anchor_reply"],
          .anchor_round = intervals["anchor_round"],
          .tag_reply = intervals["tag_reply"]};
}

// When a node of this rank starts a session, from the start of its search.
Ticks listening(std::size_t rank) {
  const groma_Schedule schedule = example_schedule();
  Site site{.id = static_cast<std::uint16_t>(101 + rank),
            .network_id = 7,
            .phy = dw1000::phy_of(Preamble::k128),
            .schedule = &schedule};
  const groma_Schedule usual = schedule_with(3, 12, groma_RangingMethod_METHOD_DS_NEXT_POLL,
                                             kUsualTurnaround_us, usual_gap_us(false, false), kUsualGuard_us);
  const Ticks duration = Superframe(usual, dw1000::phy_of(Preamble::k128)).duration();
  MasterElection election(site, duration, Ticks::from_us(30));
  Coexistence coexistence(site, election, 1);
  coexistence.search(ranging::ClockTime(0));
  return election.lead_at().value() - ranging::ClockTime(0);
}

// Superframes from the revocation of the only slot until another tag gets it.
double vacancy() {
  groma_Schedule schedule = example_schedule();
  schedule.tag_ids_count = 1;
  SlotMap map(schedule);
  std::uint32_t superframe = 1;
  Beacon beacon{.superframe = superframe, .session = 1};
  map.lead(beacon);
  superframe += kLease;
  map.advance(superframe);
  EXPECT_EQ(map.claim(99), SlotMap::Claim::kWait);  // revokes it
  const std::uint32_t revoked = superframe;
  while (map.claim(99) != SlotMap::Claim::kGranted && superframe < revoked + 1000) map.advance(++superframe);
  return superframe - revoked;
}

double joins_without_an_answer() {
  std::uint32_t nonces = 0;
  const groma_Schedule schedule = example_schedule();
  const security::Key key{};
  const Site site{.id = 1,
                  .phy = dw1000::phy_of(Preamble::k128),
                  .schedule = &schedule,
                  .boot_count = 1,
                  .network_key = key,
                  .nonces = &nonces};
  ReplayGuard guard(site);
  int sent = 0;
  for (std::uint32_t superframe = 0; !guard.hopeless() && superframe < 1000; ++superframe) {
    if (!guard.open_slot(superframe)) continue;
    guard.on_sent(superframe, true);
    ++sent;
  }
  return sent;
}

std::map<std::string, double> constants() {
  using dw1000::kDefaultAntennaDelay_dtu;
  const auto intervals = example_intervals();
  groma_Schedule armed = example_schedule();
  armed.arm_ahead = true;
  const std::uint32_t channel = channel_control();
  const double data_kbps =
      static_cast<double>(Ticks::kPerSecond) / count(dw1000::kDataBit) * 330.0 / 378.0 / 1e3;
  const auto flight = ranging::double_sided(intervals).value_or(ranging::FlightTime());
  return {
      {"channel", channel & 0xFU},
      {"prf", (channel >> 18 & 3U) == 2 ? 64 : 0},
      {"preamble code", (channel >> 22 & 0x1FU) == channel >> 27 ? channel >> 27 : 0},
      {"data rate", std::round(data_kbps / 10.0) * 10.0},
      {"kSfdSymbols", dw1000::kSfdSymbols},
      {"kHeaderSymbols", dw1000::kHeaderSymbols},
      {"kMaxFrameBytes", dw1000::kMaxFrameBytes},
      {"kFrameCheckBytes", dw1000::kFrameCheckBytes},
      {"Ticks::kPerSecond", static_cast<double>(Ticks::kPerSecond)},
      {"kTransmitGrid", count(ranging::kTransmitGrid)},
      {"kPreambleSymbol", count(dw1000::kPreambleSymbol)},
      {"kHeaderSymbol", count(dw1000::kHeaderSymbol)},
      {"kDataBit", count(dw1000::kDataBit)},
      {"receiver_start", count(dw1000::phy_of(Preamble::k128).receiver_start())},
      {"kDefaultAntennaDelay_dtu", kDefaultAntennaDelay_dtu},
      {"kLeastAntennaDelay_dtu", dw1000::kLeastAntennaDelay_dtu},
      {"kMostAntennaDelay_dtu", dw1000::kMostAntennaDelay_dtu},
      {"kHeaderBytes", kHeaderBytes},
      {"kCodeBytes", kCodeBytes},
      {"kSecuredFlag", kSecuredFlag},
      {"kMaxAnchors", kMaxAnchors},
      {"kMaxTags", kMaxTags},
      {"kMaxDataBytes", kMaxDataBytes},
      {"kMaxControlBytes", kMaxControlBytes},
      {"kNobody", kNobody},
      {"kBroadcast", kBroadcast},
      {"kLeastTurnaround_us", kLeastTurnaround_us},
      {"kLeastGap_us", kLeastGap_us},
      {"kLeastGuard_us", kLeastGuard_us},
      {"kMostTurnaround_us", kMostTurnaround_us},
      {"kMostGap_us", kMostGap_us},
      {"kMostGuard_us", kMostGuard_us},
      {"kUsualTurnaround_us", kUsualTurnaround_us},
      {"kUsualGuard_us", kUsualGuard_us},
      {"usual_gap_us", usual_gap_us(false, false)},
      {"usual_gap_us, key", usual_gap_us(false, true)},
      {"usual_gap_us, arm_ahead", usual_gap_us(true, false)},
      {"schedule_hash", schedule_hash(example_schedule(), 7, Preamble::k128)},
      {"schedule_hash, arm_ahead", schedule_hash(armed, 7, Preamble::k128)},
      {"kMaxClosing", count(kMaxClosing)},
      {"FlightTime::kFractionBits", ranging::FlightTime::kFractionBits},
      {"kSpeedOfLight_mps", ranging::kSpeedOfLight_mps},
      {"tag_round", count(intervals.tag_round)},
      {"anchor_reply", count(intervals.anchor_reply)},
      {"anchor_round", count(intervals.anchor_round)},
      {"tag_reply", count(intervals.tag_reply)},
      {"double_sided", static_cast<double>(flight.in_256ths())},
      {"clock_offset_ppb", ranging::clock_offset_ppb(intervals)},
      {"distance_m", std::round(static_cast<double>(flight.distance_m()) * 1e4) * 1e-4},
      {"MasterElection::kPatience", MasterElection::kPatience},
      {"lead_at, rank 0", count(listening(0))},
      {"lead_at, rank 1", count(listening(1) - listening(0))},
      {"kMapGoodFor", kMapGoodFor},
      {"kLease", kLease},
      {"kFirstLease", kFirstLease},
      {"kDeaf", kDeaf},
      {"vacant", vacancy()},
      {"AirLink::kMaxFragments", node::AirLink::kMaxFragments},
      {"AirLink::kMaxMessageBytes", node::AirLink::kMaxMessageBytes},
      {"AirLink::kMaxHops", node::AirLink::kMaxHops},
      {"AirLink::kMaxTries", node::AirLink::kMaxTries},
      {"Place::kBeacon", Place::kBeacon},
      {"Place::kShared", Place::kShared},
      {"ReplayGuard", joins_without_an_answer()},
  };
}

TEST(AirReference, EachConstantHasItsValue) {
  const auto all = constants();
  std::set<std::string> seen;
  for (const Table& table : page().tables()) {
    if (table.columns.back() != "code" || table.heading == "Keys and nonces") continue;
    for (const auto& row : table.rows) {
      const auto found = all.find(row[2]);
      ASSERT_NE(found, all.end()) << row[2];
      EXPECT_DOUBLE_EQ(number(row[1]), found->second) << row[0];
      EXPECT_TRUE(seen.insert(row[2]).second) << row[2] << " is there twice";
    }
  }
  for (const Table& table : page().tables()) {
    if (table.heading != "Keys and nonces" || table.columns.front() != "place") continue;
    for (const auto& row : table.rows) {
      EXPECT_EQ(number(row[1]), all.at(row[2])) << row[0];
      seen.insert(row[2]);
    }
  }
  EXPECT_EQ(seen.size(), all.size());
}

// ---- authentication

class Keys {
 public:
  Keys() {
    for (const auto& row : page().table("example", "code", "Keys and nonces").rows) cells_[row[2]] = row[1];
    const Bytes bytes = this->bytes("network_key");
    std::copy_n(bytes.begin(), std::min(bytes.size(), key_.size()), key_.begin());
    authenticator_.enter(session());
  }

  [[nodiscard]] std::uint64_t session() const {
    return std::strtoull(cells_.at("session").c_str(), nullptr, 16);
  }
  [[nodiscard]] Bytes bytes(const std::string& code) const { return reference::bytes_in(cells_.at(code)); }
  [[nodiscard]] Bytes derived(const Bytes& key, Bytes block) {
    security::Key k{};
    security::Block b{};
    std::copy_n(key.begin(), k.size(), k.begin());
    block.resize(b.size());
    std::copy(block.begin(), block.end(), b.begin());
    EXPECT_TRUE(cipher_.encrypt(k, b));
    return {b.begin(), b.end()};
  }
  // The MIC of the frame by the page's table of the nonce and its formulas.
  [[nodiscard]] Bytes mic(const Bytes& key, const Frame& frame, const Bytes& data, Place place) {
    const std::map<std::string, std::uint64_t> parts = {{"source of the header", frame.source},
                                                        {"superframe", place.superframe},
                                                        {"place", place.slot},
                                                        {"type byte, with 0x80", data[kHeaderBytes - 1]},
                                                        {"0", 0}};
    nonce_.assign(std::tuple_size_v<security::Nonce>, 0xEE);
    std::size_t end = 0;
    for (const auto& row : page().table("offset", "part").rows) {
      const auto at = static_cast<std::size_t>(number(row[0]));
      const auto size = static_cast<std::size_t>(number(row[1]));
      EXPECT_EQ(at, end) << row[2];
      end += size;
      for (std::size_t i = 0; i < size && at + i < nonce_.size(); ++i)
        nonce_[at + i] = static_cast<std::uint8_t>(parts.at(row[2]) >> (8 * i));
    }
    EXPECT_EQ(end, nonce_.size());
    Bytes x = derived(key, first_block("X0"));
    Bytes b = {static_cast<std::uint8_t>(data.size() >> 8), static_cast<std::uint8_t>(data.size())};
    b.insert(b.end(), data.begin(), data.end());
    b.resize((b.size() + 15) / 16 * 16);
    for (std::size_t begin = 0; begin < b.size(); begin += 16) {
      for (std::size_t i = 0; i < 16; ++i) x[i] = static_cast<std::uint8_t>(x[i] ^ b[begin + i]);
      x = derived(key, x);
    }
    const Bytes mask = derived(key, first_block("MIC"));
    Bytes code(kCodeBytes);
    for (std::size_t i = 0; i < code.size(); ++i) code[i] = static_cast<std::uint8_t>(x[i] ^ mask[i]);
    return code;
  }
  [[nodiscard]] const Bytes& last_nonce() const { return nonce_; }
  [[nodiscard]] FrameAuthenticator& authenticator() { return authenticator_; }

 private:
  // The byte before the nonce in the formula of this name, the nonce, and zeros.
  [[nodiscard]] Bytes first_block(const std::string& name) const {
    Bytes block;
    for (const std::string& line : page().indented("Keys and nonces")) {
      const auto flags = line.find("AES(key, 0x");
      if (line.substr(0, name.size()) != name || flags == std::string::npos) continue;
      block.push_back(static_cast<std::uint8_t>(number(line.substr(flags + 9))));
    }
    EXPECT_EQ(block.size(), 1U) << name;
    block.insert(block.end(), nonce_.begin(), nonce_.end());
    block.resize(security::kBlockBytes);
    return block;
  }

  std::map<std::string, std::string> cells_;
  security::Key key_{};
  sim::Aes cipher_;
  FrameAuthenticator authenticator_{&cipher_, key_};
  Bytes nonce_;
};

Bytes concatenated(const Bytes& a, std::string_view text, const Bytes& b = {}) {
  Bytes all = a;
  all.insert(all.end(), text.begin(), text.end());
  all.insert(all.end(), b.begin(), b.end());
  return all;
}

Bytes in_bytes(std::uint64_t value, std::size_t size) {
  Bytes bytes(size);
  for (std::size_t i = 0; i < size; ++i) bytes[i] = static_cast<std::uint8_t>(value >> (8 * i));
  return bytes;
}

// The example's bytes without the frame check, which is verified.
Bytes checked(const std::string& name) {
  Bytes bytes = page().example(name);
  EXPECT_GT(bytes.size(), dw1000::kFrameCheckBytes) << name;
  if (bytes.size() < dw1000::kFrameCheckBytes) return {};
  const std::uint16_t check = static_cast<std::uint16_t>(bytes.end()[-2] | bytes.end()[-1] << 8);
  bytes.resize(bytes.size() - dw1000::kFrameCheckBytes);
  EXPECT_EQ(sim::frame_check(bytes), check) << name;
  return bytes;
}

// The example, parsed; serialized again it gives the same bytes, the MIC aside.
Frame parsed(const std::string& name) {
  const Bytes bytes = checked(name);
  const auto result = parse(bytes);
  EXPECT_TRUE(result.frame.has_value()) << name;
  if (!result.frame) return {};
  Bytes again = bytes_of(*result.frame);
  if (result.frame->secured) std::copy(bytes.end() - kCodeBytes, bytes.end(), again.end() - kCodeBytes);
  EXPECT_EQ(again, bytes) << name;
  return *result.frame;
}

Frame frame_from(std::uint8_t sequence, std::uint16_t destination, std::uint16_t source, const Body& body) {
  return {.sequence = sequence, .network = 7, .destination = destination, .source = source, .body = body};
}

Frame secured(Frame frame) {
  frame.secured = true;
  return frame;
}

Poll example_poll() {
  return {.exchange = 4, .superframe = 1000, .count = 3, .anchors = {101, 102, 103}};
}

TEST(AirReference, OpenExamplesAreWhatTheyStandFor) {
  EXPECT_EQ(parsed("POLL"), frame_from(90, kBroadcast, 1, example_poll()));
  EXPECT_EQ(parsed("RESPONSE"), frame_from(33, 1, 101,
                                           Response{.exchange = 4,
                                                    .reply = example_intervals().anchor_reply,
                                                    .closing_valid = true,
                                                    .closed_exchange = 3,
                                                    .closing = example_intervals().anchor_round,
                                                    .health = {.temperature_c = 24, .supply_64ths_v = 211}}));
  Data data{.origin = 1, .target = 102, .message = 5, .fragments = 1, .asks = true, .round = 3, .size = 6};
  const Bytes command = reference::bytes_in("08 2a 78 66 12 00");
  std::copy(command.begin(), command.end(), data.payload.begin());
  EXPECT_EQ(parsed("DATA"), frame_from(11, kBroadcast, 1, data));
}

TEST(AirReference, KeysAreDerivedAsDescribed) {
  EXPECT_TRUE(page().contains("AES(network key, session (8) | \"groma\" | 0 0 0)"));
  EXPECT_TRUE(page().contains("session of the receivers (8) | \"call\" | their superframe (4))"));
  EXPECT_TRUE(page().contains("AES(session key, nonce (8) | \"join\" | 0 0 0 0)"));
  Keys keys;
  const Bytes session = in_bytes(keys.session(), 8);
  EXPECT_EQ(keys.derived(keys.bytes("network_key"), concatenated(session, "groma")),
            keys.bytes("session key"));
  EXPECT_EQ(keys.derived(keys.bytes("session key"), concatenated(in_bytes(0x0000'0009'0000'0000, 8), "join")),
            keys.bytes("challenge key"));
  EXPECT_EQ(keys.derived(keys.bytes("session key"),
                         concatenated(in_bytes(0x0066'0000'0003'0000, 8), "call", in_bytes(77, 4))),
            keys.bytes("call key"));
}

// The code accepts each keyed example at its place, and the page's formula gives the same MIC.
TEST(AirReference, KeyedExamplesAreValid) {
  Keys keys;
  const Bytes session_key = keys.bytes("session key");
  Beacon beacon{.superframe = 1000,
                .session = keys.session(),
                .epoch = 1,
                .schedule_hash = schedule_hash(example_schedule(), 7, Preamble::k128),
                .master = 101,
                .tx_offset_dtu = -189,
                .slots = 2,
                .challenge_response = ChallengeResponse{.id = 1, .nonce = 0x0000'0009'0000'0000}};
  beacon.owners[0] = kBroadcast;
  const auto expect = [&](const std::string& name, const Frame& frame, const Bytes& key, Place place) {
    SCOPED_TRACE(name);
    EXPECT_EQ(parsed(name), secured(frame));
    const Bytes bytes = checked(name);
    const Bytes data(bytes.begin(), bytes.end() - kCodeBytes);
    EXPECT_EQ(keys.mic(key, frame, data, place), Bytes(bytes.end() - kCodeBytes, bytes.end()));
  };

  expect("keyed POLL", frame_from(90, kBroadcast, 1, example_poll()), session_key, {1000, 0});
  EXPECT_EQ(keys.last_nonce(), keys.bytes("nonce"));
  EXPECT_TRUE(keys.authenticator().fits(checked("keyed POLL"), example_poll(), {1000, 0}));
  EXPECT_FALSE(keys.authenticator().fits(checked("keyed POLL"), example_poll(), {1000, 1}));

  expect("keyed BEACON", frame_from(9, kBroadcast, 101, beacon), session_key, {1000, Place::kBeacon});
  EXPECT_TRUE(keys.authenticator().fits(checked("keyed BEACON"), beacon, {1000, Place::kBeacon}));

  const Join join{.origin = 1, .nonce = std::uint64_t{1} << 32 | 1002, .tag = true, .wants_slot = true};
  expect("keyed JOIN", frame_from(4, kBroadcast, 1, join), session_key, {1002, Place::kShared});
  EXPECT_TRUE(keys.authenticator().fits(checked("keyed JOIN"), join, {1002, Place::kShared}));

  const Join challenge{
      .origin = 1, .nonce = 0x0000'0009'0000'0000, .tag = true, .wants_challenge_response = true};
  expect("challenge JOIN", frame_from(3, kBroadcast, 1, challenge), keys.bytes("challenge key"),
         {998, Place::kShared});
  EXPECT_TRUE(keys.authenticator().fits(checked("challenge JOIN"), challenge, {998, Place::kShared}));
  EXPECT_FALSE(keys.authenticator().fits(checked("challenge JOIN"), join, {998, Place::kShared}));

  beacon.superframe = 1001;
  beacon.tx_offset_dtu = 0;
  beacon.shared = beacon.merge_request = true;
  beacon.place = Ticks(600'000'000);
  beacon.challenge_response.reset();
  expect("merge request", frame_from(10, kBroadcast, 101, beacon), keys.bytes("call key"),
         {1001, Place::kShared});
  const auto fits_for = [&](std::uint32_t superframe) {
    return keys.authenticator().fits(checked("merge request"), beacon, {1001, Place::kShared},
                                     {0x0066'0000'0003'0000, superframe});
  };
  EXPECT_TRUE(fits_for(77));
  EXPECT_FALSE(fits_for(78));
}

}  // namespace
}  // namespace groma::mac
