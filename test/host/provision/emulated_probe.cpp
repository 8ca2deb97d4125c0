#include "test/host/provision/emulated_probe.hpp"

#include <poll.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <array>
#include <cstring>
#include <stdexcept>
#include <utility>

namespace groma::provision::test {

namespace {

constexpr std::uint32_t kIdentity = 0x2BA0'1477;  // JTAG-DP of the Cortex-M4
constexpr std::uint32_t kMemoryPortIdentity = 0x2477'0011;

constexpr std::uint8_t kAbort = 0x8;
constexpr std::uint8_t kDebugPort = 0xA;
constexpr std::uint8_t kAccessPort = 0xB;
constexpr std::uint8_t kIdcode = 0xE;
constexpr unsigned kInstructionBits = 4;
constexpr unsigned kAccessBits = 35;

constexpr std::uint64_t kOk = 0b010;

// DP CTRL/STAT
constexpr std::uint32_t kStickyError = 1U << 5;
constexpr std::uint32_t kPowerRequests = (1U << 28) | (1U << 30);

}  // namespace

JtagPort::State JtagPort::next(State state, bool tms) noexcept {
  using S = State;
  struct Edges {
    S low, high;
  };
  static constexpr std::array<Edges, 16> kEdges{{
      {S::kIdle, S::kReset},          // kReset
      {S::kIdle, S::kSelectDr},       // kIdle
      {S::kCaptureDr, S::kSelectIr},  // kSelectDr
      {S::kShiftDr, S::kExit1Dr},     // kCaptureDr
      {S::kShiftDr, S::kExit1Dr},     // kShiftDr
      {S::kPauseDr, S::kUpdateDr},    // kExit1Dr
      {S::kPauseDr, S::kExit2Dr},     // kPauseDr
      {S::kShiftDr, S::kUpdateDr},    // kExit2Dr
      {S::kIdle, S::kSelectDr},       // kUpdateDr
      {S::kCaptureIr, S::kReset},     // kSelectIr
      {S::kShiftIr, S::kExit1Ir},     // kCaptureIr
      {S::kShiftIr, S::kExit1Ir},     // kShiftIr
      {S::kPauseIr, S::kUpdateIr},    // kExit1Ir
      {S::kPauseIr, S::kExit2Ir},     // kPauseIr
      {S::kShiftIr, S::kUpdateIr},    // kExit2Ir
      {S::kIdle, S::kSelectDr},       // kUpdateIr
  }};
  const Edges& edges = kEdges.at(static_cast<std::size_t>(state));
  return tms ? edges.high : edges.low;
}

void JtagPort::set(bool tck, bool tms, bool tdi) {
  const bool rising = tck && !tck_;
  tck_ = tck;
  if (!rising || part_ == nullptr) return;
  if (state_ == State::kShiftDr || state_ == State::kShiftIr) {
    shift_ = (shift_ >> 1) | (std::uint64_t{tdi} << (shift_bits_ - 1));
  }
  state_ = next(state_, tms);
  if (state_ == State::kCaptureDr || state_ == State::kCaptureIr) capture();
  if (state_ == State::kUpdateDr || state_ == State::kUpdateIr) update();
  if (state_ == State::kReset) instruction_ = kIdcode;
}

void JtagPort::capture() {
  if (state_ == State::kCaptureIr) {
    shift_ = 0b0001;
    shift_bits_ = kInstructionBits;
    return;
  }
  switch (instruction_) {
    case kIdcode:
      shift_ = kIdentity;
      shift_bits_ = 32;
      break;
    case kAbort:
    case kDebugPort:
    case kAccessPort:
      shift_ = (std::uint64_t{result_} << 3) | kOk;
      shift_bits_ = kAccessBits;
      break;
    default:
      shift_ = 0;
      shift_bits_ = 1;
      break;
  }
}

void JtagPort::update() {
  if (state_ == State::kUpdateIr) {
    instruction_ = static_cast<std::uint8_t>(shift_ & 0xF);
    return;
  }
  const bool read = (shift_ & 1U) != 0;
  const auto address = static_cast<unsigned>((shift_ >> 1) & 3U) * 4;
  const auto value = static_cast<std::uint32_t>(shift_ >> 3);
  if (instruction_ == kDebugPort) access_debug_port(address, read, value);
  if (instruction_ == kAccessPort) access_access_port(address, read, value);
}

void JtagPort::access_debug_port(unsigned address, bool read, std::uint32_t value) {
  if (read && address == 0xC) return;  // RDBUFF: keeps the result
  switch (address) {
    case 0x4:
      if (read) {
        // Each power request is acknowledged at once.
        result_ = control_ | ((control_ & kPowerRequests) << 1) | (sticky_error_ ? kStickyError : 0);
      } else {
        if ((value & kStickyError) != 0) sticky_error_ = false;
        control_ = value & kPowerRequests;
      }
      break;
    case 0x8:
      if (read) {
        result_ = select_;
      } else {
        select_ = value;
      }
      break;
    default:
      result_ = 0;
      break;
  }
}

void JtagPort::access_access_port(unsigned address, bool read, std::uint32_t value) {
  if (sticky_error_) return;
  const std::uint32_t port = select_ >> 24;
  const std::uint32_t reg = (select_ & 0xF0) | address;
  if (port == 0) {
    access_memory(reg, read, value);
  } else if (port == 1) {
    if (read) {
      result_ = part_->read_control(reg);
    } else {
      part_->write_control(reg, value);
    }
  } else if (read) {
    result_ = 0;
  }
}

void JtagPort::access_memory(unsigned reg, bool read, std::uint32_t value) {
  constexpr std::uint32_t kDeviceEnabled = 1U << 6;
  const auto access = [&](std::uint32_t address, std::uint32_t lanes) {
    if (read) {
      const auto got = part_->read(address & ~3U);
      result_ = got.value_or(0);
      sticky_error_ = !got;
    } else {
      sticky_error_ = !part_->write(address & ~3U, value, lanes);
    }
  };
  switch (reg) {
    case 0x00:
      if (read) {
        result_ = csw_ | (part_->locked() ? 0 : kDeviceEnabled);
      } else {
        csw_ = value & ~kDeviceEnabled & ~(1U << 5);  // no packed transfers
      }
      break;
    case 0x04:
      if (read) {
        result_ = tar_;
      } else {
        tar_ = value;
      }
      break;
    case 0x0C: {
      const unsigned bytes = 1U << (csw_ & 7U);
      const std::uint32_t mask = bytes >= 4 ? 0xFFFF'FFFF : ((1U << (8 * bytes)) - 1) << (8 * (tar_ & 3U));
      access(tar_, mask);
      // The Cortex-M4's port increments the address within 4 KiB.
      if ((csw_ & 0x10U) != 0) tar_ = (tar_ & ~0xFFFU) | ((tar_ + bytes) & 0xFFFU);
      break;
    }
    case 0x10:
    case 0x14:
    case 0x18:
    case 0x1C:
      access((tar_ & ~0xFU) | (reg & 0xFU), 0xFFFF'FFFF);
      break;
    case 0xF8:
      result_ = 0xE00F'F003;
      break;
    case 0xFC:
      result_ = kMemoryPortIdentity;
      break;
    default:
      result_ = 0;
      break;
  }
}

EmulatedProbe::EmulatedProbe(std::filesystem::path socket, EmulatedPart* part)
    : socket_(std::move(socket)), part_(part), listening_(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  const std::string path = socket_.string();
  if (path.size() >= sizeof address.sun_path) throw std::runtime_error("long path");
  std::memcpy(address.sun_path, path.c_str(), path.size());
  if (::bind(listening_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address) != 0 ||
      ::listen(listening_.get(), 4) != 0) {
    throw std::runtime_error("cannot listen at " + path);
  }
  thread_ = std::thread([this] { run(); });
}

EmulatedProbe::~EmulatedProbe() {
  stop_ = true;
  thread_.join();
}

void EmulatedProbe::set_unplug(std::function<bool()> unplug) {
  const std::lock_guard lock(mutex_);
  unplug_ = std::move(unplug);
}

void EmulatedProbe::run() {
  while (!stop_) {
    pollfd waiting{listening_.get(), POLLIN, 0};
    if (::poll(&waiting, 1, 20) <= 0) continue;
    const io::Descriptor client(::accept4(listening_.get(), nullptr, nullptr, SOCK_CLOEXEC));
    if (!client.valid()) continue;
    ++sessions_;
    serve(client.get());
  }
}

void EmulatedProbe::serve(int client) {
  JtagPort port(part_);
  std::array<char, 4096> in{};
  std::string out;
  while (!stop_) {
    pollfd waiting{client, POLLIN, 0};
    if (::poll(&waiting, 1, 20) <= 0) continue;
    const ssize_t size = ::read(client, in.data(), in.size());
    if (size <= 0) return;
    out.clear();
    for (std::size_t i = 0; i < static_cast<std::size_t>(size); ++i) {
      const char c = in.at(i);
      if (c >= '0' && c <= '7') {
        const auto pins = static_cast<unsigned>(c - '0');
        port.set((pins & 4U) != 0, (pins & 2U) != 0, (pins & 1U) != 0);
      } else if (c == 'R') {
        out += port.tdo() ? '1' : '0';
      } else if (c == 'Q') {
        return;
      }
    }
    for (std::size_t sent = 0; sent < out.size();) {
      const ssize_t count = ::send(client, out.data() + sent, out.size() - sent, MSG_NOSIGNAL);
      if (count <= 0) return;
      sent += static_cast<std::size_t>(count);
    }
    const std::lock_guard lock(mutex_);
    if (unplug_ && unplug_()) return;
  }
}

}  // namespace groma::provision::test
