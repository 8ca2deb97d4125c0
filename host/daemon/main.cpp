// gromad: reads the tags' serial ports and the robot's odometry, and serves poses.
#include <fmt/format.h>
#include <sys/signalfd.h>

#include <csignal>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/daemon/config.hpp"
#include "host/daemon/daemon.hpp"
#include "host/daemon/memory_lock.hpp"
#include "host/daemon/reload.hpp"
#include "host/daemon/service_manager.hpp"
#include "host/help/help.hpp"
#include "host/io/descriptor.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

void log(std::string_view text) {
  // One call for each line, so that lines of several threads do not mix.
  fmt::print(stderr, "gromad: {}\n", text);
}

// SIGTERM, SIGINT and SIGHUP as a descriptor to poll. Threads started later inherit the signal mask.
io::Descriptor signals() {
  sigset_t set;
  sigemptyset(&set);
  sigaddset(&set, SIGTERM);
  sigaddset(&set, SIGINT);
  sigaddset(&set, SIGHUP);
  sigprocmask(SIG_BLOCK, &set, nullptr);
  return io::Descriptor(::signalfd(-1, &set, SFD_CLOEXEC | SFD_NONBLOCK));
}

int check(const std::filesystem::path& path) {
  const std::vector<std::string> problems = check_config(path);
  for (const std::string& problem : problems) fmt::print(stderr, "{}\n", problem);
  return problems.empty() ? io::kGood : io::kBadConfiguration;
}

int run(int argc, char** argv) {
  CLI::App app(
      "Localizes a robot from UWB ranges and its odometry, and serves its pose as JSON lines on TCP. SIGTERM "
      "stops it, SIGHUP reloads the calibration and the tags' lever arms.",
      "gromad");
  help::prepare(app, 8, {{"schema", config_schema}});
  app.set_version_flag("--version", fmt::format("gromad {}", io::program_version()));
  std::filesystem::path path;
  app.add_option("--config", path, "Configuration file (YAML)")->required();
  bool only_check = false;
  app.add_flag(
      "--check", only_check,
      "Report all errors of the configuration and of the files that it names, and end. Opens no device");
  app.footer(
      "Exit codes: 0 stopped by a signal, 2 usage, 65 the drive gave no usable calibration,\n"
      "69 device or service unavailable, 77 permission, 78 bad configuration.");
  if (const std::optional<int> code = help::parse(app, argc, argv)) return *code;
  if (only_check) return check(path);

  const io::Descriptor signal_fd = signals();
  if (const std::string warning = lock_memory(); !warning.empty()) log(warning);
  if (!std::filesystem::exists(path)) {
    throw io::ConfigError({path}, "does not exist", "give the daemon's configuration file");
  }
  Config config = read_config(path);
  std::optional<model::Calibration> calibration = load_calibration(config.calibration);
  if (config.calibration.output) io::expect_writable(*config.calibration.output);
  for (const auto& file : {config.calibration.output, config.last_pose})
    if (file) io::remove_left_files(*file);

  Daemon daemon(std::move(config), std::move(calibration), log);
  if (const link::LinkError error = daemon.open(); error.fault != link::LinkFault::kNone) {
    log(error.message);
    return error.fault == link::LinkFault::kPermission ? io::kNoPermission : io::kUnavailable;
  }
  ServiceManager manager;
  if (!daemon.run(signal_fd.get(), manager)) return io::kBadData;
  log("stopped");
  return io::kGood;
}

int guarded_run(int argc, char** argv) {
  try {
    return run(argc, argv);
  } catch (const io::DataError& error) {
    log(error.what());
    return io::kBadData;
  } catch (const io::ConfigError& error) {
    log(error.what());
    return io::kBadConfiguration;
  } catch (const io::PermissionError& error) {
    log(error.what());
    return io::kNoPermission;
  } catch (const io::PathError& error) {
    log(error.what());
    return io::kBadConfiguration;
  } catch (const std::exception& error) {
    log(error.what());
    return io::kUnavailable;
  }
}

}  // namespace
}  // namespace groma::daemon

int main(int argc, char** argv) {
  std::signal(SIGPIPE, SIG_IGN);
  return groma::daemon::guarded_run(argc, argv);
}
