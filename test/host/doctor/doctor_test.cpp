// groma doctor names each of twelve faults that are put in: real pseudo-terminals, a simulated site, gromad.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sched.h>
#include <sys/mount.h>
#include <sys/stat.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <map>

#include "host/daemon/session.hpp"
#include "host/io/exit_code.hpp"
#include "test/host/doctor/doctor_fixture.hpp"

namespace groma::daemon {
namespace {

using groma::test::ChildResult;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

constexpr const char* kCalibrated = "{file: calibration.yaml}";

class Doctor : public DoctorTest {
 protected:
  struct Result {  // NOLINT(bugprone-exception-escape): moving JSON does not throw
    int exit_code = -1;
    json report;
    std::string text;

    // The first check with the worst verdict; null: all are good.
    [[nodiscard]] json first() const {
      const json verdict = report.at("verdict");
      for (const json& check : report.at("checks")) {
        if (check.at("verdict") == verdict && verdict != "good") return check;
      }
      return {};
    }
  };

  Result examine(SimulatedSite& site, const std::vector<std::string>& before = {}) {
    Result result = examine_once(site, before);
    // A busy computer that holds up the site makes its odometry late, which is one more fault.
    for (int again = 0; again < 3 && site.robot_clock_s == 0.0 && says_odometry_is_late(result.report);
         ++again) {
      run_site(site, Session::kFaultShown_s / kSpeed);
      result = examine_once(site, before);
    }
    return result;
  }
  static void expect_first(const Result& result, const std::string& fault, const std::string& kind,
                           int code) {
    const json first = result.first();
    ASSERT_FALSE(first.is_null()) << "all is good: " << result.text;
    EXPECT_EQ(first.at("fault"), fault) << result.text;
    EXPECT_EQ(first.at("kind"), kind) << result.text;
    EXPECT_THAT(first.at("facts"), Not(IsEmpty()));
    EXPECT_TRUE(first.at("remedy").is_string()) << result.text;
    EXPECT_EQ(result.exit_code, code) << result.text;
  }
  // Until gromad has sent that many poses, of any state.
  void run_until_poses(SimulatedSite& site, Gromad& gromad, std::size_t count, const std::string& state) {
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses(state) >= count; })) << gromad.log();
    client_.reset();
  }
  // Until gromad has reported its status several times.
  void run_until_open(SimulatedSite& site, Gromad& gromad) {
    ASSERT_TRUE(run_until(site, gromad, [&] {
      return std::count_if(objects_.begin(), objects_.end(),
                           [](const json& object) { return object.at("class") == "STATUS"; }) >= 3;
    })) << gromad.log();
    client_.reset();
  }

 private:
  Result examine_once(SimulatedSite& site, const std::vector<std::string>& before) {
    std::vector<std::string> arguments = before;
    for (const char* word : {GROMA_PATH, "doctor", "--json", "--for", "2", "--config"}) {
      arguments.emplace_back(word);
    }
    arguments.push_back((folder_ / "gromad.yaml").string());
    const ChildResult child = run_beside(site, arguments);
    EXPECT_EQ(child.err, "");
    Result result;
    result.exit_code = child.exit_code;
    result.text = child.out;
    result.report = json::parse(child.out, nullptr, false);
    if (result.report.is_discarded()) ADD_FAILURE() << child.exit_code << ": " << child.out;
    return result;
  }
  static bool says_odometry_is_late(const json& report) {
    return std::any_of(report.at("checks").begin(), report.at("checks").end(), [](const json& check) {
      return check.at("fault") == "clock-offset" && check.at("name") == "robot";
    });
  }
  static void run_site(SimulatedSite& site, double for_s) {
    const double until_s = site.site_time_s() + for_s * kSpeed;
    while (site.site_time_s() < until_s) {
      site.step();
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
  }
};

