// groma monitor: a running gromad on one screen.
#include <fmt/format.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/stop_signal.hpp"
#include "host/cli/terminal.hpp"
#include "host/daemon/config.hpp"
#include "host/doctor/monitor_view.hpp"
#include "host/doctor/pose_stream.hpp"
#include "host/io/exit_code.hpp"
#include "host/link/network_link.hpp"

namespace groma::cli {

namespace {

constexpr int kFrame_ms = 200;
constexpr double kRetry_s = 1.0;
constexpr double kOncePatience_s = 10.0;

struct MonitorOptions {
  std::string address = "127.0.0.1:4721";
  std::filesystem::path config;
  bool once = false;
};

double monotonic_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Keys without echo, and another screen than the shell's, until it is destroyed.
class FullScreen {
 public:
  FullScreen() {
    if (::tcgetattr(STDIN_FILENO, &before_) == 0) {
      termios settings = before_;
      settings.c_lflag &= ~static_cast<tcflag_t>(ICANON | ECHO);
      settings.c_cc[VSUSP] = _POSIX_VDISABLE;
      has_keys_ = ::tcsetattr(STDIN_FILENO, TCSANOW, &settings) == 0;
    }
    say("\x1b[?1049h\x1b[?25l");
    flush_output();
  }
  FullScreen(const FullScreen&) = delete;
  FullScreen& operator=(const FullScreen&) = delete;
  ~FullScreen() {
    static_cast<void>(!::write(STDOUT_FILENO, kEnd.data(), kEnd.size()));
    if (has_keys_) ::tcsetattr(STDIN_FILENO, TCSANOW, &before_);
  }

  [[nodiscard]] static doctor::ScreenSize size() {
    winsize window{};
    if (::ioctl(STDOUT_FILENO, TIOCGWINSZ, &window) != 0 || window.ws_row == 0 || window.ws_col == 0)
      return {};
    return {window.ws_row, window.ws_col};
  }
  // No line is longer than the screen, and the last one does not end by a line feed: nothing scrolls.
  static void show(const std::vector<doctor::Line>& lines, bool colour) {
    std::string text = "\x1b[H";
    for (std::size_t i = 0; i < lines.size(); ++i) {
      const bool is_last = i + 1 == lines.size();
      // Cleared first: behind a full line the cursor is still on its last character.
      text +=
          (is_last ? "\x1b[J" : "\x1b[K") + doctor::rendered(lines.at(i), colour) + (is_last ? "" : "\r\n");
    }
    say(text);
    flush_output();
  }

 private:
  static constexpr std::string_view kEnd = "\x1b[?25h\x1b[?1049l";

  termios before_{};
  bool has_keys_ = false;
};

// Reconnects until gromad answers.
class Source {
 public:
  explicit Source(std::string address) : address_(std::move(address)), view_(address_) {}

  // Takes what comes within wait_ms; true: a status came, or the connection was lost. Ends early for `key`
  // if that descriptor can be read; negative: none.
  bool wait(int wait_ms, int key) {
    if (!stream_ && monotonic_s() >= next_try_s_) connect();
    std::array<pollfd, 2> entries{{{key, POLLIN, 0}, {stream_ ? stream_->fd() : -1, POLLIN, 0}}};
    static_cast<void>(::poll(entries.data(), entries.size(), wait_ms));
    if (!stream_) return false;
    bool news = false;
    const double now_s = monotonic_s();
    for (const nlohmann::json& message : stream_->read(0.0)) {
      view_.take(message, now_s);
      news = news || message.at("class") == "STATUS";
    }
    if (!stream_->ended()) return news;
    stream_.reset();
    next_try_s_ = now_s + kRetry_s;
    error_ = "gromad has ended the connection; check whether it runs";
    view_.lost(error_);
    return true;
  }

  [[nodiscard]] const doctor::MonitorView& view() const noexcept { return view_; }
  [[nodiscard]] const std::string& error() const noexcept { return error_; }
  [[nodiscard]] bool is_connected() const noexcept { return stream_ != nullptr; }

