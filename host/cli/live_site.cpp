#include "host/cli/live_site.hpp"

#include <fmt/format.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <string>
#include <string_view>
#include <thread>
#include <utility>

#include "host/cli/demo_report.hpp"
#include "host/cli/stop_signal.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/simulation/drive_dataset.hpp"

namespace groma::cli {
namespace {

constexpr double kHours = 12.0;
// The first line of a configuration that may be overwritten.
constexpr std::string_view kMark = "# Written again at each start of the simulated site.\n";

// gromad beside this program.
std::filesystem::path gromad() {
  std::filesystem::path path = std::filesystem::read_symlink("/proc/self/exe").parent_path() / "gromad";
  if (!std::filesystem::exists(path))
    throw io::DeviceError({path}, "does not exist", "build or install gromad beside groma");
  return path;
}

// A running gromad, which is stopped at the end. If it ends by itself, so does this program's work: it gets
// SIGTERM as if the user had sent it.
class Gromad {
 public:
  explicit Gromad(const std::filesystem::path& configuration) {
    const std::string program = gromad().string();
    const std::string file = configuration.string();
    pid_ = ::fork();
    if (pid_ == 0) {
      ::prctl(PR_SET_PDEATHSIG, SIGTERM);  // also if this program is killed
      ::execl(program.c_str(), "gromad", "--config", file.c_str(), nullptr);
      ::_exit(io::kUnavailable);
    }
    if (pid_ < 0) throw io::DeviceError({program}, "cannot be started", "end other programs");
    watch_ = std::thread([this] {
      siginfo_t info{};
      ::waitid(P_PID, static_cast<id_t>(pid_), &info, WEXITED | WNOWAIT);
      has_failed_ = info.si_code != CLD_EXITED || info.si_status != io::kGood;
      has_ended_ = true;
      if (!is_stopping_) ::kill(::getpid(), SIGTERM);
    });
  }
  ~Gromad() {
    is_stopping_ = true;
    if (!has_ended_) ::kill(pid_, SIGTERM);
    watch_.join();
    ::waitpid(pid_, nullptr, 0);
  }
  Gromad(const Gromad&) = delete;
  Gromad& operator=(const Gromad&) = delete;

  // It has ended, and not because it was asked to: Ctrl-C asks both programs.
  [[nodiscard]] bool has_failed() const noexcept { return has_failed_; }

 private:
  pid_t pid_ = 0;
  std::atomic<bool> has_failed_ = false;
  std::atomic<bool> has_ended_ = false;
  std::atomic<bool> is_stopping_ = false;
  std::thread watch_;
};

std::string walls_text(const sim::Scenario& scenario) {
  const report::Walls walls = walls_of(scenario);
  std::string text = "x0_m,y0_m,x1_m,y1_m\n";
  for (const auto* kind : {&walls.opaque, &walls.others}) {
    for (const auto& [from_m, to_m] : *kind)
      text += fmt::format("{},{},{},{}\n", from_m.x(), from_m.y(), to_m.x(), to_m.y());
  }
  return text;
}

void refuse_foreign(const std::filesystem::path& path) {
  if (!std::filesystem::exists(path)) return;
  std::string begin(kMark.size(), '\0');
  std::ifstream(path).read(begin.data(), static_cast<std::streamsize>(begin.size()));
  if (begin != kMark)
    throw io::PathError({path}, "is not from an earlier --live", "choose another folder, or move the file");
}

// Site and robot as a data set describes them, with the keys that only gromad has in place of its name.
std::string configuration(const sim::Scenario& scenario, const simulation::SiteServer& site, double speed,
                          std::uint16_t port, const std::filesystem::path& folder) {
  std::string text;
  for (const io::DescriptionFile& file : io::describe(simulation::empty_dataset(scenario, "live"))) {
    if (file.name == "dataset.yaml") {
      text = file.text;
    } else {
      io::write_file(folder / file.name, file.text);
    }
  }
  std::string out(kMark);
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = std::min(text.find('\n', begin), text.size() - 1) + 1;
    const std::string line = text.substr(begin, end - begin);
    if (!line.starts_with("name:") && !line.starts_with("origin:")) out += line;
    begin = end;
  }
  out += "nodes:\n";
  for (const std::filesystem::path& path : site.ports())
    out += fmt::format("  - {{path: {}}}\n", path.filename().string());
  out += "tags:\n";
  for (const model::Tag& tag : scenario.tags) {
    out += fmt::format("  - {{id: {}, lever_arm_m: [{}, {}, {}]}}\n", tag.id, tag.lever_arm_m.x(),
                       tag.lever_arm_m.y(), tag.lever_arm_m.z());
  }
  out += fmt::format(
      "robot_socket: robot.sock\ncalibration: {{learn: true, output: calibration.yaml}}\n"
      "pose_stream: {{port: 0}}\nweb: {{port: {}, walls: walls.csv, simulated: true}}\nspeed: {}\n",
      port, speed);
  return out;
}

}  // namespace

sim::Scenario endless(sim::Scenario scenario) {
  // A drive takes a minute at least.
  constexpr auto kRepetitions = static_cast<std::size_t>(60.0 * kHours);
  const sim::DriveLeg last = scenario.drives.back();
  if (!scenario.path.loop) scenario.drives.insert(scenario.drives.end(), kRepetitions, last);
  return scenario;
}

int report_behind(const simulation::SiteServer& server) {
  if (!(server.behind_s() > 0.0)) return io::kGood;
  complain(fmt::format(
      "this machine was too slow: {:.1f} s behind after {:.1f} simulated seconds; give a lower --speed",
      server.behind_s(), server.now_s()));
  return io::kDoneWithWarnings;
}

int run_live(const sim::Scenario& scenario, const simulation::SiteServer::Options& options,
             std::uint16_t port) {
  const volatile std::sig_atomic_t& stop = stop_on_signals();
  const std::filesystem::path& folder = options.folder;
  refuse_foreign(folder / "gromad.yaml");
  simulation::SiteServer server(scenario, options);
  io::write_file(folder / "walls.csv", walls_text(scenario));
  io::write_file(folder / "gromad.yaml", configuration(scenario, server, options.speed, port, folder));
  Gromad daemon(folder / "gromad.yaml");
  say(fmt::format("running {}, with gromad --config {}\nlive page: http://127.0.0.1:{}\nend it with Ctrl-C\n",
                  scenario.name, (folder / "gromad.yaml").string(), port));
  flush_output();
  stop_heartbeat();
  server.run(stop);
  if (daemon.has_failed())
    throw io::DeviceError({folder / "gromad.yaml"}, "gromad has ended", "see above for what it logged");
  return report_behind(server);
}

}  // namespace groma::cli
