// The daemon as a process, on real pseudo-terminals, a real Unix socket and a real TCP client.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/descriptor.hpp"
#include "host/io/exit_code.hpp"
#include "host/model/calibration.hpp"
#include "proto/frame_codec.hpp"
#include "test/host/daemon/gromad_fixture.hpp"
#include "test/host/daemon/prometheus_parser.hpp"
#include "test/support/child_process.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::daemon {
namespace {

using test::port_in_log;
using ::testing::HasSubstr;

TEST_F(GromadTest, DropsAndCountsImpossibleSamples) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 250; })) << gromad.log();
  const auto dropped = [&] {
    std::uint64_t count = 0;
    for (const json& object : objects_) {
      if (object.at("class") == "STATUS") count = object.at("dropped");
    }
    return count;
  };
  const std::uint64_t before = dropped();
  const std::size_t first = objects_.size();
  std::uint64_t sent = 0;
  for (const std::string wrong :
       {R"("vx_mps":1e308,"vy_mps":0,"omega_radps":0)", R"("vx_mps":-1e12,"vy_mps":0,"omega_radps":0)",
        R"("vx_mps":0,"vy_mps":31,"omega_radps":0)", R"("vx_mps":0,"vy_mps":0,"omega_radps":1e300)"}) {
    site.send_to_robot_socket(R"({"class":"ODOMETRY","t_s":)" +
                              std::to_string(site.site_time_s() + SimulatedSite::kRobotOrigin_s) + "," +
                              wrong + "}\n");
    ++sent;
    const std::size_t poses_before = poses("TRACKING");
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= poses_before + 100; }))
        << gromad.log();
  }
  ASSERT_TRUE(run_until(site, gromad, [&] { return dropped() > before; })) << gromad.log();
  EXPECT_GE(dropped(), before + sent - 1);
  EXPECT_NE(gromad.log().find("physically impossible samples dropped so far"), std::string::npos)
      << gromad.log();
  for (std::size_t i = first; i < objects_.size(); ++i) {
    const json& object = objects_[i];
    if (object.at("class") != "POSE") continue;
    // A busy machine can hold up the simulated site's messages.
    if (object.at("state") != "TRACKING") {
      EXPECT_EQ(object.at("state"), "DEGRADED");
      EXPECT_THAT(object.at("reason").get<std::string>(),
                  testing::AnyOf("no-odometry", "odometry-times", "no-ranges", "tag-silent"));
    }
    EXPECT_TRUE(object.at("covariance")[0].is_number());
    const auto truth = SimulatedSite::truth(object.at("t_s"));
    EXPECT_LT(
        std::hypot(object.at("x_m").get<double>() - truth.x_m, object.at("y_m").get<double>() - truth.y_m),
        0.3);
  }
}

TEST_F(GromadTest, LocalizesLosesItsTagAndFindsItAgain) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 250; })) << gromad.log();

  ASSERT_FALSE(objects_.empty());
  EXPECT_EQ(objects_.front().at("class"), "VERSION");
  const json& pose = objects_.back().at("class") == "POSE" ? objects_.back() : objects_[objects_.size() - 2];
  ASSERT_EQ(pose.at("class"), "POSE");
  for (const char* key : {"t_s", "x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad"}) {
    EXPECT_TRUE(pose.at(key).is_number()) << key;
  }
  ASSERT_EQ(pose.at("covariance").size(), 36U);
  EXPECT_GT(pose.at("covariance")[0], 0.0);
  EXPECT_EQ(pose.at("covariance")[1], pose.at("covariance")[6]);
  EXPECT_LT(largest_error_m(50), 0.3);
  // The daemon requested the tag's hello and, each second, its time.
  wire::FrameDecoder decoder;
  for (const std::uint8_t byte : site.received()) decoder.push(byte);
  EXPECT_GE(decoder.counters().frames, 3U);
  const auto status = std::find_if(objects_.rbegin(), objects_.rend(),
                                   [](const json& object) { return object.at("class") == "STATUS"; });
  ASSERT_NE(status, objects_.rend());
  ASSERT_EQ(status->at("links").size(), 1U);
  ASSERT_TRUE(status->at("links")[0].at("round_trip_s").is_number());
  EXPECT_GE(status->at("links")[0].at("round_trip_s"), 0.0);
  EXPECT_LT(status->at("links")[0].at("round_trip_s"), 0.2);

  // Garbage on either input does no harm.
  site.send_to_robot_socket("{\"class\":\"ODOMETRY\",\"t_s\":NaN}\n\xff\xfe\n{\"class\":\"LASER\"}\n");
  site.send_to_tag_link({0x01, 0x55, 0x00, 0xFF, 0x12});
  std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 50; })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("robot: "));

  site.unplug();
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("DEGRADED") >= 20; })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("tag-1: the link is lost"));

  site.plug_in();
  before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("tag-1: reopened"));
  EXPECT_LT(largest_error_m(50), 0.5);

  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
}

