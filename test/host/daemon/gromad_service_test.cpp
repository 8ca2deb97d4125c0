// gromad as a service: check and reload of its configuration, reports to systemd, its end by a signal.
#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <string>

#include <nlohmann/json.hpp>

#include "host/io/dataset.hpp"
#include "host/io/descriptor.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/input_file.hpp"
#include "test/host/daemon/gromad_fixture.hpp"
#include "test/support/child_process.hpp"

namespace groma::daemon {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

TEST_F(GromadTest, ReloadsOnHangUpAndRefusesTheWholeOnAnError) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text = config_text("{file: calibration.yaml}");
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  const auto has_logged = [&](const std::string& line) {
    return run_until(site, gromad, [&] { return gromad.log().find(line) != std::string::npos; });
  };
  folder_.write("gromad.yaml", text + "reorder_lag_s: 0.1\nmodle: joint\n");
  gromad.hang_up();
  ASSERT_TRUE(has_logged("nothing was reloaded")) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("gromad.yaml:14:1: unknown key 'modle'"));
  folder_.write("gromad.yaml", text);
  gromad.hang_up();
  ASSERT_TRUE(has_logged("reloaded " + (folder_ / "gromad.yaml").string() + ": verdict usable, 6 anchors"))
      << gromad.log();
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
  EXPECT_LT(largest_error_m(50), 0.3);
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
}

TEST_F(GromadTest, GivesPosesAndEndsWhileNobodyReadsItsLog) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  const std::size_t logged = gromad.log().size();
  gromad.fill_log();
  site.send_to_robot_socket("a line that is logged\n");
  const std::size_t before = poses("TRACKING");
  const auto deadline = std::chrono::steady_clock::now() + kPatience;
  while (poses("TRACKING") < before + 100 && std::chrono::steady_clock::now() < deadline) {
    site.step();
    for (json& object : client_->read()) objects_.push_back(std::move(object));
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  EXPECT_GE(poses("TRACKING"), before + 100);
  gromad.terminate();
  while (gromad.running() && std::chrono::steady_clock::now() < deadline)
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  EXPECT_FALSE(gromad.running());
  EXPECT_EQ(gromad.exit_code(), io::kGood);
  EXPECT_THAT(gromad.log().substr(logged), Not(HasSubstr("a line that is logged")));
}

// A reload reads its files beside the loop: a slow disk delays no pose.
TEST_F(GromadTest, LocalizesWhileAReloadReads) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text = config_text("{file: calibration.yaml}");
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  // Reading a pipe takes until its writer closes it.
  const std::filesystem::path file = folder_ / "calibration.yaml";
  const std::string content = io::read_file(file);
  std::filesystem::remove(file);
  ASSERT_EQ(::mkfifo(file.c_str(), 0600), 0);
  io::Descriptor writer(::open(file.c_str(), O_RDWR | O_CLOEXEC));
  gromad.hang_up();
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
  EXPECT_EQ(gromad.log().find("reloaded"), std::string::npos) << gromad.log();
  ASSERT_EQ(::write(writer.get(), content.data(), content.size()), static_cast<ssize_t>(content.size()));
  writer.close();
  ASSERT_TRUE(run_until(site, gromad, [&] { return gromad.log().find("reloaded ") != std::string::npos; }))
      << gromad.log();
}

TEST_F(GromadTest, ReportsToSystemd) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const io::Descriptor socket(::socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  const std::string path = (folder_ / "notify").string();
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  path.copy(address.sun_path, sizeof(address.sun_path) - 1);
  ASSERT_EQ(::bind(socket.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
  ::setenv("NOTIFY_SOCKET", path.c_str(), 1);
  ::setenv("WATCHDOG_USEC", "200000", 1);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  ::unsetenv("NOTIFY_SOCKET");
  ::unsetenv("WATCHDOG_USEC");
  std::map<std::string, int> states;
  std::string first;
  const auto has = [&](const std::string& state, int times) {
    char buffer[256];
    for (ssize_t n = 0; (n = ::recv(socket.get(), buffer, sizeof(buffer), 0)) > 0;) {
      const std::string message(buffer, static_cast<std::size_t>(n));
      if (first.empty()) first = message;
      ++states[message.substr(0, message.find('\n'))];
    }
    return states[state] >= times;
  };
  ASSERT_TRUE(run_until(site, gromad, [&] { return has("WATCHDOG=1", 5); })) << gromad.log();
  EXPECT_EQ(first, "READY=1");
  EXPECT_EQ(states["READY=1"], 1);
  gromad.hang_up();
  ASSERT_TRUE(run_until(site, gromad, [&] { return has("READY=1", 2); })) << gromad.log();
  EXPECT_EQ(states["RELOADING=1"], 1);
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
  EXPECT_TRUE(has("STOPPING=1", 1));
}

// The measurements of the last moments too, which wait for later ones when the signal comes.
TEST_F(GromadTest, RecordsAllMeasurementsUntilItIsTerminated) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", folder_
                                 .write("gromad.yaml", config_text("{file: calibration.yaml}") +
                                                           "log: drive.glog\nreorder_lag_s: 0.5\n")
                                 .string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 50; })) << gromad.log();
  double last_s = 0.0;
  for (const json& object : objects_) {
    if (object.at("class") == "POSE") last_s = object.at("t_s");
  }
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
  const io::Dataset recorded = io::read_dataset(folder_ / "drive.glog");
  ASSERT_FALSE(recorded.odometry.empty());
  EXPECT_GE(recorded.odometry.back().t_s, last_s);
}

