#include "host/simulation/site_server.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <system_error>
#include <thread>
#include <utility>

#include "host/io/error.hpp"
#include "host/io/output_file.hpp"

namespace groma::simulation {

namespace {

constexpr double kStep_s = 0.002;      // of the simulation
constexpr double kMaxBehind_s = 0.25;  // wall-clock delay; beyond it, the schedule is shifted

[[noreturn]] void fail(const std::filesystem::path& path, const char* what) {
  const int error = errno;
  const std::string problem = fmt::format("{} ({})", what, std::generic_category().message(error));
  if (error == EACCES || error == EPERM || error == EROFS) {
    throw io::PermissionError({path}, problem, "choose a folder that this user may write to");
  }
  throw io::DeviceError({path}, problem, "choose another folder");
}

sockaddr_un address_of(const std::filesystem::path& path) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  const std::string text = path.string();
  if (text.size() >= sizeof address.sun_path) {
    throw io::PathError({path}, "is too long for a socket", "choose a folder with a shorter path");
  }
  std::memcpy(address.sun_path, text.c_str(), text.size());
  return address;
}

const sockaddr* generic(const sockaddr_un& address) {
  return reinterpret_cast<const sockaddr*>(&address);
}

// Whether a program serves the socket at this address.
bool is_served(const sockaddr_un& address) {
  const io::Descriptor client(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
  return client.get() >= 0 && ::connect(client.get(), generic(address), sizeof address) == 0;
}

}  // namespace

LineServer::LineServer(std::filesystem::path path)
    : path_(std::move(path)), listening_(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0)) {
  if (listening_.get() < 0) fail(path_, "no socket");
  const sockaddr_un address = address_of(path_);
  if (std::filesystem::is_socket(path_)) {
    if (is_served(address)) {
      throw io::DeviceError({path_}, "is served by another program", "end that, or choose another folder");
    }
    ::unlink(path_.c_str());
  }
  if (::bind(listening_.get(), generic(address), sizeof address) != 0) fail(path_, "cannot be made");
  if (::listen(listening_.get(), 8) != 0) {
    ::unlink(path_.c_str());
    fail(path_, "cannot be listened on");
  }
}

LineServer::~LineServer() {
  ::unlink(path_.c_str());
}

void LineServer::give(const std::string& lines) {
  for (;;) {
    io::Descriptor client(::accept4(listening_.get(), nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
    if (client.get() < 0) break;
    clients_.push_back(std::move(client));
  }
  if (lines.empty()) return;
  // After a partial send the client's last line is incomplete: disconnect it; it may reconnect.
  const auto gone = std::remove_if(clients_.begin(), clients_.end(), [&](const io::Descriptor& client) {
    return ::send(client.get(), lines.data(), lines.size(), MSG_NOSIGNAL) !=
           static_cast<ssize_t>(lines.size());
  });
  clients_.erase(gone, clients_.end());
}

SiteServer::SiteServer(const sim::Scenario& scenario, const Options& options)
    : site_(scenario, options.site),
      feed_(site_.world().robot()),
      speed_(options.speed),
      folder_(options.folder),
      made_folder_(!std::filesystem::exists(folder_)),
      robot_((io::make_folder(folder_), folder_ / "robot.sock")) {
  try {
    for (std::size_t i = 0; i < site_.port_count(); ++i) {
      ports_.emplace_back();
      const std::filesystem::path link = folder_ / site_.port_name(i);
      if (std::filesystem::is_symlink(link)) ::unlink(link.c_str());  // left by a killed run
      if (::symlink(ports_.back().path().c_str(), link.c_str()) != 0) fail(link, "cannot be made");
      links_.push_back(link);
    }
  } catch (...) {
    for (const std::filesystem::path& link : links_) ::unlink(link.c_str());
    throw;
  }
}

SiteServer::~SiteServer() {
  for (const std::filesystem::path& link : links_) ::unlink(link.c_str());
  ::unlink((folder_ / "robot.sock").c_str());
  if (made_folder_) ::rmdir(folder_.c_str());  // fails if other files are in it
}

void SiteServer::step(double t_s) {
  std::array<std::uint8_t, 512> chunk{};
  for (std::size_t i = 0; i < ports_.size(); ++i) {
    const std::size_t size = ports_[i].read(chunk);
    if (size > 0) (void)site_.send(i, std::span(chunk).first(size));  // what exceeds the line's queue is lost
  }
  site_.run_until(t_s);
  for (std::size_t i = 0; i < ports_.size(); ++i) {
    bytes_.clear();
    site_.take(i, bytes_);
    if (!bytes_.empty()) ports_[i].write(bytes_);
  }
  lines_.clear();
  feed_.lines_until(t_s, lines_);
  robot_.give(lines_);
}

void SiteServer::run(const volatile std::sig_atomic_t& stop, double simulated_s) {
  using Clock = std::chrono::steady_clock;
  Clock::time_point begin = Clock::now();
  std::uint64_t steps = 0;
  while (stop == 0) {
    const double t_s = static_cast<double>(steps + 1) * kStep_s;
    if (simulated_s > 0.0 && t_s > simulated_s) return;
    const double early_s = t_s / speed_ - std::chrono::duration<double>(Clock::now() - begin).count();
    if (early_s > 0.0) {
      std::this_thread::sleep_for(std::chrono::duration<double>(std::min(early_s, 0.05)));
      continue;
    }
    if (early_s < -kMaxBehind_s) {
      begin += std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(-early_s));
      behind_s_ -= early_s;
    }
    step(t_s);
    ++steps;
  }
}

}  // namespace groma::simulation