TEST_F(Doctor, SaysThatAllOfAHealthySiteIsGood) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::uint16_t web_port = free_port();
  const auto config = write_config(
      kCalibrated, fmt::format("log: drive.glog\nlast_pose: last.json\nweb: {{port: {}}}\n", web_port));
  Gromad gromad({"--config", config.string()});
  run_until_poses(site, gromad, 200, "TRACKING");
  const Result result = examine(site);
  EXPECT_EQ(result.exit_code, io::kGood) << result.text;
  EXPECT_EQ(result.report.at("verdict"), "good");
  std::map<std::string, int> kinds;
  for (const json& check : result.report.at("checks")) {
    EXPECT_EQ(check.at("verdict"), "good") << check;
    EXPECT_TRUE(check.at("fault").is_null() && check.at("remedy").is_null()) << check;
    ++kinds[check.at("kind")];
  }
  const std::map<std::string, int> expected{{"configuration", 1}, {"calibration", 1}, {"output", 3},
                                            {"link", 1},          {"node", 1},        {"odometry", 1},
                                            {"clock", 3},         {"pair", 6},        {"anchors", 1},
                                            {"gromad", 1},        {"localization", 1}};
  EXPECT_EQ(kinds, expected) << result.text;
  EXPECT_THAT(result.text, HasSubstr("tag 1"));
}

TEST_F(Doctor, NamesAMissingPort) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  write_config(kCalibrated);
  site.unplug();
  expect_first(examine(site), "no-port", "link", io::kUnavailable);
  Gromad gromad({"--config", (folder_ / "gromad.yaml").string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "no-port", "link", io::kUnavailable);
}

TEST_F(Doctor, NamesAMissingPermission) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  write_config(kCalibrated);
  const std::string pty = std::filesystem::read_symlink(folder_ / "tag-1").string();
  ASSERT_EQ(::chmod(pty.c_str(), ::geteuid() == 0 ? 0600 : 0), 0);
  std::filesystem::permissions(folder_.path(), std::filesystem::perms{0755});
  std::vector<std::string> as_nobody;
  if (::geteuid() == 0) {
    as_nobody = {"/usr/bin/setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"};
    if (groma::test::run_child(
            {as_nobody[0], "--reuid", "65534", "--regid", "65534", "--clear-groups", GROMA_PATH, "--version"})
            .exit_code != 0) {
      GTEST_SKIP() << "groma cannot be run by another user here";
    }
  }
  expect_first(examine(site, as_nobody), "no-permission", "link", io::kNoPermission);
}

TEST_F(Doctor, NamesAWrongSpeedAndTheRightOne) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const auto config = write_config(kCalibrated);
  std::string text = groma::test::read_text(config);
  text.replace(text.find("1000000"), 7, "115200");
  folder_.write("gromad.yaml", text);
  const Result offline = examine(site);
  expect_first(offline, "wrong-speed", "link", io::kUnavailable);
  EXPECT_THAT(offline.first().at("remedy").get<std::string>(), HasSubstr("baud: 1000000"));
  Gromad gromad({"--config", config.string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "wrong-speed", "link", io::kUnavailable);
}

TEST_F(Doctor, NamesANodeOfAnotherSite) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  site.tag_id = 7;
  Gromad gromad({"--config", write_config(kCalibrated).string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "other-site", "node", io::kUnavailable);
}

TEST_F(Doctor, NamesANodeWithTheSameIdOfAnotherSite) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  for (model::Anchor& anchor : site.anchors) anchor.id = static_cast<model::NodeId>(anchor.id + 50);
  Gromad gromad({"--config", write_config(kCalibrated).string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "other-site", "node", io::kUnavailable);
}

TEST_F(Doctor, NamesASilentNode) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  write_config(kCalibrated);
  site.tag_silent = true;
  expect_first(examine(site), "silent-node", "node", io::kUnavailable);
  Gromad gromad({"--config", (folder_ / "gromad.yaml").string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "silent-node", "node", io::kUnavailable);
}

TEST_F(Doctor, NamesMissingOdometry) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  write_config(kCalibrated);
  site.odometry = false;
  expect_first(examine(site), "no-odometry", "odometry", io::kUnavailable);
  Gromad gromad({"--config", (folder_ / "gromad.yaml").string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "no-odometry", "odometry", io::kUnavailable);
}

TEST_F(Doctor, NamesOdometryWithoutMotion) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  site.odometry_moves = false;
  Gromad gromad({"--config", write_config(kCalibrated).string()});
  run_until_open(site, gromad);
  expect_first(examine(site), "no-motion", "odometry", io::kUnavailable);
}

