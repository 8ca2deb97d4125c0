// gromad: reads the tags' serial ports and the robot's odometry, and serves poses.
#include <fmt/format.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include <array>
#include <csignal>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/daemon/config.hpp"
#include "host/daemon/daemon.hpp"
#include "host/daemon/log_output.hpp"
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

void print(std::string_view text) {
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

// Logs an error, and returns its exit code.
int guarded(const Daemon::Log& log, const std::function<int()>& action) {
  try {
    return action();
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

int serve(const std::filesystem::path& path, int signal_fd, const Daemon::Log& log) {
  Config config = read_config(path);
  std::optional<model::Calibration> calibration = load_calibration(config.calibration);
  if (config.calibration.output) {
    io::expect_writable(*config.calibration.output);
    io::remove_remains(*config.calibration.output);
  }
  if (config.last_pose) io::remove_remains(*config.last_pose);

  Daemon daemon(std::move(config), std::move(calibration), log);
  if (const link::LinkError error = daemon.open(); error.fault != link::LinkFault::kNone) {
    log(error.message);
    return error.fault == link::LinkFault::kPermission ? io::kNoPermission : io::kUnavailable;
  }
  ServiceManager manager;
  if (!daemon.run(signal_fd, manager)) return io::kBadData;
  log("stopped");
  return io::kGood;
}

int run(int argc, char** argv) {
  CLI::App app(
      "Localizes a robot from UWB ranges and its odometry, and serves its pose as JSON lines on TCP. SIGTERM "
      "stops it, SIGHUP reloads the calibration and the tags' lever arms.",
      "gromad");
  help::prepare(app, 8,
                "Exit codes: 0 stopped by a signal, 2 usage, 65 the drive gave no usable calibration,\n"
                "69 device or service unavailable, 77 permission, 78 bad configuration.",
                {{"schema", config_schema}});
  app.set_version_flag("--version", fmt::format("gromad {}", io::program_version()));
  std::filesystem::path path;
  app.add_option("--config", path, "Configuration file (YAML)")->required()->type_name("FILE");
  bool only_check = false;
  app.add_flag(
      "--check", only_check,
      "Report all errors of the configuration and of the files that it names, and end. Opens no device");
  help::add_guides(
      app,
      std::array{help::Guide{
          .command = "",
          .examples = {{"Report the errors of a configuration, and open no device",
                        "gromad --check --config gromad.yaml"},
                       {"Serve poses until a signal stops it", "gromad --config /etc/groma/gromad.yaml"}},
          .pages =
              "docs/reference/gromad.md (each key of the configuration), docs/how-to/install-gromad.md"}});
  if (const std::optional<int> code = help::parse(app, argc, argv)) return *code;
  if (only_check) return check(path);

  const io::Descriptor signal_fd = signals();
  // Before there are threads: it locks whole stacks.
  const std::string warning = lock_memory();
  LogOutput output(STDERR_FILENO);
  const auto log = [&output](std::string_view text) { output.write(text); };
  if (!warning.empty()) log(warning);
  return guarded(log, [&] { return serve(path, signal_fd.get(), log); });
}

}  // namespace
}  // namespace groma::daemon

int main(int argc, char** argv) {
  // A file size limit or a closed pipe then makes the write fail, which is reported.
  std::signal(SIGXFSZ, SIG_IGN);
  std::signal(SIGPIPE, SIG_IGN);
  using namespace groma::daemon;
  return guarded(print, [&] { return run(argc, argv); });
}
