#include "test/latency/measurement.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sched.h>
#include <sys/mman.h>

#include <algorithm>
#include <atomic>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string_view>
#include <thread>
#include <utility>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/descriptor.hpp"
#include "host/io/exit_code.hpp"
#include "test/host/daemon/gromad_process.hpp"
#include "test/host/daemon/temporary_folder.hpp"
#include "test/latency/allocation_counter.hpp"
#include "test/latency/load_generator.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::latency {
namespace {

using daemon::test::Gromad;
using nlohmann::json;

constexpr double kPatience_s = 30.0;

// Counts of allocations in memory that a program shares.
class SharedCounts {
 public:
  explicit SharedCounts(const std::filesystem::path& path) {
    std::ofstream(path) << std::string(sizeof(AllocationCounts), '\0');
    const io::Descriptor file(::open(path.c_str(), O_RDWR | O_CLOEXEC));
    memory_ = ::mmap(nullptr, sizeof(AllocationCounts), PROT_READ, MAP_SHARED, file.get(), 0);
    if (memory_ == MAP_FAILED) throw std::runtime_error("mmap");
  }
  ~SharedCounts() { ::munmap(memory_, sizeof(AllocationCounts)); }
  SharedCounts(const SharedCounts&) = delete;
  SharedCounts& operator=(const SharedCounts&) = delete;

  [[nodiscard]] const AllocationCounts& get() const { return *static_cast<AllocationCounts*>(memory_); }

 private:
  void* memory_;
};

// Sleeps from time to time, and notes how late it wakes up.
class IdleTimer {
 public:
  IdleTimer() : thread_([this] { run(); }) {}
  ~IdleTimer() { static_cast<void>(stop()); }
  IdleTimer(const IdleTimer&) = delete;
  IdleTimer& operator=(const IdleTimer&) = delete;

  [[nodiscard]] std::vector<double> stop() {
    ending_ = true;
    if (thread_.joinable()) thread_.join();
    return std::move(delays_s_);
  }

 private:
  // About as often as odometry comes, but never long in step with it.
  static constexpr std::int64_t kPeriod_ns = 9'700'000;

  void run() {
    delays_s_.reserve(100'000);
    for (std::int64_t at_ns = now_ns() + kPeriod_ns; !ending_; at_ns += kPeriod_ns) {
      sleep_until_ns(at_ns);
      delays_s_.push_back(1e-9 * static_cast<double>(now_ns() - at_ns));
    }
  }

  std::atomic<bool> ending_{false};
  std::vector<double> delays_s_;
  std::thread thread_;
};

// A client of the pose stream with a thread of its own.
class PoseClient {
 public:
  PoseClient(std::uint16_t port, std::size_t samples)
      : client_(port), arrived_ns_(samples, kNever), tracking_(samples, false), thread_([this] { run(); }) {}
  ~PoseClient() { stop(); }
  PoseClient(const PoseClient&) = delete;
  PoseClient& operator=(const PoseClient&) = delete;

  static constexpr std::int64_t kNever = std::numeric_limits<std::int64_t>::max();

  void stop() {
    ending_ = true;
    if (thread_.joinable()) thread_.join();
  }
  // After stop(): of each odometry sample's pose.
  [[nodiscard]] const std::vector<std::int64_t>& arrived_ns() const { return arrived_ns_; }
  [[nodiscard]] bool tracking(std::size_t sample) const { return tracking_.at(sample); }
  [[nodiscard]] std::uint64_t out_of_order() const { return out_of_order_; }
  [[nodiscard]] json status() const { return json::parse(status_); }

 private:
  void run() {
    std::string text;
    while (!ending_) {
      const std::string received = client_.await(std::chrono::milliseconds(100));
      const std::int64_t at_ns = now_ns();
      text += received;
      std::size_t begin = 0;
      for (std::size_t end = 0; (end = text.find('\n', begin)) != std::string::npos; begin = end + 1)
        take(std::string_view(text).substr(begin, end - begin), at_ns);
      text.erase(0, begin);
    }
  }

