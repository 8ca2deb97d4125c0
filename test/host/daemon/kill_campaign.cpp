// gromad is killed at random times while it records and calibrates: each capture is good up to the cut, and
// each calibration file is whole. GROMA_KILLS is the number of times.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <random>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/input_file.hpp"
#include "host/io/log_ring.hpp"
#include "test/host/daemon/gromad_fixture.hpp"
#include "test/support/child_process.hpp"

namespace groma::daemon {
namespace {

using ::testing::AnyOf;

class KillTest : public GromadTest {
 protected:
  struct Found {
    std::size_t poses = 0;         // replayed
    std::size_t digests = 0;       // compared
    std::size_t calibrations = 0;  // 1: there is a calibration file
    std::size_t temporaries = 0;   // files that the killed process left
  };

  // Expects that the capture replays to what went out, up to the cut.
  void check_capture(const std::filesystem::path& capture, const std::string& live, Found& found) const {
    const std::filesystem::path stream = folder_ / "stream.jsonl";
    const auto replayed = groma::test::run_child(
        {GROMA_PATH, "replay", capture.string(), "--stream", stream.string(), "--json"});
    // 3: the last frame is torn.
    ASSERT_THAT(replayed.exit_code, AnyOf(io::kGood, io::kDoneWithWarnings)) << replayed.err << replayed.out;
    const json report = json::parse(replayed.out);
    EXPECT_EQ(report.at("same"), true);
    found.poses += report.at("poses").get<std::size_t>();
    for (const json& section : report.at("sections"))
      found.digests += section.at("digests").get<std::size_t>();
    // The last lines may not be on the disk yet, and the client came later than the first.
    const std::string lines = io::read_file(stream);
    const std::size_t from =
        live.empty() ? std::string::npos : lines.find(live.substr(0, live.find('\n') + 1));
    if (from == std::string::npos) return;
    const std::size_t common = std::min(lines.size() - from, live.size());
    EXPECT_EQ(lines.substr(from, common), live.substr(0, common));
  }

  void check_files(const std::string& live, Found& found) const {
    if (std::filesystem::exists(folder_ / "drive.glog")) check_capture(folder_ / "drive.glog", live, found);
    if (!io::ring_files(folder_ / "ring").empty()) {
      const std::filesystem::path last = folder_.write("last.glog", io::last_of_ring(folder_ / "ring", 1e9));
      check_capture(last, live, found);
    }
    if (std::filesystem::exists(folder_ / "solved.yaml")) {
      ++found.calibrations;
      EXPECT_EQ(io::read_calibration(folder_ / "solved.yaml").frame, "map");
    }
    found.temporaries += temporaries();
  }

  [[nodiscard]] std::size_t temporaries() const {
    std::size_t count = 0;
    for (const auto& entry : std::filesystem::directory_iterator(folder_.path()))
      count += entry.path().extension() == ".tmp" ? 1U : 0U;
    return count;
  }
};

TEST_F(KillTest, CapturesAndCalibrationsAreWholeWheneverItIsKilled) {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> life_s(0.05, 5.0);
  const std::string config =
      folder_
          .write("gromad.yaml",
                 config_text("{learn: true, file: calibration.yaml, output: solved.yaml}") +
                     "log: drive.glog\nring: {folder: ring, size_mib: 16}\nlast_pose: last.json\n")
          .string();
  SimulatedSite site(folder_.path(), kSpeed);
  // Two of six anchors are to be calibrated.
  const std::vector<model::Anchor> all = site.anchors;
  site.anchors = {all[0], all[1], all[3], all[4]};
  write_surveyed(site);
  site.anchors = all;
  Found found;
  for (int kill = 0; kill < GROMA_KILLS; ++kill) {
    for (const char* name : {"drive.glog", "ring", "solved.yaml"})
      std::filesystem::remove_all(folder_ / name);
    const double after_s = life_s(random) + (kill % 5 == 0 ? 8.0 : 0.0);
    const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(after_s);
    {
      Gromad gromad({"--config", config});
      ASSERT_TRUE(run_until(site, gromad, [&] { return std::chrono::steady_clock::now() >= end; }))
          << gromad.log();
    }  // killed
    const std::string live = client_ ? poses_received() : std::string();
    client_.reset();
    objects_.clear();
    check_files(live, found);
    ASSERT_FALSE(HasFailure()) << "kill " << kill << " after " << after_s << " s";
  }
  fmt::print(
      "{} kills: {} POSE lines replayed, {} digests the same, {} calibration files, {} temporary files\n",
      GROMA_KILLS, found.poses, found.digests, found.calibrations, found.temporaries);
  EXPECT_GT(found.digests, 0U);
  EXPECT_GT(found.calibrations, 0U);

  // The next start removes what was left.
  folder_.write(".groma-999999999-0.tmp", "half a file");
  for (const auto& entry : std::filesystem::directory_iterator(folder_.path())) {
    if (entry.path().extension() != ".tmp") continue;
    std::filesystem::last_write_time(entry,
                                     std::filesystem::file_time_type::clock::now() - std::chrono::minutes(2));
  }
  Gromad gromad({"--config", config});
  ASSERT_TRUE(run_until(site, gromad, [&] { return pose_stream_port(gromad).has_value(); })) << gromad.log();
  EXPECT_EQ(temporaries(), 0U);
}

}  // namespace
}  // namespace groma::daemon
