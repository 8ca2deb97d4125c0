// gromad on full disks and under limits: it localizes, and says what it cannot do.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <string>

#include "host/io/calibration_file.hpp"
#include "host/io/exit_code.hpp"
#include "test/host/daemon/gromad_fixture.hpp"

namespace groma::daemon {
namespace {

using ::testing::HasSubstr;

TEST_F(GromadTest, LocalizesByACalibrationThatCannotBeWrittenYet) {
  SimulatedSite site(folder_.path(), kSpeed);
  std::filesystem::create_symlink("/dev/full", folder_ / "solved.yaml");
  Gromad gromad(
      {"--config", folder_.write("gromad.yaml", config_text("{drive_s: 26, output: solved.yaml}")).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("solved.yaml: cannot be written (No space left on device)"));
  std::filesystem::remove(folder_ / "solved.yaml");
  ASSERT_TRUE(run_until(site, gromad, [&] {
    return gromad.log().find("calibration written to ") != std::string::npos;
  })) << gromad.log();
  EXPECT_EQ(io::read_calibration(folder_ / "solved.yaml").anchors.size(), site.anchors.size());
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
}

TEST_F(GromadTest, LocalizesAlthoughTheDiskIsFullAtTheStart) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  std::filesystem::create_symlink("/dev/full", folder_ / "drive.glog");
  const std::string text = config_text("{file: calibration.yaml}") + "log: drive.glog\n";
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 50; })) << gromad.log();
  EXPECT_THAT(gromad.log(),
              HasSubstr("drive.glog: cannot be written (No space left on device); nothing is recorded"));
}

TEST_F(GromadTest, LocalizesBeyondAFileSizeLimit) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text = config_text("{file: calibration.yaml}") + "log: drive.glog\n";
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()}, /*as_nobody=*/false,
                /*max_file_bytes=*/524288);
  ASSERT_TRUE(run_until(site, gromad, [&] {
    return gromad.log().find("File too large); the recording has ended") != std::string::npos;
  })) << gromad.log();
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 50; })) << gromad.log();
}

}  // namespace
}  // namespace groma::daemon
