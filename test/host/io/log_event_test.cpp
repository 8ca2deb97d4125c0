#include "host/io/log_event.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "host/io/error.hpp"
#include "host/io/log_file.hpp"
#include "host/io/log_ring.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

using ::testing::ElementsAre;

// An event in words.
struct Words {
  std::string operator()(const SectionStart& of) const { return of.continues ? "continues" : "start"; }
  std::string operator()(const LinkBytes& of) const {
    return "bytes " + std::to_string(of.link) + " " + std::string(of.bytes.begin(), of.bytes.end());
  }
  std::string operator()(const LinkReopened& of) const { return "reopened " + std::to_string(of.link); }
  std::string operator()(const LoopTick& of) const { return "tick " + std::to_string(of.now_s); }
  std::string operator()(const LoopFlush& /*of*/) const { return "flush"; }
  std::string operator()(const LoopState& of) const {
    return (of.kind == LoopState::Kind::kSnapshot ? "snapshot " : "adoption ") + std::string(of.content);
  }
  std::string operator()(const PoseDigest& of) const {
    return "digest " + std::to_string(of.poses) + " " + std::to_string(of.fnv1a);
  }
};

std::span<const std::uint8_t> bytes_of(const std::string& text) {
  return {reinterpret_cast<const std::uint8_t*>(text.data()), text.size()};
}

std::vector<std::string> events_of(const std::string& log, std::size_t expected_damage = 0) {
  std::vector<std::string> words;
  const std::size_t damaged =
      read_log_events(log, [&](const LogEvent& event) { words.push_back(std::visit(Words(), event)); });
  if (expected_damage == 0) EXPECT_EQ(damaged, 0U);
  return words;
}

TEST(LogEvents, AreReadBackInTheirOrderBesideTheMeasurements) {
  const std::string state(5000, 's');
  const std::string read(4096, 'b');
  LogEncoder encoder;
  encoder.begin_section({}, 1);
  encoder.put(LoopState{LoopState::Kind::kSnapshot, state});
  encoder.put(LinkBytes{2, bytes_of(read), 1.5});
  encoder.put(model::OdometrySample{.t_s = 7.0});
  encoder.put(LinkBytes{0, bytes_of("x"), 1.5});
  encoder.put(LinkReopened{3});
  encoder.put(LoopTick{2.0});
  encoder.put(LoopState{LoopState::Kind::kAdoption, ""});
  encoder.put(LoopFlush{});
  encoder.put(PoseDigest{2.5, 3, fnv1a("line")});
  encoder.flush();
  encoder.begin_section({}, 2, /*continues=*/true);
  const std::string log = encoder.take();
  EXPECT_THAT(events_of(log), ElementsAre("start", "snapshot " + state, "bytes 2 " + read, "bytes 0 x",
                                          "reopened 3", "tick 2.000000", "adoption ", "flush",
                                          "digest 3 " + std::to_string(fnv1a("line")), "continues"));
  const LogContent content = parse_log(log, 1);
  EXPECT_EQ(content.damaged_bytes, 0U);
  ASSERT_EQ(content.sections.size(), 2U);
  EXPECT_EQ(content.sections[0].samples.odometry.size(), 1U);
}

TEST(LogEvents, OfADamagedFragmentAreLeftOut) {
  std::string log;
  append_event(LoopState{LoopState::Kind::kSnapshot, std::string(3000, 's')}, log);
  const std::size_t begin = log.size();
  append_event(LoopTick{1.0}, log);
  append_event(LoopState{LoopState::Kind::kSnapshot, "whole"}, log);
  // In the first, the second and the last fragment.
  for (const std::size_t at : {std::size_t{100}, begin / 2, begin - 10}) {
    std::string damaged = log;
    damaged[at] = static_cast<char>(damaged[at] ^ 1);
    EXPECT_THAT(events_of(damaged, 1), ElementsAre("tick 1.000000", "snapshot whole"));
  }
  // Cut anywhere.
  for (std::size_t size = 0; size < log.size(); size += 97) {
    for (const std::string& event : events_of(log.substr(0, size), 1))
      EXPECT_THAT(event, testing::AnyOf("snapshot " + std::string(3000, 's'), "tick 1.000000"));
  }
}