// One timestamp is 0.95 s ahead; the robot's clock and the poses continue.
TEST_F(GromadTest, NamesAWrongTimestampAndContinues) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 250; })) << gromad.log();
  const double odd_s = site.site_time_s() + SimulatedSite::kRobotOrigin_s + 0.95;
  site.send_to_robot_socket(fmt::format(
      "{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":1,\"vy_mps\":0,\"omega_radps\":0.25}}\n", odd_s));
  const auto named = [&] {
    return std::find_if(objects_.begin(), objects_.end(), [](const json& object) {
      return object.at("class") == "STATUS" && !object.at("diagnosis").empty();
    });
  };
  ASSERT_TRUE(run_until(site, gromad, [&] { return named() != objects_.end(); })) << gromad.log();
  const json fault = named()->at("diagnosis")[0];
  EXPECT_EQ(fault.at("cause"), "clock-offset");
  EXPECT_NEAR(fault.at("value"), 0.95, 0.2);
  EXPECT_THAT(gromad.log(), HasSubstr("odometry samples dropped for their t_s so far: 1: clock-offset"));
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
  EXPECT_LT(largest_error_m(50), 0.3);
  EXPECT_EQ(gromad.log().find("its clock was set"), std::string::npos) << gromad.log();
}

TEST_F(GromadTest, NamesAWrongMapInPosesStatusAndLog) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site, /*renumbered=*/true);
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  // Not simply the first finding: on a busy machine the odometry can be late as well.
  const auto finding = [&] {
    for (const json& object : objects_) {
      if (object.at("class") != "STATUS") continue;
      for (const json& each : object.at("diagnosis"))
        if (each.at("cause") == "map-mismatch") return each;
    }
    return json();
  };
  ASSERT_TRUE(run_until(site, gromad, [&] { return !finding().is_null(); })) << gromad.log();
  EXPECT_THAT(finding().at("remedy").get<std::string>(), HasSubstr("calibrate again"));
  EXPECT_THAT(gromad.log(), HasSubstr("map-mismatch: "));
  EXPECT_LT(poses("TRACKING"), objects_.size() / 20);

  objects_.clear();
  const auto poses_by_mismatch = [&](bool mismatch) {
    return std::count_if(objects_.begin(), objects_.end(), [&](const json& object) {
      return object.at("class") == "POSE" && (object.at("reason") == "map-mismatch") == mismatch;
    });
  };
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses_by_mismatch(true) >= 50; })) << gromad.log();
  EXPECT_EQ(poses_by_mismatch(false), 0);
  EXPECT_EQ(poses("TRACKING"), 0U);
}

