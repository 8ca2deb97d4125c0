// What gromad recorded is replayed to the bytes that went out.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/dataset.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/input_file.hpp"
#include "host/io/log_ring.hpp"
#include "test/host/daemon/gromad_fixture.hpp"
#include "test/support/child_process.hpp"

namespace groma::daemon {
namespace {

using ::testing::AnyOf;
using ::testing::HasSubstr;

class CaptureTest : public GromadTest {
 protected:
  [[nodiscard]] static groma::test::ChildResult groma(const std::vector<std::string>& arguments) {
    std::vector<std::string> all{GROMA_PATH};
    all.insert(all.end(), arguments.begin(), arguments.end());
    return groma::test::run_child(all);
  }

  // The report of replaying the capture into stream.jsonl, which is expected to be the same.
  [[nodiscard]] json expect_same(const std::filesystem::path& capture,
                                 const std::vector<std::string>& more = {}) {
    std::vector<std::string> arguments{"replay", capture.string(), "--stream", stream_file().string(),
                                       "--json"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const auto replayed = groma(arguments);
    EXPECT_EQ(replayed.exit_code, io::kGood) << replayed.err << replayed.out;
    if (replayed.exit_code != io::kGood) return {};
    json report = json::parse(replayed.out);
    EXPECT_EQ(report.at("same"), true);
    return report;
  }

  [[nodiscard]] std::filesystem::path stream_file() const { return folder_ / "stream.jsonl"; }
};

std::size_t lines_in(const std::string& text) {
  return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n'));
}

// Learning, a lost and found link, garbage, and a reload.
TEST_F(CaptureTest, ReplaysWhatWentOutWithLearningToTheByte) {
  SimulatedSite site(folder_.path(), kSpeed);
  const std::vector<model::Anchor> all = site.anchors;
  site.anchors = {all[0], all[1], all[3], all[4]};
  write_surveyed(site);
  site.anchors = all;
  const std::string text = config_text("{learn: true, file: calibration.yaml}") + "log: drive.glog\n";
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  site.send_to_robot_socket("{\"class\":\"ODOMETRY\",\"t_s\":NaN}\n\xff\xfe\n{\"class\":\"LASER\"}\n");
  site.send_to_tag_link({0x01, 0x55, 0x00, 0xFF, 0x12});
  site.unplug();
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("DEGRADED") >= 20; })) << gromad.log();
  site.plug_in();
  ASSERT_TRUE(run_until(site, gromad, [&] {
    return gromad.log().find("anchor 102 is calibrated") != std::string::npos;
  })) << gromad.log();
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
  gromad.terminate();
  ASSERT_EQ(gromad.exit_code(), io::kGood) << gromad.log();

  const json report = expect_same(folder_ / "drive.glog");
  ASSERT_EQ(report.at("sections").size(), 1U);
  EXPECT_GT(report.at("sections")[0].at("digests"), 10);
  const std::string stream = io::read_file(stream_file());
  const std::string live = poses_received();
  EXPECT_GT(lines_in(live), 300U);
  EXPECT_EQ(lines_in(stream), report.at("poses"));
  EXPECT_TRUE(stream.ends_with(live));
}

// Each section by itself: two runs of gromad, the second from the last pose, and within it other lever arms.
TEST_F(CaptureTest, ReplaysEachSectionByItself) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text =
      config_text("{file: calibration.yaml}") + "log: drive.glog\nlast_pose: last.json\n";
  const std::string config = folder_.write("gromad.yaml", text).string();
  std::vector<std::string> live;
  for (int run = 0; run < 2; ++run) {
    Gromad gromad({"--config", config});
    const std::size_t before = poses("TRACKING");
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 200; })) << gromad.log();
    if (run == 1) {
      std::string moved = text;
      const std::string arm = fmt::format("[0, 0, {}]", SimulatedSite::kTagHeight_m);
      folder_.write("gromad.yaml", moved.replace(moved.find(arm), arm.size(), "[0, 0, 0.51]"));
    }
    gromad.hang_up();
    ASSERT_TRUE(run_until(site, gromad, [&] {
      return gromad.log().find("gromad: reloaded") != std::string::npos;
    })) << gromad.log();
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 400; })) << gromad.log();
    gromad.terminate();
    ASSERT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
    live.push_back(poses_received());
    client_.reset();
  }
  const std::filesystem::path capture = folder_ / "drive.glog";
  EXPECT_EQ(expect_same(capture).at("sections").size(), 3U);
  std::vector<std::string> streams;
  for (const char* section : {"1", "2", "3"}) {
    EXPECT_EQ(expect_same(capture, {"--section", section}).at("sections").size(), 1U);
    streams.push_back(io::read_file(stream_file()));
  }
  EXPECT_TRUE(streams[0].ends_with(live[0]));
  EXPECT_TRUE((streams[1] + streams[2]).ends_with(live[1]));
  EXPECT_GT(lines_in(streams[2]), 100U);
  // Without the first section's beginning, the others are what they were.
  std::string bytes = io::read_file(capture);
  folder_.write("cut.glog", bytes.substr(bytes.size() / 20));
  const auto cut = groma({"replay", (folder_ / "cut.glog").string(), "--stream", stream_file().string()});
  EXPECT_THAT(cut.exit_code, AnyOf(io::kGood, io::kDoneWithWarnings)) << cut.err;
  EXPECT_TRUE(io::read_file(stream_file()).ends_with(live[1]));

  // A byte of the robot's odometry, near the end: not of a snapshot.
  const std::size_t at = bytes.rfind("\"vx_mps\"", bytes.size() - 10'000);
  ASSERT_NE(at, std::string::npos);
  bytes[at + 1] = 'z';
  const auto changed =
      groma({"replay", folder_.write("changed.glog", bytes).string(), "--stream", stream_file().string()});
  EXPECT_EQ(changed.exit_code, io::kBadData) << changed.out;
  EXPECT_THAT(changed.out, HasSubstr("differs from second"));
}

