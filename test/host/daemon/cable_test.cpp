// Cables of serial ports that are pulled out and put back. The daemon runs in this process, on an injected
// clock.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <malloc.h>
#include <poll.h>
#include <pty.h>
#include <termios.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <iterator>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/descriptor.hpp"
#include "host/model/calibration.hpp"
#include "test/host/daemon/daemon_loop_fixture.hpp"

namespace groma::daemon {
namespace {

using nlohmann::json;

// A node's port under a path, as a pseudo-terminal.
class Cable {
 public:
  explicit Cable(std::filesystem::path path) : path_(std::move(path)) { plug_in(); }

  // A new pseudo-terminal under the path.
  void plug_in() {
    int master = -1;
    int slave = -1;
    std::array<char, 64> name{};
    termios raw{};
    ::cfmakeraw(&raw);
    if (::openpty(&master, &slave, nullptr, &raw, nullptr) != 0 ||
        ::ttyname_r(slave, name.data(), name.size()) != 0) {
      throw std::runtime_error("openpty");
    }
    master_ = io::Descriptor(master);
    slave_ = io::Descriptor(slave);
    std::filesystem::create_symlink(name.data(), path_);
  }
  void pull() {
    std::filesystem::remove(path_);
    slave_.close();
    master_.close();
  }
  // Exchanges the plugs of two cables that are pulled.
  static void put_back_exchanged(Cable& a, Cable& b) {
    std::swap(a.path_, b.path_);
    a.plug_in();
    b.plug_in();
  }

  void send(std::span<const std::uint8_t> bytes) const {
    ASSERT_EQ(::write(master_.get(), bytes.data(), bytes.size()), static_cast<ssize_t>(bytes.size()));
  }
  // The reader has not taken all bytes. Asking passes on those that the terminal still holds back.
  [[nodiscard]] bool has_unread() const {
    pollfd waiting{slave_.get(), POLLIN, 0};
    return ::poll(&waiting, 1, 0) == 1;
  }

 private:
  std::filesystem::path path_;
  io::Descriptor master_;
  io::Descriptor slave_;
};

class CableTest : public DaemonLoop {
 protected:
  CableTest() { config_.nodes[0].path = folder_ / "tty-1"; }

  void poll_at(double t_s) {
    now_s_ = CircleDrive::kBegin_s + t_s;
    daemon_->poll();
  }
  void send_odometry(int sample) {
    const double t_s = 0.01 * sample;
    robot_.send(CircleDrive::odometry(t_s, sample == 0));
    poll_at(t_s + 0.001);
    stream_ += client_->receive();
    if (stream_.size() > 100'000) stream_.erase(0, stream_.rfind('\n', stream_.size() - 20'000) + 1);
  }
  // Until the daemon has read the bytes.
  void send_report(const Cable& cable, double t_s, std::span<const std::uint8_t> bytes) {
    cable.send(bytes);
    for (int i = 0; i < 1'000'000 && cable.has_unread(); ++i) poll_at(t_s);
    ASSERT_FALSE(cable.has_unread());
  }

  // The last pose is TRACKING and right.
  void expect_tracking() const {
    const std::string poses = poses_of(stream_);
    const std::size_t begin = poses.rfind('\n', poses.size() - 2) + 1;
    const json pose = json::parse(poses.substr(begin));
    EXPECT_EQ(pose.at("state"), "TRACKING") << pose;
    const auto truth = CircleDrive::truth(pose.at("t_s"));
    EXPECT_LT(std::hypot(pose.at("x_m").get<double>() - truth.x_m, pose.at("y_m").get<double>() - truth.y_m),
              0.1);
  }
  [[nodiscard]] Labels link(const std::string& name) const { return {{"link", (folder_ / name).string()}}; }