// As `groma calibrate --fix` stores it. The robot moves at 1 m/s.
TEST_F(GromadTest, CorrectsTheClockOfRangesByItsCalibration) {
  constexpr double kLate_s = 0.6;
  for (const bool is_stored : {false, true}) {
    SimulatedSite site(folder_.path(), kSpeed);
    site.ranges_late_s = kLate_s;
    write_surveyed(site, false,
                   is_stored ? std::optional(model::ClockError{.offset_s = kLate_s}) : std::nullopt);
    objects_.clear();
    client_.reset();
    Gromad gromad(
        {"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
    ASSERT_TRUE(run_until(site, gromad, [&] { return objects_.size() >= 700; })) << gromad.log();
    if (is_stored) {
      EXPECT_LT(largest_error_m(300), 0.2);
      EXPECT_GT(poses("TRACKING"), 300U);
      EXPECT_THAT(gromad.log(), HasSubstr("corrects the times of ranges by -0.600 s"));
    } else {
      EXPECT_GT(largest_error_m(300), 0.4);
    }
    std::filesystem::remove(folder_ / "robot.sock");
  }
}

// As groma replay does, from the last two minutes.
TEST_F(GromadTest, NamesAMistakeOfTheOdometryInStatusAndLog) {
  constexpr double kFast = 8.0;
  SimulatedSite site(folder_.path(), kFast);
  site.on_lines = [](double t_s, const std::string& lines) {
    const std::string odometry =
        fmt::format("{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":0,\"omega_radps\":{}}}\n",
                    t_s, 1.2 * SimulatedSite::kRadius_m * SimulatedSite::kOmega, SimulatedSite::kOmega);
    return odometry + lines.substr(lines.find('\n') + 1);
  };
  write_surveyed(site);
  Gromad gromad(
      {"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}", kFast)).string()});
  const auto finding = [&] {
    for (const json& object : objects_) {
      if (object.at("class") != "STATUS") continue;
      for (const json& each : object.at("diagnosis"))
        if (each.at("cause") == "odometry-scale") return each;
    }
    return json();
  };
  const auto is_named = [&] { return !finding().is_null(); };
  // Two searches take their time on a busy machine.
  bool is_found = false;
  for (int i = 0; i < 5 && !is_found; ++i) is_found = run_until(site, gromad, is_named);
  ASSERT_TRUE(is_found) << gromad.log();
  EXPECT_NEAR(finding().at("value"), 1.2, 0.05) << finding().dump();
  EXPECT_THAT(gromad.log(), HasSubstr("odometry-scale: the odometry moves"));
}

// A pose does not wait for reorder_lag_s as its odometry sample does. The lag is long so that the test also
// passes on a busy machine.
TEST_F(GromadTest, PublishesAPoseBeforeItsSampleIsPassedOn) {
  constexpr double kLag_s = 0.5;
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text =
      config_text("{file: calibration.yaml}") + fmt::format("reorder_lag_s: {}\n", kLag_s);
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 200; })) << gromad.log();
  ASSERT_GE(ages_s_.size(), 200U);
  const auto middle = ages_s_.begin() + static_cast<std::ptrdiff_t>(ages_s_.size() / 2);
  std::nth_element(ages_s_.begin(), middle, ages_s_.end());
  EXPECT_LT(*middle, kLag_s);
  std::vector<double> times_s;
  for (const json& object : objects_) {
    if (object.at("class") == "POSE") times_s.push_back(object.at("t_s"));
  }
  EXPECT_EQ(std::adjacent_find(times_s.begin(), times_s.end(), std::greater_equal<>()), times_s.end());
  EXPECT_LT(largest_error_m(50), 0.3);
}

TEST_F(GromadTest, CalibratesOnADriveThenLocalizes) {
  SimulatedSite site(folder_.path(), kSpeed);
  site.range_bias_m = 0.4;
  Gromad gromad(
      {"--config", folder_.write("gromad.yaml", config_text("{drive_s: 26, output: solved.yaml}")).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 150; })) << gromad.log();
  EXPECT_LT(largest_error_m(50), 0.3);
  bool drove = false;
  for (const json& object : objects_) {
    drove = drove || (object.at("class") == "STATUS" && object.at("state") == "CALIBRATION_DRIVE");
  }
  EXPECT_TRUE(drove);
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();

  const model::Calibration estimated = io::read_calibration(folder_ / "solved.yaml");
  EXPECT_EQ(estimated.anchors.size(), site.anchors.size());
  EXPECT_EQ(estimated.input_sha256.size(), 64U);
}

