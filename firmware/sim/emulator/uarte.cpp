#include "firmware/sim/emulator/uarte.hpp"

#include <algorithm>
#include <string>
#include <utility>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kTasksStartrx = 0x000,
  kTasksStoprx = 0x004,
  kTasksStarttx = 0x008,
  kTasksStoptx = 0x00C,
  kTasksFlushrx = 0x02C,
  kShorts = 0x200,
  kErrorsrc = 0x480,
  kEnable = 0x500,
  kPselRts = 0x508,
  kPselRxd = 0x514,
  kBaudrate = 0x524,
  kConfig = 0x56C,
};

constexpr std::uint32_t kEnabled = 8;
constexpr std::uint32_t kDisconnected = 0xFFFFFFFF;
constexpr std::uint32_t kEndrxStartrx = 1U << 5;
constexpr std::uint32_t kEndrxStoprx = 1U << 6;
constexpr std::uint32_t kOverrun = 1U << 0;
constexpr std::size_t kFifoBytes = 4;

}  // namespace

Uarte::Uarte(const UartePins& wired, Line line, EasyDma dma)
    : wired_(wired), line_(std::move(line)), dma_(dma) {
  pins_.fill(kDisconnected);
}

void Uarte::reset(SimTime t) {
  if (sent_at_ != kNever) line_.cut(t);
  events_ = EventRegisters{kEvents, 1U << kTxdrdy};
  enabled_ = false;
  pins_.fill(kDisconnected);
  baud_rate_ = 0x04000000;
  shorts_ = error_source_ = 0;
  buffers_ = {};
  receiver_ = Receiver::kOff;
  receiving_ = false;
  fifo_.clear();
  timeout_at_ = kNever;
  first_sent_at_ = sent_at_ = kNever;
  spoiled_ = 0;
  stopping_ = false;
}

SimTime Uarte::byte_time() const noexcept {
  return 10 * kUnitsPerSecond / static_cast<SimTime>(line_.bits_per_s);
}

void Uarte::check_ready(const char* task) const {
  const std::string what = std::string("UARTE0: ") + task;
  if (!enabled_) throw SimulationError(what + " while it is not enabled");
  // BAUDRATE has units of 16 MHz / 2^32; its low 12 bits are not used.
  const std::uint64_t bits_per_s =
      (std::uint64_t{baud_rate_ & 0xFFFFF000U} * 16'000'000 + (1ULL << 31)) >> 32;
  if (bits_per_s != line_.bits_per_s) {
    throw SimulationError(what + " at " + std::to_string(bits_per_s) +
                          " bit/s, but the host's line runs at " + std::to_string(line_.bits_per_s));
  }
  if (pins_[1] != wired_.txd || pins_[3] != wired_.rxd)
    throw SimulationError(what + ": TXD and RXD are not the pins that lead to the host");
}

// ---- receiver ---------------------------------------------------------------------------------------------

void Uarte::receive(SimTime, std::uint8_t byte) {
  if (receiver_ == Receiver::kOff) {
    ++lost_bytes_;
    return;
  }
  if (receiving_) {
    dma_.at(in_.pointer, in_.maximum, "UARTE0 RXD")[in_.amount++] = byte;
    events_.raise(kRxdrdy);
    if (in_.amount == in_.maximum) end_receive();
    return;
  }
  if (fifo_.size() == kFifoBytes) {
    ++lost_bytes_;
    error_source_ |= kOverrun;
    events_.raise(kError);
    return;
  }
  fifo_.push_back(byte);
  events_.raise(kRxdrdy);
}

void Uarte::start_receive() {
  check_ready("STARTRX");
  if (receiving_) throw SimulationError("UARTE0: STARTRX while a buffer is being filled");
  (void)dma_.at(buffers_.receive.pointer, buffers_.receive.maximum, "UARTE0 RXD");
  if (buffers_.receive.maximum == 0) throw SimulationError("UARTE0: STARTRX with an empty buffer");
  receiver_ = Receiver::kOn;
  timeout_at_ = kNever;
  receiving_ = true;
  in_ = {buffers_.receive.pointer, buffers_.receive.maximum, 0};
  events_.raise(kRxStarted);
  flush_receive();
}

// Moves the FIFO's bytes into the buffer.
void Uarte::flush_receive() {
  const std::vector<std::uint8_t> waiting = std::exchange(fifo_, {});
  for (std::size_t i = 0; i < waiting.size(); ++i) {
    if (!receiving_) {
      fifo_.push_back(waiting[i]);
      continue;
    }
    dma_.at(in_.pointer, in_.maximum, "UARTE0 RXD")[in_.amount++] = waiting[i];
    if (in_.amount == in_.maximum) end_receive();
  }
}

void Uarte::end_receive() {
  receiving_ = false;
  buffers_.receive.amount = in_.amount;
  events_.raise(kEndRx);
  if ((shorts_ & kEndrxStartrx) != 0) {
    // The caller moves the bytes that remain in the FIFO.
    receiving_ = true;
    in_ = {buffers_.receive.pointer, buffers_.receive.maximum, 0};
    (void)dma_.at(in_.pointer, in_.maximum, "UARTE0 RXD");
    events_.raise(kRxStarted);
  } else if ((shorts_ & kEndrxStoprx) != 0) {
    receiver_ = Receiver::kOff;
    events_.raise(kRxto);
  }
}

void Uarte::stop_receive(SimTime t) {
  if (receiver_ != Receiver::kOn) return;
  // Up to four bytes in transit are still received.
  receiver_ = Receiver::kStopping;
  timeout_at_ = t + static_cast<SimTime>(kFifoBytes) * byte_time();
  if (!receiving_) return;
  receiving_ = false;
  buffers_.receive.amount = in_.amount;
  events_.raise(kEndRx);
}