TEST_F(Doctor, NamesAClockThatIsOneSecondBehind) {
  SimulatedSite site(folder_.path(), 1.0);
  write_surveyed(site);
  const double unix_s =
      std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
  site.robot_clock_s = unix_s - 1.0 - (SimulatedSite::kRobotOrigin_s + site.site_time_s());
  std::string text = groma::test::read_text(write_config(kCalibrated));
  text.erase(text.find("speed:"));
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  run_until_poses(site, gromad, 50, "TRACKING");
  const Result result = examine(site);
  expect_first(result, "clock-offset", "clock", io::kDoneWithWarnings);
  EXPECT_THAT(result.first().at("facts").back().get<std::string>(), HasSubstr("s behind this computer's"));
}

TEST_F(Doctor, NamesAFullDisk) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::filesystem::path disk = folder_ / "disk";
  std::filesystem::create_directory(disk);
  // Seen by this process and its children only.
  const int spaces = CLONE_NEWNS | (::geteuid() == 0 ? 0 : CLONE_NEWUSER);
  if (::unshare(spaces) != 0 || ::mount("none", "/", nullptr, MS_REC | MS_PRIVATE, nullptr) != 0 ||
      ::mount("tmpfs", disk.c_str(), "tmpfs", 0, "size=2m") != 0) {
    GTEST_SKIP() << "a file system cannot be mounted here";
  }
  Gromad gromad({"--config", write_config(kCalibrated, "log: disk/drive.glog\n").string()});
  run_until_poses(site, gromad, 50, "TRACKING");
  std::ofstream(disk / "rest") << std::string(std::size_t{4} << 20U, 'x');
  const Result result = examine(site);
  expect_first(result, "disk-full", "output", io::kUnavailable);
  EXPECT_THAT(result.first().at("name").get<std::string>(), HasSubstr("disk/drive.glog"));
  gromad.terminate();
  EXPECT_TRUE(gromad.exit_code().has_value());
  ::umount2(disk.c_str(), MNT_DETACH);
}

TEST_F(Doctor, NamesAWrongMap) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site, /*renumbered=*/true);
  Gromad gromad({"--config", write_config(kCalibrated).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return gromad.log().find("map-mismatch") != std::string::npos; }))
      << gromad.log();
  client_.reset();
  expect_first(examine(site), "map-mismatch", "diagnosis", io::kBadData);
}

TEST_F(Doctor, NamesAMissingCalibration) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_config(kCalibrated);
  expect_first(examine(site), "no-calibration", "calibration", io::kBadData);
}

// Where an interface exists but is down: test/vm/doctor_can_test.cpp.
TEST_F(Doctor, NamesACanBusThatIsDown) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  std::string text = groma::test::read_text(write_config(kCalibrated));
  const std::string port = "{path: tag-1, baud: 1000000}";
  text.replace(text.find(port), port.size(), "{path: can:can9/1}");
  folder_.write("gromad.yaml", text);
  expect_first(examine(site), "can-down", "can", io::kUnavailable);
}

TEST_F(Doctor, NamesErrorsOfTheConfiguration) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_config(kCalibrated, "modle: schmidt\n");
  const Result result = examine(site);
  expect_first(result, "bad-configuration", "configuration", io::kBadConfiguration);
  EXPECT_THAT(result.text, HasSubstr("unknown key 'modle'"));
}

TEST_F(Doctor, PrintsAParagraphForEachCheck) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_config(kCalibrated);
  const ChildResult child =
      run_beside(site, {GROMA_PATH, "doctor", "--for", "1", "--config", (folder_ / "gromad.yaml").string()});
  EXPECT_EQ(child.exit_code, io::kBadData);
  EXPECT_THAT(child.out, HasSubstr("bad      calibration " + (folder_ / "calibration.yaml").string()));
  EXPECT_THAT(child.out, HasSubstr("\n         no-calibration\n"));
  EXPECT_THAT(child.out, HasSubstr("\n         -> copy the site's calibration"));
}

}  // namespace
}  // namespace groma::daemon
