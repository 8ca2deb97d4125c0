#include "firmware/soc/nrf52832/uarte.hpp"

#include <algorithm>
#include <limits>

#include "firmware/soc/nrf52832/cpu.hpp"
#include "firmware/soc/nrf52832/gpio.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {

void Uarte::start(const UartPins& pins) noexcept {
  pin::set(pins.transmit);
  pin::configure(pins.transmit, gpio::kOutput);
  // Pulled up, so that an unconnected line is silent.
  pin::configure(pins.receive, gpio::kInputPulledUp);
  const auto& registers = uarte::kBlock;
  registers[uarte::kPinTransmit] = pins.transmit;
  registers[uarte::kPinReceive] = pins.receive;
  registers[uarte::kBaudRate] = uarte::k1Mbaud;
  registers[uarte::kEnable] = uarte::kEnabled;

  receive_.fill(kNotYet);
  receive_into(0);
  registers[uarte::kReceiveCount] = kChunk;
  registers[uarte::kShortcuts] = uarte::kShortReceiveEndToStart;
  registers[uarte::kInterruptSet] =
      uarte::kInterruptByteReceived | uarte::kInterruptReceiveEnd | uarte::kInterruptTransmitEnd;
  enable_interrupt(Irq::kUarte0, Priority::kPeripheral);
  registers[uarte::kStartReceive] = 1;
  // The pointer is latched at the start: now the next chunk's can be written.
  while (registers[uarte::kEventReceiveStarted] == 0) {
  }
  receive_into(1);
}

bool Uarte::write(std::span<const std::uint8_t> frame) noexcept {
  const std::uint32_t head = head_;
  const std::size_t room = kSendRing - (head - tail_);
  if (frame.size() > room) return false;
  const std::size_t at = head % kSendRing;
  const std::size_t to_end = std::min(frame.size(), kSendRing - at);
  std::copy_n(frame.begin(), to_end, send_.begin() + static_cast<std::ptrdiff_t>(at));
  std::copy(frame.begin() + static_cast<std::ptrdiff_t>(to_end), frame.end(), send_.begin());
  head_ = head + static_cast<std::uint32_t>(frame.size());
  const InterruptLock lock;
  if (sending_ == 0) send_next();
  return true;
}

void Uarte::send_next() noexcept {
  constexpr std::size_t kMaxTransfer = 255;
  const std::uint32_t tail = tail_;
  const std::size_t at = tail % kSendRing;
  const std::size_t size = std::min({std::size_t{head_ - tail}, kSendRing - at, kMaxTransfer});
  sending_ = static_cast<std::uint32_t>(size);
  if (size == 0) return;
  uarte::kBlock[uarte::kTransmitPointer] = reinterpret_cast<std::uintptr_t>(send_.data() + at);
  uarte::kBlock[uarte::kTransmitCount] = size;
  uarte::kBlock[uarte::kEventByteSent] = 0;
  uarte::kBlock[uarte::kStartTransmit] = 1;
}

bool Uarte::starting() const noexcept {
  return sending_ != 0 && uarte::kBlock[uarte::kEventByteSent] == 0;
}

void Uarte::receive_into(std::uint32_t chunk) noexcept {
  uarte::kBlock[uarte::kReceivePointer] =
      reinterpret_cast<std::uintptr_t>(receive_.data() + chunk % kChunks * kChunk);
}

std::span<const std::uint8_t> Uarte::received(std::uint64_t now_us) noexcept {
  if (silent_) return {};
  const std::uint32_t end = received_end();
  if (end != taken_) {
    const std::size_t at = taken_ % kReceiveRing;
    return std::span(receive_).subspan(at, std::min<std::size_t>(end - taken_, kReceiveRing - at));
  }
  if (now_us < poll_at_us_) return {};
  poll_at_us_ = now_us + kPoll_us;
  if (uarte::kBlock[uarte::kEventByteReceived] != 0) {
    clear_event(uarte::kBlock[uarte::kEventByteReceived]);
  } else {
    silent_ = true;
    uarte::kBlock[uarte::kInterruptSet] = uarte::kInterruptByteReceived;
  }
  return {};
}

std::uint32_t Uarte::received_end() noexcept {
  const std::uint32_t whole = filled_ * static_cast<std::uint32_t>(kChunk);
  const auto behind = static_cast<std::int32_t>(whole - taken_);
  // The DMA has wrapped around and overwritten bytes that were not taken: restart with its present chunk.
  if (behind > static_cast<std::int32_t>(kReceiveRing - kChunk)) {
    lost_ += whole - taken_;
    taken_ = whole;
    // An old zero must not be taken for one just received.
    receive_.fill(kNotYet);
  }
  const std::uint32_t begin = behind < 0 ? taken_ : whole;
  for (std::uint32_t end = whole + static_cast<std::uint32_t>(kChunk); end != begin; --end) {
    if (receive_[(end - 1) % kReceiveRing] == 0) return end;
  }
  return begin;
}

void Uarte::release(std::size_t bytes) noexcept {
  std::fill_n(receive_.begin() + static_cast<std::ptrdiff_t>(taken_ % kReceiveRing), bytes, kNotYet);
  taken_ += static_cast<std::uint32_t>(bytes);
}

std::uint64_t Uarte::next_poll_us() const noexcept {
  return silent_ ? std::numeric_limits<std::uint64_t>::max() : poll_at_us_;
}

void Uarte::on_interrupt() noexcept {
  const auto& registers = uarte::kBlock;
  if (registers[uarte::kEventReceiveEnd] != 0) {
    clear_event(registers[uarte::kEventReceiveEnd]);
    // The DMA already fills the chunk after this one.
    const std::uint32_t filled = filled_ + 1;
    filled_ = filled;
    receive_into(filled + 1);
  }
  if (silent_ && registers[uarte::kEventByteReceived] != 0) {
    registers[uarte::kInterruptClear] = uarte::kInterruptByteReceived;
    silent_ = false;
  }
  if (registers[uarte::kEventTransmitEnd] != 0) {
    clear_event(registers[uarte::kEventTransmitEnd]);
    tail_ = tail_ + sending_;
    send_next();
  }
}

}  // namespace groma::nrf52832
