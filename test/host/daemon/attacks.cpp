#include "test/host/daemon/attacks.hpp"

#include <fmt/format.h>
#include <pty.h>
#include <sys/socket.h>
#include <termios.h>

#include <csignal>
#include <deque>
#include <limits>
#include <memory>
#include <utility>

#include "test/support/random.hpp"

namespace groma::daemon::test {
namespace {

using link::test::frame_of;
using link::test::make_range;
using link::test::make_report;
using Bytes = std::vector<std::uint8_t>;

// Not of an Arena: attackers have threads of their own.
class Noise {
 public:
  explicit Noise(std::uint64_t seed) : random_(seed) {}
  std::uint8_t byte() { return static_cast<std::uint8_t>(random_.uniform(0.0, 256.0)); }
  bool one_in(double n) { return random_.uniform(0.0, n) < 1.0; }
  double between(double from, double to) { return random_.uniform(from, to); }
  std::string text(std::size_t size) {
    std::string out(size, '\0');
    for (char& each : out) each = static_cast<char>(byte());
    return out;
  }

 private:
  groma::test::Random random_;
};

std::string odometry(double t_s, double vx_mps, double omega_radps) {
  return fmt::format("{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":0,\"omega_radps\":{}}}\n",
                     t_s, vx_mps, omega_radps);
}

std::string true_odometry(double t_s) {
  return odometry(t_s, SimulatedSite::kRadius_m * SimulatedSite::kOmega, SimulatedSite::kOmega);
}

void connect_and_leave(std::uint16_t port, bool reset) {
  try {
    TcpClient client(port);
    const linger at_once{1, 0};
    if (reset) ::setsockopt(client.fd(), SOL_SOCKET, SO_LINGER, &at_once, sizeof(at_once));
  } catch (const std::runtime_error&) {
    // No port of this side is free for the moment.
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
}

void flood_with_connections(Arena& arena, double seconds, bool reset) {
  const Attacker attacker([port = arena.port(), reset] { connect_and_leave(port, reset); });
  arena.pump(seconds);
  arena.note_resources();
}

void hold_without_reading(Arena& arena, double seconds, std::size_t count, int receive_buffer) {
  std::vector<std::unique_ptr<TcpClient>> clients;
  for (std::size_t i = 0; i < count; ++i) {
    clients.push_back(std::make_unique<TcpClient>(arena.port(), receive_buffer));
    arena.pump(0.002);
  }
  arena.pump(seconds);
  arena.note_resources();
}

// All places are taken, and a new client tries again and again: it gets poses within 10 s.
void take_all_places(Arena& arena, double seconds) {
  std::vector<std::unique_ptr<TcpClient>> silent;
  for (int i = 0; i < 64; ++i) {
    silent.push_back(std::make_unique<TcpClient>(arena.port()));
    arena.pump(0.002);
  }
  for (double waited_s = 0.0;; waited_s += 0.2) {
    if (waited_s > std::max(seconds, 10.0)) throw std::runtime_error("a new client gets no place");
    TcpClient late(arena.port());
    arena.pump(0.2);
    if (late.receive().find("\"POSE\"") != std::string::npos) break;
  }
  arena.note_resources();
}

void send_garbage_to_the_stream(Arena& arena, double seconds) {
  auto client = std::make_shared<TcpClient>(arena.port());
  auto noise = std::make_shared<Noise>(1);
  const std::string block = noise->text(65'536);
  const Attacker attacker([client, block] {
    static_cast<void>(!::send(client->fd(), block.data(), block.size(), MSG_NOSIGNAL));
    static_cast<void>(client->receive());
  });
  arena.pump(seconds);
  arena.note_resources();
}

std::string web_request(const std::string& path, const std::string& host, const std::string& more) {
  return "GET " + path + " HTTP/1.1\r\nHost: " + host + "\r\n" + more + "\r\n";
}

std::string web_socket_request(const std::string& more = {}) {
  return web_request("/live", "127.0.0.1",
                     "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                     "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n" +
                         more);
}

// Asks as pages of others do: by another name (DNS rebinding), with another origin, for a WebSocket. It gets
// no content.
void ask_as_others(Arena& arena, double seconds) {
  std::atomic<int> served = 0;
  std::atomic<int> refused = 0;
  {
    const Attacker attacker([port = arena.web_port(), &served, &refused] {
      for (const std::string& request : {web_request("/metrics", "evil.example", ""),
                                         web_request("/", "127.0.0.1", "Origin: http://evil.example\r\n"),
                                         web_socket_request("Origin: http://evil.example\r\n")}) {
        try {
          TcpClient client(port);
          client.send(request);
          const std::string answer = client.await(std::chrono::milliseconds(1000));
          if (answer.starts_with("HTTP/1.1 403 ")) ++refused;
          if (answer.starts_with("HTTP/1.1 200 ") || answer.starts_with("HTTP/1.1 101 ")) ++served;
        } catch (const std::runtime_error&) {
          std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
      }
    });
    arena.pump(seconds);
    arena.note_resources();
  }
  if (served > 0 || refused == 0)
    throw std::runtime_error(fmt::format("others: {} served, {} refused", served.load(), refused.load()));
}

// Clients of the web server that send this and then never read.
void hold_web_clients(Arena& arena, double seconds, std::size_t count, const std::string& request) {
  std::vector<std::unique_ptr<TcpClient>> clients;
  for (std::size_t i = 0; i < count; ++i) {
    clients.push_back(std::make_unique<TcpClient>(arena.web_port(), 4096));
    clients.back()->send(request);
    arena.pump(0.002);
  }
  arena.pump(seconds);
  arena.note_resources();
}

// Opens a WebSocket, announces a frame of 1 GiB and sends its beginning, again and again.
void announce_long_frames(Arena& arena, double seconds) {
  const Attacker attacker([port = arena.web_port()] {
    try {
      TcpClient client(port);
      client.send(web_socket_request());
      static_cast<void>(client.await(std::chrono::milliseconds(100)));
      const char header[] = "\x81\xff\x00\x00\x00\x00\x40\x00\x00\x00\x00\x00\x00\x00";
      client.send(std::string(header, sizeof header - 1) + std::string(4000, 'x'));
      static_cast<void>(client.await(std::chrono::milliseconds(100)));
    } catch (const std::runtime_error&) {
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
  });
  arena.pump(seconds);
  arena.note_resources();
}

// Adds text after each line of odometry.
auto adding(std::function<std::string(double t_s)> text) {
  return [text = std::move(text)](Arena& arena, double seconds) {
    arena.on_lines = [&](double t_s, std::string lines) { return std::move(lines) + text(t_s); };
    arena.pump(seconds);
    arena.note_resources();
  };
}

// Adds text every second.
auto adding_each_second(std::function<std::string(double t_s)> text) {
  return adding([text = std::move(text), next_s = 0.0](double t_s) mutable {
    if (t_s < next_s) return std::string();
    next_s = t_s + 1.0;
    return text(t_s);
  });
}

// t_s in place of the true one, for half of the time.
auto changing_times(std::function<double(double t_s)> change) {
  return [change = std::move(change)](Arena& arena, double seconds) {
    arena.on_lines = [&](double t_s, const std::string& /*lines*/) {
      arena.note_sent(change(t_s), t_s);
      return true_odometry(change(t_s));
    };
    arena.pump(0.5 * seconds);
    arena.on_lines = {};
    arena.pump(0.5 * seconds);
    arena.note_resources();
  };
}

auto odometry_at(double rate_hz) {
  return [rate_hz](Arena& arena, double seconds) {
    arena.site().odometry_period_s = 1.0 / rate_hz;
    arena.pump(seconds);
    arena.note_resources();
  };
}

// Withholds odometry for that time, then sends it all or none of it.
auto pausing(double pause_s, bool sends_all) {
  return [=](Arena& arena, double seconds) {
    std::string kept;
    double begin_s = -1.0;
    arena.on_lines = [&](double t_s, const std::string& lines) {
      if (begin_s < 0.0) begin_s = t_s;
      if (t_s - begin_s < pause_s) {
        if (sends_all) kept += lines;
        return std::string();
      }
      if (sends_all) begin_s = t_s;
      return std::exchange(kept, {}) + lines;
    };
    arena.pump(std::max(seconds, pause_s + 2.0));
    arena.note_resources();
  };
}

// Changes each frame of the tag.
auto changing_frames(std::function<Bytes(Noise& noise, Bytes frame)> change) {
  return [change = std::move(change)](Arena& arena, double seconds) {
    Noise noise(2);
    arena.site().on_frame = [&](Bytes frame) { return change(noise, std::move(frame)); };
    arena.pump(seconds);
    arena.note_resources();
  };
}

// 1 Mbit/s of random bytes between the frames.
void fill_the_line_with_garbage(Arena& arena, double seconds) {
  Noise noise(3);
  auto last = Arena::Clock::now();
  double owed = 0.0;
  arena.on_step = [&] {
    constexpr double kBytes_hz = 100'000.0;
    const auto now = Arena::Clock::now();
    owed += kBytes_hz * std::chrono::duration<double>(now - std::exchange(last, now)).count();
    Bytes garbage(static_cast<std::size_t>(owed));
    owed -= static_cast<double>(garbage.size());
    for (std::uint8_t& each : garbage) each = noise.byte();
    arena.site().send_to_tag_link(garbage);
  };
  arena.pump(seconds);
  arena.note_resources();
}

void repeat_frames(Arena& arena, double seconds) {
  Bytes recorded;
  arena.site().on_frame = [&](Bytes frame) {
    recorded.insert(recorded.end(), frame.begin(), frame.end());
    return frame;
  };
  arena.pump(std::min(3.0, seconds));
  arena.site().on_frame = {};
  for (int i = 0; i < 20; ++i) {
    arena.site().send_to_tag_link(recorded);
    arena.pump(seconds / 20.0);
  }
  arena.note_resources();
}

// Frames with a good CRC, one for each of the tag's: report(sequence, device time).
auto forging(std::function<groma_NodeToHost(Noise& noise, std::uint32_t number)> report) {
  return [report = std::move(report)](Arena& arena, double seconds) {
    Noise noise(4);
    std::uint32_t number = 0;
    arena.site().on_frame = [&](Bytes frame) {
      const Bytes forged = frame_of(report(noise, number++));
      frame.insert(frame.end(), forged.begin(), forged.end());
      return frame;
    };
    arena.pump(seconds);
    arena.note_resources();
  };
}

std::uint64_t device_dtu(double t_s) {
  return static_cast<std::uint64_t>(std::llround(t_s * clock::kDeviceTicksPerSecond));
}

void replug(Arena& arena, double seconds) {
  for (int i = 0; i < 10; ++i) {
    arena.site().unplug();
    arena.pump(0.02 * seconds);
    arena.site().plug_in();
    arena.pump(0.08 * seconds);
  }
  arena.note_resources();
}

// Another port gives the same bytes.
void report_twice(Arena& arena, double seconds) {
  int master = -1;
  int slave = -1;
  char name[128];
  if (::openpty(&master, &slave, nullptr, nullptr, nullptr) != 0 ||
      ::ttyname_r(slave, name, sizeof(name)) != 0)
    throw std::runtime_error("openpty");
  const io::Descriptor port(master);
  const io::Descriptor end(slave);
  termios raw{};
  ::tcgetattr(slave, &raw);
  ::cfmakeraw(&raw);
  ::tcsetattr(slave, TCSANOW, &raw);
  ::fcntl(master, F_SETFL, O_NONBLOCK);
  std::filesystem::create_symlink(name, arena.folder() / "tag-2");
  arena.site().on_frame = [&](Bytes frame) {
    static_cast<void>(!::write(master, frame.data(), frame.size()));
    return frame;
  };
  // gromad looks for a missing port every 3 s, and then waits for two more periods.
  arena.pump(seconds + 7.0);
  arena.note_resources();
  std::filesystem::remove(arena.folder() / "tag-2");
  if (arena.gromad().log().find("both report tag 1") == std::string::npos)
    throw std::runtime_error("gromad does not name two links that report one tag");
}

auto stopping(double stop_s) {
  return [stop_s](Arena& arena, double seconds) {
    ::kill(arena.gromad().pid(), SIGSTOP);
    arena.pump(stop_s);
    ::kill(arena.gromad().pid(), SIGCONT);
    arena.pump(seconds);
    arena.note_resources();
  };
}

void use_up_descriptors(Arena& arena, double seconds) {
  rlimit before{};
  ::prlimit(arena.gromad().pid(), RLIMIT_NOFILE, nullptr, &before);
  const rlimit few{.rlim_cur = 16, .rlim_max = before.rlim_max};
  ::prlimit(arena.gromad().pid(), RLIMIT_NOFILE, &few, nullptr);
  hold_without_reading(arena, seconds, 20, 0);
  ::prlimit(arena.gromad().pid(), RLIMIT_NOFILE, &before, nullptr);
}

void reload_often(Arena& arena, double seconds) {
  for (double done_s = 0.0; done_s < seconds; done_s += 0.5) {
    arena.gromad().hang_up();
    arena.pump(0.5);
  }
  arena.note_resources();
}

// The recording ends, localization does not.
void limit_the_file_size(Arena& arena, double seconds) {
  const rlimit small{.rlim_cur = 4096, .rlim_max = RLIM_INFINITY};
  ::prlimit(arena.gromad().pid(), RLIMIT_FSIZE, &small, nullptr);
  arena.pump(std::max(seconds, 2.5));
  arena.note_resources();
  if (arena.gromad().log().find("the recording has ended") == std::string::npos)
    throw std::runtime_error("gromad does not say that the recording has ended");
}

}  // namespace

std::vector<Attack> attacks_on_the_pose_stream() {
  return {
      {"200 readers that never read",
       [](Arena& arena, double seconds) { hold_without_reading(arena, seconds, 200, 4096); }, true, true,
       true},
      {"64 silent clients; a new one gets poses", take_all_places, false, true},
      {"connection flood, FIN",
       [](Arena& arena, double seconds) { flood_with_connections(arena, seconds, false); }, true, true, true},
      {"connection flood, RST",
       [](Arena& arena, double seconds) { flood_with_connections(arena, seconds, true); }, true, true},
      {"random bytes to the pose stream at full rate", send_garbage_to_the_stream, true, true},
  };
}

std::vector<Attack> attacks_on_the_web_server() {
  return {
      {"web: another name, another origin", ask_as_others, true, true, true},
      {"web: 200 clients that say nothing",
       [](Arena& arena, double seconds) { hold_web_clients(arena, seconds, 200, ""); }, true, true},
      {"web: 200 WebSockets that never read",
       [](Arena& arena, double seconds) { hold_web_clients(arena, seconds, 200, web_socket_request()); },
       true, true, true},
      {"web: frames of 1 GiB announced", announce_long_frames, true, true},
  };
}

std::vector<Attack> attacks_on_the_robots_side() {
  const auto noise = std::make_shared<Noise>(5);
  const double speed_mps = SimulatedSite::kRadius_m * SimulatedSite::kOmega;
  return {
      {"4 KB of random bytes after each line", adding([=](double) { return noise->text(4096) + "\n"; }),
       false, true},
      {"100 KB without a line feed, each second",
       adding_each_second([](double) { return std::string(100'000, 'x') + "\n"; }), false, true},
      {"3,000 nested arrays after each line",
       adding([](double) { return "{\"class\":\"ODOMETRY\",\"t_s\":" + std::string(3000, '[') + "\n"; }),
       false, true},
      {"NaN, 1e999, absurd covariances", adding([](double t_s) {
         return odometry(std::nan(""), 1.0, 0.0) + odometry(1e308, 1.0, 0.0) +
                fmt::format(
                    "{{\"class\":\"POSE_PRIOR\",\"t_s\":{0},\"x_m\":1e308,\"y_m\":0,\"z_m\":0,\"yaw_rad\":0}}"
                    "\n"
                    "{{\"class\":\"GNSS\",\"t_s\":{0},\"x_m\":1e9,\"y_m\":0,\"covariance\":[-1,0,0,1e999]}}"
                    "\n",
                    t_s);
       }),
       false, true},
      {"1e300 rad/s, 1e12 m/s, 30 m/s, each second", adding_each_second([](double t_s) {
         return odometry(t_s + 0.001, 0.0, 1e300) + odometry(t_s + 0.002, 1e12, 0.0) +
                odometry(t_s + 0.003, 31.0, 0.0);
       }),
       false, true},
      {"IMU of 1e308 rad/s after each line", adding([](double t_s) {
         return fmt::format("{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":1e308}}\n", t_s);
       }),
       false, true},
      {"each line twice, and one of 0.3 s before", adding([=](double t_s) {
         return odometry(t_s, speed_mps, 0.0) + odometry(t_s - 0.3, speed_mps, 0.0);
       }),
       false, true},
      {"one line 0.95 s ahead, each second",
       adding_each_second([](double t_s) { return true_odometry(t_s + 0.95); }), false, true},
      {"one line 0.5 s ahead, each second",
       adding_each_second([](double t_s) { return true_odometry(t_s + 0.5); }), false, true},
      {"t_s + 1 h, and back", changing_times([](double t_s) { return t_s + 3600.0; })},
      {"t_s in milliseconds, and back", changing_times([](double t_s) { return 1000.0 * t_s; })},
      {"odometry at 1 kHz", odometry_at(1000.0)},
      {"odometry at 2 kHz", odometry_at(2000.0)},
      {"odometry at 5 kHz", odometry_at(5000.0)},
      {"odometry at 10 kHz", odometry_at(10'000.0), false, false, true},
      {"odometry in bursts of 0.3 s", pausing(0.3, true)},
      {"no odometry for 5 s", pausing(5.0, false)},
  };
}

std::vector<Attack> attacks_on_the_tags_link() {
  return {
      {"garbage at line rate", fill_the_line_with_garbage, true, true, true},
      {"1 % of the bytes lost, 0.1 % flipped", changing_frames([](Noise& noise, const Bytes& frame) {
         Bytes out;
         for (const std::uint8_t byte : frame) {
           if (!noise.one_in(100.0)) out.push_back(noise.one_in(1000.0) ? byte ^ 4U : byte);
         }
         return out;
       })},
      {"half of each frame", changing_frames([](Noise&, Bytes frame) {
         frame.resize(frame.size() / 2);
         return frame;
       })},
      {"2,000 zeros in place of each frame",
       changing_frames([](Noise&, const Bytes&) { return Bytes(2000, 0); })},
      {"frames repeated: 3 s of them, 20 times", repeat_frames, false, true},
      {"forged: device time 1 h ahead", forging([](Noise&, std::uint32_t number) {
         return make_report(number, 1, device_dtu(3600.0 + 0.1 * number), {make_range(100, 5.0, 0)});
       })},
      {"forged: random sequence and device time", forging([](Noise& noise, std::uint32_t) {
         return make_report(static_cast<std::uint32_t>(noise.between(0.0, 4e9)), 1,
                            device_dtu(noise.between(0.0, 1e5)), {make_range(101, 5.0, 0)});
       })},
      {"forged: other tags", forging([](Noise&, std::uint32_t number) {
         return make_report(number, 2 + number % 50, device_dtu(100.0 + 0.1 * number),
                            {make_range(100, 5.0, 0)});
       })},
      {"forged: ranges of NaN, and random ones", forging([](Noise& noise, std::uint32_t number) {
         return make_report(number, 1, device_dtu(100.0 + 0.1 * number),
                            {make_range(100, std::nan(""), 0),
                             make_range(static_cast<std::uint16_t>(noise.between(0.0, 65535.0)), 3.0, 0),
                             make_range(101, noise.between(0.0, 1000.0), 0)});
       })},
      {"port closed and opened 10 times", replug},
      {"two ports report one tag", report_twice},
  };
}

std::vector<Attack> attacks_on_the_process() {
  return {
      {"stopped for 1 s", stopping(1.0)},
      {"stopped for 3 s", stopping(3.0)},
      {"stopped for 10 s", stopping(10.0)},
      {"16 descriptors, 20 clients", use_up_descriptors, false, true},
      {"reloaded twice a second", reload_often, false, true},
      {"file size limit", limit_the_file_size, false, true, true},
  };
}

}  // namespace groma::daemon::test
