#include "firmware/sim/emulator/spim.hpp"

#include <algorithm>
#include <utility>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kTasksStart = 0x010,
  kTasksStop = 0x014,
  kShorts = 0x200,
  kEnable = 0x500,
  kPselSck = 0x508,
  kPselMiso = 0x510,
  kFrequency = 0x524,
  kRxdList = 0x540,
  kTxdList = 0x550,
  kConfig = 0x554,
  kOrc = 0x5C0,
};

constexpr std::uint32_t kEnabled = 7;
constexpr std::uint32_t kDisconnected = 0xFFFFFFFF;

}  // namespace

Spim::Spim(std::string name, const SpimPins& wired, EasyDma dma, SimTime overhead, Exchange exchange)
    : name_(std::move(name)),
      receive_name_(name_ + " RXD"),
      transmit_name_(name_ + " TXD"),
      wired_(wired),
      dma_(dma),
      overhead_(overhead),
      exchange_(std::move(exchange)) {
  reset();
}

void Spim::reset() {
  events_ = EventRegisters{kEvents};
  enabled_ = false;
  pins_.fill(kDisconnected);
  frequency_ = 0x04000000;
  over_read_ = 0;
  buffers_ = {};
  end_at_ = kNever;
  spoiled_ = 0;
}

std::uint32_t Spim::clock_hz() const {
  switch (frequency_) {
    case 0x02000000:
      return 125'000;
    case 0x04000000:
      return 250'000;
    case 0x08000000:
      return 500'000;
    case 0x10000000:
      return 1'000'000;
    case 0x20000000:
      return 2'000'000;
    case 0x40000000:
      return 4'000'000;
    case 0x80000000:
      return 8'000'000;
    default:
      throw SimulationError(name_ + ": FREQUENCY " + hexadecimal(frequency_) + " is invalid");
  }
}

void Spim::start(SimTime t) {
  if (!enabled_) throw SimulationError(name_ + ": START while it is not enabled");
  if (busy()) throw SimulationError(name_ + ": START while a transfer is in progress");
  if (pins_ != std::array{wired_.sck, wired_.mosi, wired_.miso})
    throw SimulationError(name_ + ": SCK, MOSI and MISO are not the pins that lead to its chip");
  // Erratum 58.
  if (buffers_.receive.maximum == 1 && buffers_.transmit.maximum <= 1) {
    throw SimulationError(name_ + ": a transfer of one received byte clocks one byte too many (erratum 58)");
  }
  const std::span<const std::uint8_t> out =
      dma_.at(buffers_.transmit.pointer, buffers_.transmit.maximum, transmit_name_.c_str());
  (void)dma_.at(buffers_.receive.pointer, buffers_.receive.maximum, receive_name_.c_str());

  const std::size_t bytes = std::max(buffers_.transmit.maximum, buffers_.receive.maximum);
  mosi_.assign(out.begin(), out.end());
  mosi_.resize(bytes, static_cast<std::uint8_t>(over_read_));
  sending_ = buffers_.transmit;
  receiving_ = buffers_.receive;
  const SimTime duration = overhead_ + static_cast<SimTime>(bytes) * 8 * (kUnitsPerSecond / clock_hz());
  started_at_ = t;
  end_at_ = t + duration;
  busy_time_ += duration;
  ++transfers_;
  events_.raise(kStarted);
}

void Spim::spoil_start(SimTime t, std::uint8_t bits) noexcept {
  if (busy() && sending_.maximum != 0 && t - started_at_ < kDmaStart) spoiled_ = bits;
}

void Spim::advance(SimTime t) {
  if (end_at_ > t) return;
  const SimTime end = std::exchange(end_at_, kNever);
  const std::span<const std::uint8_t> out =
      dma_.at(sending_.pointer, sending_.maximum, transmit_name_.c_str());
  if (!std::equal(out.begin(), out.end(), mosi_.begin()))
    throw SimulationError(name_ + ": the transmit buffer was changed during the transfer");
  if (spoiled_ != 0) mosi_[0] ^= std::exchange(spoiled_, std::uint8_t{0});

  miso_.assign(mosi_.size(), 0);
  if (!mosi_.empty() && !exchange_(end, mosi_, miso_, clock_hz()))
    throw SimulationError(name_ + ": a transfer while no chip is selected");
  const std::span<std::uint8_t> in = dma_.at(receiving_.pointer, receiving_.maximum, receive_name_.c_str());
  std::copy_n(miso_.begin(), in.size(), in.begin());
  buffers_.transmit.amount = sending_.maximum;
  buffers_.receive.amount = receiving_.maximum;
  events_.raise(kEndTx);
  events_.raise(kEndRx);
  events_.raise(kEnd);
}

std::optional<std::uint32_t> Spim::read(SimTime, std::uint32_t offset) {
  switch (offset) {
    case kShorts:
    case kRxdList:
    case kTxdList:
    case kConfig:
      return 0;
    case kEnable:
      return enabled_ ? kEnabled : 0;
    case kFrequency:
      return frequency_;
    case kOrc:
      return over_read_;
    default:
      if (offset >= kPselSck && offset <= kPselMiso) return pins_[(offset - kPselSck) / 4];
      if (const auto value = buffers_.read(offset)) return value;
      return events_.read(offset);
  }
}

bool Spim::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  switch (offset) {
    case kTasksStart:
      if (value != 0) start(t);
      return true;
    case kTasksStop:
      if (value == 0) return true;
      if (busy()) throw SimulationError(name_ + ": STOP during a transfer is not modelled");
      events_.raise(kStopped);
      return true;
    case kEnable:
      if (value != 0 && value != kEnabled)
        throw SimulationError(name_ + ": ENABLE " + hexadecimal(value) +
                              " is not the SPI master with EasyDMA");
      if (busy()) throw SimulationError(name_ + ": ENABLE written during a transfer");
      enabled_ = value == kEnabled;
      return true;
    case kFrequency:
      frequency_ = value;
      (void)clock_hz();
      return true;
    case kOrc:
      over_read_ = value & 0xFF;
      return true;
    case kShorts:
    case kRxdList:
    case kTxdList:
    case kConfig:
      // Mode 0, most significant bit first, no list, no shorts: all devices here use these.
      if (value != 0)
        throw SimulationError(name_ + ": " + hexadecimal(value) + " at offset " + hexadecimal(offset) +
                              " is not modelled");
      return true;
    default:
      break;
  }
  if (offset >= kPselSck && offset <= kPselMiso) {
    if (enabled_) throw SimulationError(name_ + ": PSEL written while it is enabled");
    pins_[(offset - kPselSck) / 4] = value;
    return true;
  }
  return buffers_.write(offset, value) || events_.write(offset, value);
}

}  // namespace groma::sim
