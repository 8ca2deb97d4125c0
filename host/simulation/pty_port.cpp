#include "host/simulation/pty_port.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <poll.h>
#include <termios.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstdlib>
#include <system_error>

#include "host/io/error.hpp"

namespace groma::simulation {

namespace {

[[noreturn]] void fail(const char* what) {
  throw io::DeviceError({"/dev/ptmx"}, fmt::format("{} ({})", what, std::generic_category().message(errno)),
                        "make pseudo-terminals available to this user, or close some");
}

}  // namespace

PtyPort::PtyPort() : master_(::posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC)) {
  if (master_.get() < 0) fail("no pseudo-terminal");
  if (::grantpt(master_.get()) != 0 || ::unlockpt(master_.get()) != 0)
    fail("the pseudo-terminal cannot be opened");
  std::array<char, 64> name{};
  if (::ptsname_r(master_.get(), name.data(), name.size()) != 0) fail("the pseudo-terminal has no name");
  path_ = name.data();
  // Set raw mode first: otherwise the terminal would echo our bytes back. Opening and closing the slave side
  // once makes poll() report POLLHUP from then on while no program has it open.
  const io::Descriptor slave(::open(path_.c_str(), O_RDWR | O_NOCTTY | O_CLOEXEC));
  termios settings{};
  if (slave.get() < 0 || ::tcgetattr(slave.get(), &settings) != 0)
    fail("the pseudo-terminal cannot be opened");
  ::cfmakeraw(&settings);
  if (::tcsetattr(slave.get(), TCSANOW, &settings) != 0) fail("the pseudo-terminal cannot be set raw");
  if (::fcntl(master_.get(), F_SETFL, O_NONBLOCK) != 0)
    fail("the pseudo-terminal cannot be set not to block");
}

bool PtyPort::listened() const noexcept {
  pollfd waiting{master_.get(), POLLOUT, 0};
  return ::poll(&waiting, 1, 0) >= 0 && (waiting.revents & POLLHUP) == 0;
}

std::size_t PtyPort::write(std::span<const std::uint8_t> bytes) {
  if (!listened()) return 0;
  std::size_t written = 0;
  while (written < bytes.size()) {
    const ssize_t count = ::write(master_.get(), bytes.data() + written, bytes.size() - written);
    if (count < 0 && errno == EINTR) continue;
    if (count <= 0) break;
    written += static_cast<std::size_t>(count);
  }
  return written;
}

std::size_t PtyPort::read(std::span<std::uint8_t> out) {
  const ssize_t count = ::read(master_.get(), out.data(), out.size());
  return count > 0 ? static_cast<std::size_t>(count) : 0;
}

}  // namespace groma::simulation