// ---- transmitter ------------------------------------------------------------------------------------------

void Uarte::start_transmit(SimTime t) {
  check_ready("STARTTX");
  if (sent_at_ != kNever) throw SimulationError("UARTE0: STARTTX while a transfer is in progress");
  const std::span<const std::uint8_t> bytes =
      dma_.at(buffers_.transmit.pointer, buffers_.transmit.maximum, "UARTE0 TXD");
  sending_.assign(bytes.begin(), bytes.end());
  out_ = {buffers_.transmit.pointer, buffers_.transmit.maximum, buffers_.transmit.maximum};
  sending_since_ = t;
  sent_at_ = t + static_cast<SimTime>(sending_.size()) * byte_time();
  if (!sending_.empty()) first_sent_at_ = t + byte_time();
  stopping_ = false;
  events_.raise(kTxStarted);
}

void Uarte::spoil_start(SimTime t, std::uint8_t bits) noexcept {
  if (first_sent_at_ != kNever && t - sending_since_ < kDmaStart) spoiled_ = bits;
}

void Uarte::first_transmitted() {
  first_sent_at_ = kNever;
  events_.raise(kTxdrdy);
  std::vector<std::uint8_t> bytes(sending_.begin(),
                                  sending_.begin() + static_cast<std::ptrdiff_t>(out_.amount));
  if (!bytes.empty()) bytes.front() ^= std::exchange(spoiled_, std::uint8_t{0});
  line_.send(sending_since_, bytes);
}

// The byte on the line is completed.
void Uarte::stop_transmit(SimTime t) {
  if (sent_at_ == kNever) {
    events_.raise(kTxStopped);
    return;
  }
  const auto begun = static_cast<std::uint32_t>((t - sending_since_) / byte_time()) + 1;
  stopping_ = true;
  if (begun >= out_.amount) return;
  out_.amount = begun;
  sent_at_ = sending_since_ + static_cast<SimTime>(begun) * byte_time();
  if (first_sent_at_ == kNever) line_.cut(sent_at_ + byte_time() / 2);
}

void Uarte::transmitted() {
  const std::span<const std::uint8_t> bytes = dma_.at(out_.pointer, out_.maximum, "UARTE0 TXD");
  if (!std::equal(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(out_.amount), sending_.begin()))
    throw SimulationError("UARTE0: the transmit buffer was changed during the transfer");
  sent_at_ = kNever;
  buffers_.transmit.amount = out_.amount;
  if (out_.amount > 0) events_.raise(kTxdrdy);
  events_.raise(kEndTx);
  if (std::exchange(stopping_, false)) events_.raise(kTxStopped);
}

// ---- registers --------------------------------------------------------------------------------------------

SimTime Uarte::next_event() const noexcept {
  return std::min({first_sent_at_, sent_at_, timeout_at_});
}

void Uarte::advance(SimTime t) {
  if (first_sent_at_ <= t) first_transmitted();
  if (sent_at_ <= t) transmitted();
  if (timeout_at_ <= t) {
    timeout_at_ = kNever;
    receiver_ = Receiver::kOff;
    events_.raise(kRxto);
  }
}

std::optional<std::uint32_t> Uarte::read(SimTime, std::uint32_t offset) {
  switch (offset) {
    case kShorts:
      return shorts_;
    case kErrorsrc:
      return error_source_;
    case kEnable:
      return enabled_ ? kEnabled : 0;
    case kBaudrate:
      return baud_rate_;
    case kConfig:
      return 0;
    default:
      if (offset >= kPselRts && offset <= kPselRxd) return pins_[(offset - kPselRts) / 4];
      if (const auto value = buffers_.read(offset)) return value;
      return events_.read(offset);
  }
}

bool Uarte::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  switch (offset) {
    case kTasksStartrx:
      if (value != 0) start_receive();
      return true;
    case kTasksStoprx:
      if (value != 0) stop_receive(t);
      return true;
    case kTasksStarttx:
      if (value != 0) start_transmit(t);
      return true;
    case kTasksStoptx:
      if (value != 0) stop_transmit(t);
      return true;
    case kTasksFlushrx:
      if (value == 0) return true;
      if (receiver_ != Receiver::kOff) throw SimulationError("UARTE0: FLUSHRX while the receiver runs");
      in_ = {buffers_.receive.pointer, buffers_.receive.maximum, 0};
      receiving_ = !fifo_.empty();
      flush_receive();
      buffers_.receive.amount = in_.amount;
      receiving_ = false;
      events_.raise(kEndRx);
      return true;
    case kShorts:
      if ((value & ~(kEndrxStartrx | kEndrxStoprx)) != 0)
        throw SimulationError("UARTE0: SHORTS " + hexadecimal(value));
      shorts_ = value;
      return true;
    case kErrorsrc:
      error_source_ &= ~value;
      return true;
    case kEnable:
      if (value != 0 && value != kEnabled)
        throw SimulationError("UARTE0: ENABLE " + hexadecimal(value) + " is not the UART with EasyDMA");
      enabled_ = value == kEnabled;
      return true;
    case kBaudrate:
      baud_rate_ = value;
      return true;
    case kConfig:
      if (value != 0) throw SimulationError("UARTE0: parity and flow control are not modelled");
      return true;
    default:
      break;
  }
  if (offset >= kPselRts && offset <= kPselRxd) {
    if (enabled_) throw SimulationError("UARTE0: PSEL written while it is enabled");
    pins_[(offset - kPselRts) / 4] = value;
    return true;
  }
  return buffers_.write(offset, value) || events_.write(offset, value);
}

}  // namespace groma::sim