TEST_F(GromadTest, SaysThatACalibrationDriveEndedTooEarly) {
  SimulatedSite site(folder_.path(), kSpeed);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{drive_s: 100}")).string()});
  ASSERT_TRUE(
      run_until(site, gromad, [&] { return gromad.log().find("calibrates from") != std::string::npos; }));
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood);
  EXPECT_THAT(gromad.log(), HasSubstr(" of 100 s; nothing is calibrated"));
}

TEST_F(GromadTest, CheckReportsEachErrorAndOpensNoDevice) {
  const auto check = [&](const std::string& text) {
    return groma::test::run_child(
        {GROMAD_PATH, "--check", "--config", folder_.write("gromad.yaml", text).string()});
  };
  const groma::test::ChildResult good = check(config_text("{drive_s: 100}"));
  EXPECT_EQ(good.exit_code, io::kGood) << "although there is no tag-1";
  EXPECT_EQ(good.err, "");
  const groma::test::ChildResult bad = check(config_text("{drive_s: 1}") + "sped: 3\n");
  EXPECT_EQ(bad.exit_code, io::kBadConfiguration);
  const std::string file = (folder_ / "gromad.yaml").string();
  EXPECT_EQ(bad.err.rfind(file + ":10:24: calibration.drive_s is 1; ", 0), 0U) << bad.err;
  EXPECT_THAT(bad.err,
              HasSubstr("\n" + file + ":13:1: unknown key 'sped'; did you mean 'speed'? known here: "));
}

TEST_F(GromadTest, SaysWhatIsWrongWithItsCommandLine) {
  const auto error_of = [](std::vector<std::string> arguments, int exit_code) {
    arguments.insert(arguments.begin(), GROMAD_PATH);
    const groma::test::ChildResult result = groma::test::run_child(arguments);
    EXPECT_EQ(result.exit_code, exit_code) << result.err;
    return result.err;
  };
  EXPECT_EQ(error_of({"gromad.yaml"}, io::kUsage),
            "gromad: unexpected argument 'gromad.yaml'; did you mean '--config gromad.yaml'? see 'gromad "
            "--help'\n");
  EXPECT_EQ(error_of({"--confg", "gromad.yaml"}, io::kUsage),
            "gromad: unknown option '--confg'; did you mean '--config'? see 'gromad --help'\n");
  const std::string none = folder_ / "none.yaml";
  EXPECT_THAT(error_of({"--config", none}, io::kBadConfiguration), HasSubstr(none + ": does not exist; "));
  const groma::test::ChildResult help = groma::test::run_child({GROMAD_PATH, "--help"});
  EXPECT_THAT(help.out, HasSubstr("Documentation: docs/reference/gromad.md (each key of the configuration)"));
}

TEST_F(GromadTest, PrintsSchemaManualPageAndCompletion) {
  const auto printed = [](const std::string& format) {
    const groma::test::ChildResult result =
        groma::test::run_child({GROMAD_PATH, "--print-reference", format});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return result.out;
  };
  EXPECT_EQ(json::parse(printed("schema")).at("title"), "Configuration of gromad");
  EXPECT_EQ(printed("man").rfind(".TH GROMAD 8 ", 0), 0U);
  EXPECT_THAT(printed("bash"), HasSubstr("--check"));
  std::ifstream page(GROMA_SOURCE_DIR "/docs/reference/options.md");
  std::ostringstream text;
  text << page.rdbuf();
  EXPECT_THAT(text.str(), HasSubstr(printed("markdown"))) << "put it there";
}

}  // namespace
}  // namespace groma::daemon