class LogRingTest : public ::testing::Test {
 protected:
  // Writes as gromad does: a section, and ticks for 10 s.
  void append_file(LogRing& ring, bool continues, std::size_t filling = 0) {
    LogEncoder encoder;
    encoder.begin_section(std::vector<DescriptionFile>{{"tags.csv", "tag_id"}}, 1, continues);
    encoder.put(LoopState{LoopState::Kind::kSnapshot, std::to_string(number_++)});
    for (int i = 0; i <= 10; ++i) encoder.put(LoopTick{now_s_ + i});
    now_s_ += 10.0;
    std::string bytes = encoder.take();
    bytes.append(filling, '\0');
    const Descriptor file = ring.open_next();
    ASSERT_EQ(::write(file.get(), bytes.data(), bytes.size()), static_cast<ssize_t>(bytes.size()));
  }

  groma::test::ScratchFolder folder_;
  int number_ = 0;
  double now_s_ = 1000.0;
};

TEST_F(LogRingTest, KeepsTheNewestFilesWithinItsSize) {
  constexpr std::uint64_t kSize = 80'000;
  {
    LogRing ring(folder_.path() / "ring", kSize);
    EXPECT_THROW(LogRing(folder_.path() / "ring", kSize), DeviceError);
    for (int i = 0; i < 30; ++i) {
      append_file(ring, i > 0, ring.file_bytes());
      std::uint64_t size = 0;
      for (const auto& file : ring_files(folder_.path() / "ring")) size += std::filesystem::file_size(file);
      EXPECT_LE(size, kSize);
      if (i > 10) EXPECT_GT(size, kSize / 2);
    }
  }
  const auto files = ring_files(folder_.path() / "ring");
  EXPECT_EQ(files.back().filename(), "00000030.glog");
  // Another run goes on.
  LogRing ring(folder_.path() / "ring", kSize);
  append_file(ring, false);
  EXPECT_EQ(ring_files(folder_.path() / "ring").back().filename(), "00000031.glog");
}

TEST_F(LogRingTest, GivesTheLastPartAsOneLog) {
  const std::filesystem::path ring_folder = folder_.path() / "ring";
  EXPECT_EQ(last_of_ring(ring_folder, 10.0), "");
  LogRing ring(ring_folder, 1'000'000);
  append_file(ring, false);
  append_file(ring, true);
  append_file(ring, false);
  append_file(ring, true);
  append_file(ring, true);
  const std::string last = last_of_ring(ring_folder, 11.0);
  EXPECT_EQ(parse_log(last).sections.size(), 1U);
  EXPECT_EQ(events_of(last).front(), "continues");
  EXPECT_EQ(events_of(last)[1], "snapshot 3");
  const std::string all = last_of_ring(ring_folder, 1e9);
  const LogContent content = parse_log(all);
  ASSERT_EQ(content.sections.size(), 2U);
  for (const LogSection& section : content.sections) EXPECT_EQ(section.description.size(), 1U);
  const auto events = events_of(all);
  EXPECT_EQ(std::count(events.begin(), events.end(), "start"), 2);
  EXPECT_EQ(std::count(events.begin(), events.end(), "continues"), 0);
  for (const char* snapshot : {"snapshot 0", "snapshot 1", "snapshot 4"})
    EXPECT_EQ(std::count(events.begin(), events.end(), snapshot), 1);

  // gromad is writing the newest file.
  const auto newest = ring_files(ring_folder).back();
  std::filesystem::resize_file(newest, std::filesystem::file_size(newest) - 3);
  EXPECT_EQ(events_of(last_of_ring(ring_folder, 1e9)).size(), events.size() - 1);
}

}  // namespace
}  // namespace groma::io
