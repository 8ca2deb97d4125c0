// Checks of what the configuration names on this computer: files, CAN buses, servers, the clock.
#include <fmt/format.h>
#include <sys/statvfs.h>
#include <sys/timex.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>
#include <set>
#include <system_error>
#include <utility>

#include "host/doctor/can_state.hpp"
#include "host/doctor/doctor.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/io/version.hpp"
#include "host/link/can_path.hpp"

namespace groma::doctor {
namespace {

constexpr double kMebi = 1024.0 * 1024.0;
constexpr double kFull_bytes = kMebi;  // less than this is full
constexpr double kAlmostFull_bytes = 100.0 * kMebi;

std::string shown_bytes(double bytes) {
  return bytes < 1024.0 * kMebi ? fmt::format("{:.1f} MiB", bytes / kMebi)
                                : fmt::format("{:.1f} GiB", bytes / kMebi / 1024.0);
}

std::string fault_of(const std::exception_ptr& error) {
  try {
    std::rethrow_exception(error);
  } catch (const io::PermissionError&) {
    return "no-permission";
  } catch (const std::exception&) {
    return "bad-configuration";
  }
}

void check_room(const std::filesystem::path& folder, Check& check) {
  struct statvfs disk {};
  if (::statvfs(folder.c_str(), &disk) != 0) {
    check.facts.push_back(fmt::format("{}: {}", folder.string(), std::generic_category().message(errno)));
    check.fail(Verdict::kBad, errno == EACCES ? "no-permission" : "no-folder",
               fmt::format("make the folder {}, and let gromad's user write there", folder.string()));
    return;
  }
  const double free = static_cast<double>(disk.f_bavail) * static_cast<double>(disk.f_frsize);
  const double size = static_cast<double>(disk.f_blocks) * static_cast<double>(disk.f_frsize);
  check.facts.push_back(fmt::format("{} of {} are free", shown_bytes(free), shown_bytes(size)));
  const bool without_files = disk.f_files > 0 && disk.f_favail == 0;
  if (free < kFull_bytes || without_files) {
    check.fail(
        Verdict::kBad, "disk-full",
        fmt::format("make room on the disk of {}; nothing can be recorded or saved there", folder.string()));
  } else if (free < kAlmostFull_bytes && free < 0.1 * size) {
    check.fail(Verdict::kWarning, "disk-full",
               fmt::format("make room on the disk of {} before it is full", folder.string()));
  }
}

Check check_file(const std::string& key, const std::filesystem::path& path) {
  Check check{.kind = "output", .name = fmt::format("{} {}", key, path.string())};
  const std::filesystem::path folder = path.has_parent_path() ? path.parent_path() : ".";
  check_room(folder, check);
  std::error_code ignored;
  const bool exists = std::filesystem::exists(path, ignored);
  const std::filesystem::path& written = exists && key == "log" ? path : folder;
  if (::access(written.c_str(), W_OK) != 0) {
    check.facts.push_back(fmt::format("{}: {}", written.string(), std::generic_category().message(errno)));
    check.fail(Verdict::kBad, "no-permission",
               fmt::format("let gromad's user write to {}, or name another place", written.string()));
  }
  return check;
}

void judge_verdict(const model::Calibration& calibration, Check& check) {
  std::string weak;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (anchor.verdict == model::AnchorVerdict::kOk) continue;
    weak += fmt::format("{}{} {}", weak.empty() ? "" : ", ", anchor.id, io::word(anchor.verdict));
  }
  check.facts.push_back(fmt::format("verdict {}, {} anchors{}{}", io::word(calibration.verdict),
                                    calibration.anchors.size(), weak.empty() ? "" : ": ", weak));
  if (calibration.verdict == model::Verdict::kUnusable) {
    check.fail(Verdict::kBad, "no-calibration", "drive and calibrate again: this calibration is not usable");
  } else if (calibration.verdict == model::Verdict::kWarnings) {
    check.fail(Verdict::kWarning, "weak-calibration",
               "usable; to improve it, drive as the advice of its anchors says, and calibrate again");
  }
}

std::string bad_can_remedy(const std::string& interface, bool is_there) {
  if (!is_there)
    return fmt::format("plug the adapter of {} in, and load its driver: 'ip link show'", interface);
  return fmt::format("sudo ip link set {} up type can bitrate 1000000", interface);
}

}  // namespace

std::vector<Check> check_configuration(const daemon::ConfigReading& reading) {
  Check check{.kind = "configuration", .name = reading.config.path.string()};
  for (const daemon::ConfigProblem& problem : reading.problems) {
    check.facts.push_back(problem.text);
    check.fail(Verdict::kBad, fault_of(problem.error),
               "correct what the lines above name, then start gromad");
  }
  if (reading.problems.empty()) {
    check.facts.push_back(
        fmt::format("{} nodes, {} tags", reading.config.nodes.size(), reading.config.tags.size()));
  }
  if (::geteuid() == 0) {
    check.facts.emplace_back(
        "examined as root, who may do everything: 'sudo -u groma groma doctor' shows "
        "what gromad's user may not do");
  }
  return {check};
}