  void take(std::string_view line, std::int64_t at_ns) {
    if (line.starts_with(R"({"class":"STATUS")")) status_ = line;
    constexpr std::string_view kPose = R"({"class":"POSE","t_s":)";
    if (!line.starts_with(kPose)) return;
    double t_s = 0.0;
    std::from_chars(line.data() + kPose.size(), line.data() + line.size(), t_s);
    const double sample = std::round((t_s - LoadGenerator::kRobotOrigin_s) * LoadGenerator::kOdometry_hz);
    if (!(sample > last_ && sample < static_cast<double>(arrived_ns_.size()))) {
      ++out_of_order_;
      return;
    }
    last_ = sample;
    const auto i = static_cast<std::size_t>(sample);
    arrived_ns_[i] = at_ns;
    tracking_[i] = line.find(R"("state":"TRACKING")") != std::string_view::npos;
  }

  groma::test::TcpClient client_;
  std::vector<std::int64_t> arrived_ns_;
  std::vector<bool> tracking_;
  double last_ = -1.0;
  std::uint64_t out_of_order_ = 0;
  std::string status_;
  std::atomic<bool> ending_{false};
  std::thread thread_;
};

double cpu_s(pid_t pid) {
  clockid_t clock{};
  timespec time{};
  if (::clock_getcpuclockid(pid, &clock) != 0 || ::clock_gettime(clock, &time) != 0) return std::nan("");
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

double resident_mib(pid_t pid) {
  std::ifstream file(fmt::format("/proc/{}/status", pid));
  for (std::string word; file >> word;) {
    double kib = 0.0;
    if (word == "VmRSS:" && file >> kib) return kib / 1024.0;
  }
  return std::nan("");
}

std::unique_ptr<Gromad> start_gromad(const groma::test::TemporaryFolder& folder,
                                     const LoadGenerator& generator, const std::string& more_config) {
  folder.write("calibration.yaml", io::format_calibration(generator.calibration()));
  const std::filesystem::path config = folder.write(
      "gromad.yaml", LoadGenerator::config() + "pose_stream: {port: 0}\nlog: drive.glog\n" + more_config);
  ::setenv("LD_PRELOAD", GROMA_ALLOCATION_COUNTER, 1);
  ::setenv(kCountsVariable, (folder / "counts").c_str(), 1);
  const std::vector<std::string> arguments{"--config", config.string()};
  auto gromad = std::make_unique<Gromad>(arguments);
  ::unsetenv("LD_PRELOAD");
  return gromad;
}

std::uint16_t await_port(Gromad& gromad) {
  const std::int64_t end_ns = now_ns() + std::llround(1e9 * kPatience_s);
  while (now_ns() < end_ns && gromad.running()) {
    if (const auto port = daemon::test::pose_stream_port(gromad)) return *port;
    sleep_until_ns(now_ns() + 5'000'000);
  }
  throw std::runtime_error("gromad does not start: " + gromad.log());
}

// What gromad has used up to a moment.
struct Usage {
  std::int64_t at_ns = 0;
  double cpu_s = 0.0;
  std::uint64_t main_thread = 0;
  std::uint64_t other_threads = 0;
  std::uint64_t poses = 0;
  std::uint64_t in_poses = 0;
};

Usage usage(const Gromad& gromad, const AllocationCounts& counts) {
  return {now_ns(),     cpu_s(gromad.pid()), counts.main_thread, counts.other_threads,
          counts.poses, counts.in_poses};
}

void note_usage(const Usage& begin, const Usage& end, Measurement& out) {
  const double s = 1e-9 * static_cast<double>(end.at_ns - begin.at_ns);
  out.cpu_share = (end.cpu_s - begin.cpu_s) / s;
  out.poses = end.poses - begin.poses;
  out.allocations_in_poses = end.in_poses - begin.in_poses;
  const std::uint64_t loop = end.main_thread - begin.main_thread - out.allocations_in_poses;
  out.other_allocations_per_s = static_cast<double>(loop) / s;
  out.thread_allocations_per_s = static_cast<double>(end.other_threads - begin.other_threads) / s;
}

void note_load(const LoadGenerator& generator, const json& status, Measurement& out) {
  out.reports_lost = status.at("frames_lost");
  out.dropped = status.at("dropped");
  out.ranges_taken = status.at("ranges");
  out.odometry_taken = status.at("odometry");
  out.ranges_sent = generator.reports() * LoadGenerator::kAnchors;
  out.overflows = generator.overflows();
  out.write_delays_s = generator.write_delays_s();
}

void note_poses(const LoadGenerator& generator, const PoseClient& client, Measurement& out) {
  const std::vector<std::int64_t>& written_ns = generator.odometry_written_ns();
  out.odometry_written_ns = written_ns;
  const std::vector<std::int64_t>& arrived_ns = client.arrived_ns();
  const auto counted = static_cast<std::size_t>(kWarmUp_s * LoadGenerator::kOdometry_hz);
  bool begun = false;
  for (std::size_t i = 0; i < written_ns.size(); ++i) {
    const bool has_pose = arrived_ns[i] != PoseClient::kNever;
    begun = begun || has_pose;
    // Without any pose each is missing.
    if (!has_pose && (begun || i >= counted)) ++out.poses_missing;
    if (!has_pose || i < counted) continue;
    out.pose_latencies_s.push_back(1e-9 * static_cast<double>(arrived_ns[i] - written_ns[i]));
    if (!client.tracking(i)) ++out.poses_not_tracking;
  }
  out.poses_out_of_order = client.out_of_order();
}

void note_recording(const std::filesystem::path& path, Measurement& out) {
  const io::Dataset recorded = io::read_dataset(path);
  out.ranges_recorded = recorded.ranges.size();
  out.odometry_recorded = recorded.odometry.size();
}

}  // namespace

double percentile(std::vector<double> values, double share) {
  if (values.empty()) return std::nan("");
  const auto rank = static_cast<std::size_t>(std::ceil(share * static_cast<double>(values.size())));
  const auto at = values.begin() + static_cast<std::ptrdiff_t>(std::max<std::size_t>(rank, 1) - 1);
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

Measurement measure(double duration_s, const std::string& more_config,
                    const std::function<void(std::uint16_t port)>& on_web) {
  const groma::test::TemporaryFolder folder;
  LoadGenerator generator(folder.path(), duration_s);
  const SharedCounts counts(folder / "counts");
  const std::unique_ptr<Gromad> gromad = start_gromad(folder, generator, more_config);
  PoseClient client(await_port(*gromad), static_cast<std::size_t>(duration_s * LoadGenerator::kOdometry_hz));
  if (!generator.await_reader(kPatience_s))
    throw std::runtime_error("gromad reads nothing: " + gromad->log());
  if (const auto web = daemon::test::port_in_log(*gromad, "web server"); web && on_web) on_web(*web);

  Measurement out;
  out.duration_s = duration_s;
  out.same_scheduling_class = ::sched_getscheduler(gromad->pid()) == ::sched_getscheduler(0);
  out.early_s = std::min(120.0, 0.4 * duration_s);
  IdleTimer timer;
  const std::int64_t begin_ns = now_ns();
  const auto wait_until = [&](double time_s) {
    const std::int64_t end_ns = begin_ns + std::llround(1e9 * time_s);
    while (now_ns() < end_ns) {
      if (!gromad->running()) throw std::runtime_error("gromad has ended: " + gromad->log());
      gromad->log();
      sleep_until_ns(std::min(end_ns, now_ns() + 500'000'000));
    }
  };
  std::thread load([&] { generator.run(); });
  std::optional<Usage> begin;
  try {
    wait_until(kWarmUp_s);
    begin = usage(*gromad, counts.get());
    wait_until(out.early_s);
    out.early_mib = resident_mib(gromad->pid());
    wait_until(duration_s);
  } catch (...) {
    generator.stop();
    load.join();
    throw;
  }
  load.join();
  note_usage(*begin, usage(*gromad, counts.get()), out);
  out.timer_delays_s = timer.stop();
  // Until all has been passed on, and a STATUS line has counted it.
  wait_until(duration_s + 2.5);
  out.late_mib = resident_mib(gromad->pid());
  client.stop();
  note_load(generator, client.status(), out);
  note_poses(generator, client, out);
  gromad->terminate();
  out.exit_code = gromad->exit_code().value_or(-1);
  out.log = gromad->log();
  note_recording(folder / "drive.glog", out);
  return out;
}

std::vector<Row> judge(const Measurement& of) {
  std::vector<Row> rows;
  const auto at_most = [&](std::string what, double value, double bound, std::string_view unit, int digits,
                           bool of_times) {
    rows.push_back({std::move(what), fmt::format("{:.{}f} {}", value, digits, unit),
                    fmt::format("{:.{}f} {}", bound, digits, unit), value <= bound, of_times});
  };
  const auto equal = [&](std::string what, std::uint64_t value, std::uint64_t expected,
                         bool of_times = false) {
    rows.push_back(
        {std::move(what), std::to_string(value), std::to_string(expected), value == expected, of_times});
  };
  const auto state = [&](std::string what, double value, std::string_view unit) {
    rows.push_back({std::move(what), fmt::format("{:.3f} {}", value, unit), ""});
  };
  const double timer_ms = 1e3 * percentile(of.timer_delays_s, 0.999);
  state("wake-up delay of an idle timer thread, p99.9", timer_ms, "ms");
  state("delay of the load's writes, p99.9", 1e3 * percentile(of.write_delays_s, 0.999), "ms");
  state("odometry sample to POSE, p50", 1e3 * percentile(of.pose_latencies_s, 0.5), "ms");
  state("odometry sample to POSE, p99", 1e3 * percentile(of.pose_latencies_s, 0.99), "ms");
  at_most("odometry sample to POSE, p99.9", 1e3 * percentile(of.pose_latencies_s, 0.999), timer_ms + 1.0,
          "ms", 3, true);
  state("odometry sample to POSE, longest", 1e3 * percentile(of.pose_latencies_s, 1.0), "ms");
  at_most("CPU time of gromad", 100.0 * of.cpu_share, 15.0, "% of a core", 1, true);
  state("resident memory at the end", of.late_mib, "MiB");
  at_most(fmt::format("more than that after {:.0f} s", of.early_s), of.late_mib - of.early_mib, 1.0, "MiB", 3,
          true);
  equal("bytes that did not fit a port", of.overflows, 0);
  equal("reports lost", of.reports_lost, 0);
  equal("ranges taken", of.ranges_taken, of.ranges_sent, true);
  equal("ranges in the capture", of.ranges_recorded, of.ranges_taken);
  equal("odometry samples in the capture", of.odometry_recorded, of.odometry_taken);
  equal("odometry samples without a POSE", of.poses_missing, 0, true);
  equal("measurements dropped", of.dropped, 0, true);
  const std::uint64_t gone = of.ranges_sent - of.ranges_taken + of.poses_missing;
  equal("measurements gone that are not counted as dropped", gone - std::min(gone, of.dropped), 0);
  equal("POSE lines out of order", of.poses_out_of_order, 0);
  equal("POSE lines that are not TRACKING", of.poses_not_tracking, 0, true);
  equal("allocations from a sample's bytes to its POSE sent", of.allocations_in_poses, 0);
  state("other allocations of the loop's thread", of.other_allocations_per_s, "a second");
  state("allocations of other threads", of.thread_allocations_per_s, "a second");
  equal("gromad and the idle thread are of one scheduling class", of.same_scheduling_class ? 1 : 0, 1);
  equal("exit code of gromad", static_cast<std::uint64_t>(of.exit_code), io::kGood);
  return rows;
}

std::string format_table(const std::vector<Row>& rows) {
  std::string text = fmt::format("{:<56}{:>20}{:>20}  verdict\n", "", "measured", "bound");
  for (const Row& row : rows) {
    text += fmt::format("{:<56}{:>20}{:>20}  {}\n", row.what, row.value, row.bound.empty() ? "-" : row.bound,
                        row.bound.empty() ? "" : (row.met ? "met" : "MISSED"));
  }
  return text;
}

}  // namespace groma::latency