  std::optional<TcpClient> client_;
  std::string stream_;  // its end
};

std::size_t open_descriptors() {
  const std::filesystem::directory_iterator all("/proc/self/fd");
  return static_cast<std::size_t>(std::distance(begin(all), end(all)));
}

// Each time in the middle of a frame. That frame is lost, all others arrive.
TEST_F(CableTest, PulledInMidFrameAndPutBackAThousandTimes) {
  constexpr int kPulls = 1000;
  constexpr int kSettled = 100;  // pulls after which nothing grows
  Cable cable(config_.nodes[0].path);
  start();
  client_.emplace(port("pose stream"));
  const std::string log = log_;
  int number = 0;
  int pulls = 0;
  std::size_t descriptors = 0;
  std::size_t heap_bytes = 0;
  for (int sample = 0; sample < 40 * (kPulls + 1); ++sample) {
    send_odometry(sample);
    // A report each 0.1 s: two whole ones, one that is cut, none while the cable is out.
    const int period = sample / 10 % 4;
    if (sample % 10 != 3 || period == 3) continue;
    const double t_s = 0.01 * sample;
    const std::vector<std::uint8_t> frame = drive_.report(t_s, number++);
    const bool is_cut = period == 2 && pulls < kPulls;
    send_report(cable, t_s + 0.004, std::span(frame).first(is_cut ? frame.size() / 2 : frame.size()));
    if (!is_cut) continue;
    if (pulls == kSettled) {
      descriptors = open_descriptors();
      heap_bytes = ::mallinfo2().uordblks;
    }
    cable.pull();
    poll_at(t_s + 0.004);
    cable.plug_in();
    log_.clear();
    ++pulls;
  }
  EXPECT_EQ(open_descriptors(), descriptors);
  // A search for mistakes that is still running holds a copy of the measurements.
  const auto has_grown = [&] { return ::mallinfo2().uordblks >= heap_bytes + 100'000; };
  for (int i = 0; i < 1'000 && has_grown(); ++i) {
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
    daemon_->poll();
  }
  EXPECT_FALSE(has_grown());
  expect_tracking();
  log_ = log;
  const auto all = metrics();
  const Labels of = link("tty-1");
  EXPECT_EQ(value(all, "groma_link_lost_total", of), kPulls);
  EXPECT_EQ(value(all, "groma_link_opened_total", of), kPulls + 1);
  EXPECT_EQ(value(all, "groma_node_reports_total", of), number - kPulls);
  EXPECT_EQ(value(all, "groma_node_reports_lost_total", of), kPulls);
  EXPECT_EQ(value(all, "groma_node_ranges_total", of), 6 * (number - kPulls));
}

// Each tag's reports come from the other port from then on.
TEST_F(CableTest, OfTwoTagsExchanged) {
  constexpr double kAhead_m = 0.6;
  config_.nodes.push_back(config_.nodes[0]);
  config_.nodes[1].path = folder_ / "tty-2";
  config_.tags.push_back({2, {kAhead_m, 0.0, CircleDrive::kTagHeight_m}});
  calibration_ = model::surveyed_calibration(drive_.anchors, config_.tags, config_.range, 0.02);
  Cable first(config_.nodes[0].path);
  Cable second(config_.nodes[1].path);
  start();
  client_.emplace(port("pose stream"));
  constexpr int kSwaps = 20;
  int reports = 0;
  for (int sample = 0; sample < 200 * (kSwaps + 1); ++sample) {
    send_odometry(sample);
    if (sample % 200 == 199 && sample < 200 * kSwaps) {
      expect_tracking();
      first.pull();
      second.pull();
      poll_at(0.01 * sample + 0.002);
      Cable::put_back_exchanged(first, second);
    }
    // None while the cables are out.
    if (sample % 10 != 3 || sample % 200 < 20) continue;
    const double t_s = 0.01 * sample;
    send_report(first, t_s + 0.004, drive_.report(t_s, reports, 1));
    send_report(second, t_s + 0.004, drive_.report(t_s, reports, 2, kAhead_m));
    ++reports;
  }
  expect_tracking();
  const auto all = metrics();
  double arrived = 0.0;
  for (const std::string name : {"tty-1", "tty-2"}) {
    EXPECT_EQ(value(all, "groma_link_lost_total", link(name)), kSwaps);
    EXPECT_EQ(value(all, "groma_node_reports_lost_total", link(name)), 0.0);
    arrived += value(all, "groma_node_reports_total", link(name));
  }
  EXPECT_EQ(arrived, 2.0 * reports);
  EXPECT_GT(value(all, "groma_filter_ranges_total", {{"outcome", "used"}}), 0.7 * 12.0 * reports);
}

}  // namespace
}  // namespace groma::daemon