// The commands read a log of the daemon, even if the daemon was killed while recording.
TEST_F(GromadTest, RecordsALogThatTheCommandsRead) {
  SimulatedSite site(folder_.path(), kSpeed);
  site.range_bias_m = 0.4;
  const std::filesystem::path config =
      folder_.write("gromad.yaml", config_text("{drive_s: 26, output: solved.yaml}") + "log: drive.glog\n");
  {
    Gromad gromad({"--config", config.string()});
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
    EXPECT_THAT(gromad.log(), HasSubstr("drive.glog"));
    Gromad second({"--config", config.string()});
    EXPECT_EQ(second.exit_code(), io::kUnavailable) << second.log();
  }  // killed
  const std::string log = (folder_ / "drive.glog").string();
  const auto groma = [](const std::vector<std::string>& arguments) {
    std::vector<std::string> all{GROMA_PATH};
    all.insert(all.end(), arguments.begin(), arguments.end());
    return groma::test::run_child(all);
  };
  const model::Calibration estimated = io::read_calibration(folder_ / "solved.yaml");

  // The daemon's calibration drive is exactly the first 26 s of the log.
  const io::Dataset recorded = io::read_dataset(log);
  ASSERT_FALSE(recorded.pose_prior.empty());
  const double begin_s = recorded.pose_prior.front().t_s;
  const auto calibrated = groma({"calibrate", log, "--to", fmt::format("{}", begin_s + 26.0), "-o",
                                 (folder_ / "again.yaml").string(), "--json"});
  ASSERT_EQ(calibrated.exit_code, io::kDoneWithWarnings) << calibrated.err;
  const model::Calibration again = io::read_calibration(folder_ / "again.yaml");
  ASSERT_EQ(again.anchors.size(), estimated.anchors.size());
  for (std::size_t i = 0; i < again.anchors.size(); ++i) {
    EXPECT_LT((again.anchors[i].position_m - estimated.anchors[i].position_m).head<2>().norm(), 0.05);
  }

  const auto replayed = groma({"replay", log, "--calibration", (folder_ / "solved.yaml").string(), "-o",
                               (folder_ / "estimate.csv").string(), "--json"});
  EXPECT_THAT(replayed.exit_code, ::testing::AnyOf(io::kGood, io::kDoneWithWarnings)) << replayed.err;
  EXPECT_GT(json::parse(replayed.out).at("ranges_used"), 500);

  // Poses from a file instead of the log's: the same world, rotated by 180 degrees.
  std::string turned = "t_s,x_m,y_m,z_m,yaw_rad\n";
  for (const model::PoseSample& pose : recorded.pose_prior) {
    turned += fmt::format("{},{},{},0,{}\n", pose.t_s, -pose.x_m, -pose.y_m, pose.yaw_rad + 3.14159265358979);
  }
  const std::string poses_file = folder_.write("turned.csv", turned).string();
  ASSERT_EQ(
      groma({"calibrate", log, "--poses", poses_file, "-o", (folder_ / "turned.yaml").string()}).exit_code,
      io::kDoneWithWarnings);
  const model::Calibration other = io::read_calibration(folder_ / "turned.yaml");
  for (std::size_t i = 0; i < other.anchors.size(); ++i) {
    EXPECT_LT((other.anchors[i].position_m + site.anchors[i].position_m).head<2>().norm(), 0.3);
  }

  // A second run appends a section; the first stays.
  const std::size_t ranges = recorded.ranges.size();
  {
    Gromad gromad({"--config", config.string()});
    ASSERT_TRUE(
        run_until(site, gromad, [&] { return gromad.log().find("calibrates from") != std::string::npos; }));
    gromad.terminate();
    EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
  }
  io::ReadOptions first;
  first.log_section = 1;
  EXPECT_EQ(io::read_dataset(log, first).ranges.size(), ranges);
  EXPECT_EQ(io::read_dataset(log, first).log->sections, 2U);
}