Check check_calibration(const daemon::Config& config, std::set<model::NodeId>& anchors) {
  const daemon::CalibrationSource& source = config.calibration;
  Check check{.kind = "calibration", .name = source.file ? source.file->string() : ""};
  if (!source.file) {
    check.facts.push_back(source.learn
                              ? std::string("anchors are calibrated while driving")
                              : fmt::format("anchors are calibrated from a drive of {} s", source.drive_s));
    return check;
  }
  std::error_code ignored;
  if (source.learn && source.file == source.output && !std::filesystem::exists(*source.file, ignored)) {
    check.facts.emplace_back("does not exist yet; anchors are calibrated while driving");
    return check;
  }
  const auto fail = [&](const io::Error& error, std::string_view fault, std::string_view remedy) {
    check.facts.emplace_back(error.what());
    check.fail(Verdict::kBad, fault, remedy);
  };
  try {
    const model::Calibration calibration = io::read_calibration(*source.file);
    for (const model::AnchorCalibration& anchor : calibration.anchors) anchors.insert(anchor.id);
    judge_verdict(calibration, check);
  } catch (const io::PermissionError& error) {
    fail(error, "no-permission", "let gromad's user read the file");
  } catch (const io::ConfigError& error) {
    fail(error, "bad-calibration", "restore the file, or calibrate again");
  } catch (const io::Error& error) {
    fail(error, "no-calibration",
         "copy the site's calibration to this path, name it in 'calibration', or calibrate: 'groma "
         "calibrate', "
         "or 'calibration: {drive_s: 120, ...}'");
  }
  return check;
}

std::vector<Check> check_files(const daemon::Config& config) {
  std::vector<Check> checks;
  if (config.calibration.output) checks.push_back(check_file("calibration", *config.calibration.output));
  if (config.log) checks.push_back(check_file("log", *config.log));
  if (config.last_pose) checks.push_back(check_file("last_pose", *config.last_pose));
  return checks;
}

std::vector<Check> check_can_buses(const daemon::Config& config) {
  std::set<std::string> interfaces;
  for (const daemon::NodeLink& node : config.nodes) {
    if (const auto can = link::parse_can_path(node.path.string())) interfaces.insert(can->interface);
  }
  if (config.robot_can) interfaces.insert(config.robot_can->interface);
  std::vector<Check> checks;
  for (const std::string& interface : interfaces) {
    Check check{.kind = "can", .name = interface};
    const auto state = read_can_state(interface);
    if (!state) {
      check.facts.emplace_back("there is no such interface");
      check.fail(Verdict::kBad, "can-down", bad_can_remedy(interface, false));
    } else {
      check.facts.push_back(fmt::format("{}{}{}", state->is_up ? "up" : "down",
                                        state->controller.empty() ? "" : ", controller ", state->controller));
      if (state->bit_per_s > 0) check.facts.push_back(fmt::format("{} bit/s", state->bit_per_s));
      if (!state->is_up) check.fail(Verdict::kBad, "can-down", bad_can_remedy(interface, true));
      if (state->controller == "bus-off") {
        check.fail(Verdict::kBad, "can-down",
                   fmt::format("check cable, termination and bit rate; then 'sudo ip link set {} type can "
                               "restart', or for always: '... restart-ms 100'",
                               interface));
      } else if (state->controller == "error-passive") {
        check.fail(Verdict::kWarning, "can-errors", "check cable, termination and bit rate of the bus");
      }
    }
    checks.push_back(check);
  }
  return checks;
}

Check check_computer_clock() {
  Check check{.kind = "clock", .name = "this computer"};
  timex clock{};
  const bool is_synchronized = ::adjtimex(&clock) >= 0 && (clock.status & STA_UNSYNC) == 0;
  check.facts.emplace_back(is_synchronized ? "synchronized to a time server"
                                           : "not synchronized to a time server; gromad does not need it");
  return check;
}

std::vector<Check> check_servers(const daemon::Config& config, const Observation& observation) {
  Check stream{.kind = "gromad", .name = address_of(config.pose_stream)};
  const bool runs = observation.error.empty();
  if (config.pose_stream.port == 0) {
    stream.facts.emplace_back("pose_stream has port 0, so that it serves a different port each time");
    stream.fail(Verdict::kWarning, "not-running", "name a port in 'pose_stream'; then doctor finds gromad");
  } else if (!runs) {
    stream.facts.push_back(observation.error);
    const bool other = observation.is_served;
    stream.fail(
        other ? Verdict::kBad : Verdict::kWarning, other ? "no-answer" : "not-running",
        other ? "'ss -lptn' shows which program listens there; stop it, or choose another port"
              : "start it: 'sudo systemctl start gromad'; if it does not stay, 'journalctl -u gromad -n "
                "50' says why");
  } else {
    const std::string version = observation.version.value("version", "");
    stream.facts.push_back(fmt::format("version {}, {} poses in {:.1f} s", version, observation.poses,
                                       observation.duration_s()));
    if (version != io::program_version()) {
      stream.fail(Verdict::kWarning, "other-version",
                  fmt::format("this is version {}: restart gromad after an update", io::program_version()));
    }
  }
  if (!config.web || config.web->endpoint.port == 0 || !runs) return {stream};
  Check web{.kind = "output", .name = fmt::format("web {}", address_of(config.web->endpoint))};
  if (config.web->tls) {
    web.facts.emplace_back("over TLS, which doctor does not check: open it in a browser");
    return {stream, web};
  }
  try {
    if (read_metrics(*config.web).empty()) {
      web.facts.emplace_back("/metrics does not answer");
      web.fail(Verdict::kBad, "no-answer", "restart gromad; 'ss -lptn' shows which program listens there");
    } else {
      web.facts.emplace_back("/metrics answers");
    }
  } catch (const io::Error& error) {
    web.facts.emplace_back(error.what());
    web.fail(Verdict::kWarning, "token",
             "run doctor as the user that gromad runs as: sudo -u groma groma doctor");
  }
  return {stream, web};
}

}  // namespace groma::doctor