 private:
  void connect() {
    doctor::PoseStream::Opened opened = doctor::PoseStream::open(address_);
    stream_ = std::move(opened.stream);
    error_ = opened.error;
    next_try_s_ = monotonic_s() + kRetry_s;
    if (!stream_) view_.lost(error_);
  }

  std::string address_;
  doctor::MonitorView view_;
  std::unique_ptr<doctor::PoseStream> stream_;
  std::string error_;
  double next_try_s_ = 0.0;
};

bool quits() {
  std::array<char, 16> keys{};
  const ssize_t count = ::read(STDIN_FILENO, keys.data(), keys.size());
  if (count == 0) return true;  // the terminal is gone
  return std::string_view(keys.data(), count > 0 ? static_cast<std::size_t>(count) : 0).find_first_of("qQ") !=
         std::string_view::npos;
}

int run_on_screen(Source& source) {
  const char* const no_colour = std::getenv("NO_COLOR");
  const bool colour = no_colour == nullptr || *no_colour == '\0';
  const volatile std::sig_atomic_t& stop = stop_on_signals();
  stop_heartbeat();
  const FullScreen screen;
  while (stop == 0) {
    FullScreen::show(source.view().draw(FullScreen::size()), colour);
    const double until_s = monotonic_s() + 1e-3 * kFrame_ms;
    while (stop == 0 && monotonic_s() < until_s) {
      source.wait(static_cast<int>(1e3 * (until_s - monotonic_s())) + 1, STDIN_FILENO);
      pollfd key{STDIN_FILENO, POLLIN, 0};
      if (::poll(&key, 1, 0) > 0 && quits()) return io::kGood;
    }
  }
  return io::kGood;
}

// A block of text for each status, without control characters.
int run_as_text(Source& source, bool once) {
  const volatile std::sig_atomic_t& stop = stop_on_signals();
  const double give_up_s = monotonic_s() + kOncePatience_s;
  while (stop == 0) {
    const bool news = source.wait(kFrame_ms, -1);
    if (!source.is_connected()) {
      complain(source.error());
      return io::kUnavailable;
    }
    if (once && monotonic_s() > give_up_s) {
      complain("gromad does not report its status; check whether another program listens there");
      return io::kUnavailable;
    }
    if (!news || !source.view().is_complete()) continue;
    for (const doctor::Line& line : source.view().draw({std::numeric_limits<int>::max(), 80})) {
      say(doctor::rendered(line, false) + "\n");
    }
    say("\n");
    flush_output();
    if (once) break;
  }
  return io::kGood;
}

int run(const MonitorOptions& options) {
  std::string address = "tcp://" + options.address;
  if (!options.config.empty()) address = doctor::address_of(daemon::read_config(options.config).pose_stream);
  if (!link::parse_network_path(address)) {
    throw CLI::ValidationError("ADDRESS", fmt::format("'{}' is not HOST:PORT", options.address));
  }
  Source source(address);
  const char* const terminal = std::getenv("TERM");
  const bool is_dumb = terminal == nullptr || std::string_view(terminal) == "dumb";
  if (options.once || is_dumb || ::isatty(STDOUT_FILENO) == 0) return run_as_text(source, options.once);
  return run_on_screen(source);
}

}  // namespace

void add_monitor(CLI::App& app, Action& action) {
  const auto options = std::make_shared<MonitorOptions>();
  CLI::App* command = app.add_subcommand(
      "monitor",
      "Show a running gromad on one screen: pose, state with what to do, rates, latency, links, anchors and "
      "pairs. The key q quits. Without a terminal it prints a block of text for each status.");
  command->add_option("ADDRESS", options->address, "HOST:PORT of its pose stream")
      ->capture_default_str()
      ->type_name("ADDRESS");
  command->add_option("--config", options->config, "Instead: the configuration of gromad, which names them")
      ->type_name("FILE");
  command->add_flag("--once", options->once, "Print one block of text, and end");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