// Two of six anchors are not in the file. The daemon localizes by the others, calibrates these two and writes
// them.
TEST_F(GromadTest, CalibratesNewAnchorsWhileLocalizing) {
  SimulatedSite site(folder_.path(), kSpeed);
  const std::vector<model::Anchor> all = site.anchors;
  site.anchors = {all[0], all[1], all[3], all[4]};
  write_surveyed(site);
  site.anchors = all;
  Gromad gromad(
      {"--config",
       folder_.write("gromad.yaml", config_text("{learn: true, file: calibration.yaml, output: solved.yaml}"))
           .string()});
  std::map<int, std::vector<json>> reported;
  std::size_t seen = 0;
  const auto state_of = [&](int id) {
    for (; seen < objects_.size(); ++seen) {
      if (objects_[seen].at("class") != "CALIBRATION") continue;
      for (const json& anchor : objects_[seen].at("anchors")) reported[anchor.at("id")].push_back(anchor);
    }
    return reported[id].empty() ? std::string() : reported[id].back().at("state").get<std::string>();
  };
  ASSERT_TRUE(run_until(site, gromad, [&] { return state_of(102) == "live" && state_of(105) == "live"; }))
      << gromad.log();
  EXPECT_EQ(state_of(100), "known");
  EXPECT_EQ(reported[102].back().at("coverage"), 1.0);
  EXPECT_TRUE(reported[102].back().at("sigma_m").is_number());
  EXPECT_THAT(gromad.log(), HasSubstr("anchor 102 is calibrated"));
  // Localization continues with the new anchors.
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= before + 100; })) << gromad.log();
  EXPECT_LT(largest_error_m(50), 0.4);
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();

  const model::Calibration estimated = io::read_calibration(folder_ / "solved.yaml");
  ASSERT_EQ(estimated.anchors.size(), 6U);
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_LT((estimated.anchors[i].position_m - all[i].position_m).head<2>().norm(), 0.4)
        << estimated.anchors[i].id;
  }
}

// Without a calibration: from pose priors into a file that the next start reads.
TEST_F(GromadTest, CalibratesASiteFromNothingAndReadsItAgain) {
  SimulatedSite site(folder_.path(), kSpeed);
  const std::string source = "{learn: true, file: site.yaml, output: site.yaml}";
  const std::filesystem::path config = folder_.write("gromad.yaml", config_text(source));
  {
    Gromad gromad({"--config", config.string()});
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
    EXPECT_THAT(gromad.log(), HasSubstr("from the pose priors"));
    gromad.terminate();
    EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
  }
  const model::Calibration estimated = io::read_calibration(folder_ / "site.yaml");
  EXPECT_GE(estimated.anchors.size(), 3U);
  Gromad again({"--config", config.string()});
  ASSERT_TRUE(run_until(site, again, [&] { return again.log().find("localizes with") != std::string::npos; }))
      << again.log();
  EXPECT_THAT(again.log(), HasSubstr("from the filter's poses"));
}

TEST_F(GromadTest, ServesItsCounters) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string text = config_text("{file: calibration.yaml}") + "web: {port: 0}\n";
  Gromad gromad({"--config", folder_.write("gromad.yaml", text).string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 50; })) << gromad.log();
  const auto port = port_in_log(gromad, "web server");
  ASSERT_TRUE(port);
  groma::test::TcpClient client(*port);
  ASSERT_TRUE(client.send("GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"));
  std::string answer;
  ASSERT_TRUE(run_until(site, gromad, [&] {
    answer += client.receive();
    return client.ended();
  })) << gromad.log();
  EXPECT_THAT(answer, ::testing::StartsWith("HTTP/1.1 200 OK\r\n"));
  const auto metrics = test::PrometheusParser::parse(answer.substr(answer.find("\r\n\r\n") + 4));
  EXPECT_GE(metrics.at("groma_pose_latency_seconds").samples.at("groma_pose_latency_seconds_count").at({}),
            50.0);
  EXPECT_EQ(metrics.at("groma_stream_clients").samples.at("groma_stream_clients").at({}), 1.0);
}

TEST_F(GromadTest, StartsFromItsLastPoseAfterARestart) {
  SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  const std::string config =
      folder_.write("gromad.yaml", config_text("{file: calibration.yaml}") + "last_pose: last-pose.json\n")
          .string();
  {
    Gromad gromad({"--config", config});
    ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
    EXPECT_EQ(gromad.log().find("last pose"), std::string::npos) << gromad.log();
    gromad.terminate();
    EXPECT_EQ(gromad.exit_code(), io::kGood) << gromad.log();
  }
  site.pose_priors = false;
  client_.reset();
  objects_.clear();
  Gromad gromad({"--config", config});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("starts from the last pose, "));
  EXPECT_LT(largest_error_m(200), 0.4);
}