// The oldest files make room, and the rest replays by itself.
TEST_F(CaptureTest, KeepsTheLastDriveInARingOfItsSize) {
  constexpr std::uint64_t kSize = 16U << 20U;
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string config = folder_
                                 .write("gromad.yaml", config_text("{file: calibration.yaml}") +
                                                           "ring: {folder: ring, size_mib: 16}\n")
                                 .string();
  Gromad gromad({"--config", config});
  const std::string filling = R"({"class":"FILLING","text":")" + std::string(4000, 'x') + "\"}\n";
  std::uint64_t largest = 0;
  const auto has_turned = [&] {
    for (int i = 0; i < 8; ++i) site.send_to_robot_socket(filling);
    std::uint64_t size = 0;
    const auto files = io::ring_files(folder_ / "ring");
    std::error_code ignored;
    for (const auto& file : files) {
      const std::uintmax_t bytes = std::filesystem::file_size(file, ignored);
      size += ignored ? 0 : bytes;
    }
    largest = std::max(largest, size);
    return !files.empty() && files.front().filename() >= "00000003.glog";
  };
  ASSERT_TRUE(run_until(site, gromad, has_turned)) << gromad.log();
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 200; })) << gromad.log();
  EXPECT_LE(largest, kSize);
  EXPECT_GT(largest, kSize / 2);

  // While it runs: at least this much.
  const std::string last = (folder_ / "last.glog").string();
  const auto saved = groma({"record", "--last", "2s", "--config", config, "-o", last});
  ASSERT_EQ(saved.exit_code, io::kGood) << saved.err;
  const json part = expect_same(last);
  ASSERT_EQ(part.at("sections").size(), 1U);
  EXPECT_GE(part.at("sections")[0].at("duration_s"), 2.0);

  gromad.terminate();
  ASSERT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
  ASSERT_EQ(groma({"record", "--last", "1d", "--config", config, "-o", last}).exit_code, io::kGood);
  const json whole = expect_same(last);
  ASSERT_EQ(whole.at("sections").size(), 1U);
  const std::string stream = io::read_file(stream_file());
  const std::string live = poses_received();
  EXPECT_LT(stream.size(), live.size());
  EXPECT_TRUE(live.ends_with(stream));
  EXPECT_GT(io::read_dataset(last).ranges.size(), 100U);
}

// Localization goes on without a place for the ring, and after that place is lost.
TEST_F(CaptureTest, LocalizesWithoutItsRing) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text = config_text("{file: calibration.yaml}");
  {
    folder_.write("file", "");
    Gromad gromad({"--config", folder_.write("gromad.yaml", text + "ring: {folder: file/ring}\n").string()});
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 20; })) << gromad.log();
    EXPECT_THAT(gromad.log(), HasSubstr("; the last drive is not kept"));
  }
  client_.reset();
  Gromad gromad({"--config", folder_.write("gromad.yaml", text + "ring: {folder: ring}\n").string()});
  const std::string filling = R"({"class":"FILLING","text":")" + std::string(4000, 'x') + "\"}\n";
  std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 20; })) << gromad.log();
  std::filesystem::remove_all(folder_ / "ring");
  ASSERT_TRUE(run_until(site, gromad, [&] {
    for (int i = 0; i < 8; ++i) site.send_to_robot_socket(filling);
    return gromad.log().find("the recording has ended") != std::string::npos;
  })) << gromad.log();
  before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
}

}  // namespace
}  // namespace groma::daemon