TEST_F(GromadTest, EndsWithTheExitCodeOfTheFault) {
  {
    Gromad gromad({});
    EXPECT_EQ(gromad.exit_code(), io::kUsage);
    EXPECT_THAT(gromad.log(), HasSubstr("--config"));
  }
  {
    Gromad gromad({"--version"});
    EXPECT_EQ(gromad.exit_code(), io::kGood);
  }
  const auto code_of = [&](const std::string& text, std::string& log) {
    Gromad gromad({"--config", folder_.write("bad.yaml", text).string()});
    const auto code = gromad.exit_code();
    log = gromad.log();
    return code;
  };
  std::string log;
  EXPECT_EQ(code_of(config_text("{drive_s: 100}") + "sped: 3\n", log), io::kBadConfiguration);
  EXPECT_THAT(log, HasSubstr((folder_ / "bad.yaml").string() + ":13:1: "));
  EXPECT_EQ(code_of(config_text("{file: none.yaml}"), log), io::kBadData);
  EXPECT_THAT(log, HasSubstr("none.yaml"));
  EXPECT_EQ(code_of(config_text("{drive_s: 100, output: no/such/folder.yaml}"), log), io::kBadConfiguration);
  std::filesystem::create_directory(folder_ / "tag-1");
  EXPECT_EQ(code_of(config_text("{drive_s: 100}"), log), io::kUnavailable);
  EXPECT_THAT(log, HasSubstr((folder_ / "tag-1").string() + ": cannot be used as a link"));
}

TEST_F(GromadTest, WaitsForLinksThatAreMissingAtTheStart) {
  {
    const SimulatedSite site(folder_.path(), kSpeed);
    write_surveyed(site);
  }
  std::filesystem::remove(folder_ / "tag-1");
  std::filesystem::remove(folder_ / "robot.sock");
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  std::optional<StreamClient> client;
  const auto status = [&]() -> json {
    if (!client) {
      if (const auto port = pose_stream_port(gromad)) client.emplace(*port);
    }
    if (!client) return {};
    for (const json& object : client->read()) {
      if (object.at("class") == "STATUS") return object;
    }
    return {};
  };
  const auto deadline = std::chrono::steady_clock::now() + kPatience;
  json waiting;
  while (waiting.is_null() && gromad.running() && std::chrono::steady_clock::now() < deadline) {
    waiting = status();
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  ASSERT_FALSE(waiting.is_null()) << gromad.log();
  EXPECT_EQ(waiting.at("links")[0].at("open"), false);
  EXPECT_THAT(waiting.at("links")[0].at("error").get<std::string>(), HasSubstr("tag-1: no such device"));
  EXPECT_EQ(waiting.at("robot").at("open"), false);
  EXPECT_THAT(gromad.log(), HasSubstr((folder_ / "robot.sock").string() + ": no such device"));
  client.reset();

  SimulatedSite site(folder_.path(), kSpeed);
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") >= 50; })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("tag-1: opened"));
}

TEST_F(GromadTest, ReportsAPortItMayNotOpen) {
  SimulatedSite site(folder_.path(), kSpeed);
  const std::string pty = std::filesystem::read_symlink(folder_ / "tag-1").string();
  ASSERT_EQ(::chmod(pty.c_str(), ::geteuid() == 0 ? 0600 : 0), 0);
  constexpr gid_t kTty = 5;  // on Debian
  if (::geteuid() == 0) {
    ASSERT_EQ(::chown(pty.c_str(), 0, kTty), 0);
  }
  std::filesystem::permissions(folder_.path(), std::filesystem::perms{0755});
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{drive_s: 100}")).string()},
                /*as_nobody=*/true);
  const int code = gromad.exit_code().value_or(-1);
  if (code == 126 || code == 127) GTEST_SKIP() << "gromad cannot be run by another user here";
  EXPECT_EQ(code, io::kNoPermission) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("usermod -aG"));
}

TEST_F(GromadTest, RefusesACalibrationThatIsNotUsable) {
  SimulatedSite site(folder_.path(), kSpeed);
  model::Calibration calibration;
  calibration.verdict = model::Verdict::kUnusable;
  folder_.write("calibration.yaml", io::format_calibration(calibration));
  Gromad gromad({"--config", folder_.write("gromad.yaml", config_text("{file: calibration.yaml}")).string()});
  EXPECT_EQ(gromad.exit_code(), io::kBadData) << gromad.log();
}

}  // namespace
}  // namespace groma::daemon
