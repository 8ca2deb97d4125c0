// Driver of the MCP2518FD on its SPI bus: brings the chip up as one node of this protocol, and moves frames
// to and from its two FIFOs.
//
//         bring_up()                     bus-off
//   kDown ----------> kOnBus <----------------------------------> kBusOff
//     ^                 |          128 x 11 recessive bits
//     +--- the chip lost its settings
//
// No call waits for the bus. Each call's SPI traffic is stated, so that a caller with time slots can plan.
//
// Workarounds for errata DS80000789:
// - FIFOCI in a FIFO's status can be read wrong: it is not used, only the flags beside it.
// - A read during a change of the same register can return a wrong top bit of the first byte: no such bit is
//   used.
// - IOCON must be written byte by byte: it is not written.
// - SPI above kMaxSpi_hz can corrupt the RAM: the board stays below.
// - Single-bit error correction of the RAM is unreliable: any RAM error restarts the chip.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mcp2518fd/bit_timing.hpp"
#include "firmware/core/mcp2518fd/registers.hpp"
#include "firmware/core/mcp2518fd/spi.hpp"
#include "proto/can_segment.hpp"

namespace groma::mcp2518fd {

struct Settings {
  std::uint16_t node = 0;  // id of this node; it receives only what the host sends to it
  wire::CanFormat format = wire::CanFormat::kClassic;
  std::uint32_t nominal_bit_per_s = 1'000'000;
  std::uint32_t data_bit_per_s = 2'000'000;  // for kFd
  friend constexpr bool operator==(const Settings&, const Settings&) noexcept = default;
};

enum class BringUp : std::uint8_t {
  kOk,
  kNoChip,       // no answer on SPI
  kNoClock,      // its oscillator does not start
  kKeepsMode,    // its mode does not change
  kOtherChip,    // the chip that answers is not an MCP2518FD
  kNotWritable,  // registers or RAM did not keep what was written
  kNoBitRate,    // not available from 40 MHz
  kBusNotIdle,   // no sequence of 11 recessive bits was seen
};

// At most 31 characters; empty for kOk.
[[nodiscard]] constexpr const char* describe(BringUp result) noexcept {
  switch (result) {
    case BringUp::kOk:
      return "";
    case BringUp::kNoChip:
      return "no MCP2518FD answers on SPI";
    case BringUp::kNoClock:
      return "CAN oscillator does not start";
    case BringUp::kKeepsMode:
      return "CAN mode does not change";
    case BringUp::kOtherChip:
      return "CAN controller is no MCP2518FD";
    case BringUp::kNotWritable:
      return "CAN registers keep no values";
    case BringUp::kNoBitRate:
      return "CAN bit rate is not possible";
    case BringUp::kBusNotIdle:
      return "CAN bus is never idle";
  }
  return "";
}

enum class State : std::uint8_t { kDown, kOnBus, kBusOff };

struct Events {
  bool received = false;  // a frame is waiting
  bool room = false;      // the transmit FIFO is at least half empty, after it was full
  bool bus_off = false;   // entered just now; the frames in the transmit FIFO are lost
  bool on_bus = false;    // returned to the bus just now
  bool overrun = false;   // the receive FIFO was full, and frames were lost
  bool any = false;       // a flag was set, one of these or another
  bool lost = false;      // the chip has lost its settings: bring it up again
};

struct ErrorCounters {
  std::uint8_t transmit = 0;
  std::uint8_t receive = 0;
};

template <Spi S>
class Mcp2518fd {
 public:
  explicit constexpr Mcp2518fd(S& spi) noexcept : spi_(spi) {}

  // Resets the chip and puts it on the bus; `delay_us(n)` waits. Takes about 3 ms of SPI at 8 MHz, and up to
  // 40 ms of waiting if it fails.
  template <class Delay>
  [[nodiscard]] BringUp bring_up(const Settings& settings, Delay&& delay_us) noexcept {
    state_ = State::kDown;
    const auto nominal = nominal_timing(settings.nominal_bit_per_s);
    const bool fd = settings.format == wire::CanFormat::kFd;
    const auto data = fd ? data_timing(settings.data_bit_per_s) : BitTiming{};
    if (!nominal || !data) return BringUp::kNoBitRate;
    normal_ = fd ? Mode::kNormalFd : Mode::kNormalClassic;
    payload_ = static_cast<std::uint8_t>(wire::max_can_payload(settings.format));

    if (const BringUp result = reset(delay_us); result != BringUp::kOk) return result;
    if (!clear_ram()) return BringUp::kNotWritable;
    write(kModes);
    set_bit_timing(*nominal);
    if (fd) set_data_timing(*data);
    set_up_fifos();
    set_filter(wire::can_id({wire::CanDirection::kToNode, settings.node}));
    if (!kept(*nominal)) return BringUp::kNotWritable;
    enables_ = kEnables;
    write(enables_);
    request(normal_);
    if (!await_mode(normal_, delay_us)) return BringUp::kBusNotIdle;
    room_ = 0;
    state_ = State::kOnBus;
    return BringUp::kOk;
  }

  // Hands a frame with a 29-bit id to the chip, which sends it after earlier ones and repeats it until it is
  // acknowledged. Returns false if there is no room, which an event reports later, or if the chip is not on
  // the bus. At most 4 transfers with 17 bytes in addition to the payload, padded to a multiple of 4.
  bool send(const wire::CanFrame& frame) noexcept {
    if (state_ != State::kOnBus || frame.size > payload_) return false;
    if (room_ == 0 && !check_room()) return false;
    write_object(frame);
    // One byte adds the frame to the FIFO and requests its transmission.
    write_byte<reg::TransmitCon>(
        1, Value<reg::TransmitCon>().set(reg::transmit_con::kAdvance).set(reg::transmit_con::kRequest));
    --room_;
    next_object_ = static_cast<std::uint16_t>(next_object_ + object_bytes());
    if (next_object_ == kRamBegin + transmit_depth() * object_bytes()) next_object_ = kRamBegin;
    return true;
  }

  // Reads the oldest waiting frame; returns false if there is none. At most 3 transfers with 95 bytes.
  bool receive(wire::CanFrame& out) noexcept {
    if (state_ == State::kDown) return false;
    const auto [status, address] = read_pair<reg::ReceiveSta, reg::ReceiveUa>();
    if (!status.has(reg::receive_sta::kNotEmpty)) return false;
    read_object(static_cast<std::uint16_t>(kRamBegin + (address.word() & 0x7FFU)), out);
    write_byte<reg::ReceiveCon>(1, Value<reg::ReceiveCon>().set(reg::receive_con::kAdvance));
    return true;
  }

  // Reads and clears the causes of the interrupt, if any; call again until the line is high. At most 6
  // transfers with 32 bytes.
  [[nodiscard]] Events take_events() noexcept {
    Events events;
    if (state_ == State::kDown) return events;
    namespace flag = reg::interrupt;
    const auto flags = read<reg::Int>();
    if (flags.get(flag::kEnables) != enables_.get(flag::kEnables) || flags.has(flag::kRamError) ||
        (flags.has(flag::kModeChanged) && !mode_held())) {
      state_ = State::kDown;
      events.lost = true;
      return events;
    }
    events.any = (flags.word() & (flags.word() >> 16) & 0xFFFFU) != 0;
    constexpr std::uint32_t kCleared =
        flag::kModeChanged.kMask | flag::kSystemError.kMask | flag::kErrorState.kMask;
    // Writing a zero clears a flag, writing a one does not change it.
    if ((flags.word() & kCleared) != 0)
      write_bytes<reg::Int>(0, 2, Value<reg::Int>(~(flags.word() & kCleared)));
    if (flags.has(flag::kErrorState)) follow_errors(events);
    if (flags.has(flag::kOverrun)) {
      events.overrun = true;
      write_byte<reg::ReceiveSta>(0, Value<reg::ReceiveSta>());
    }
    events.received = flags.has(flag::kReceived);
    if (flags.has(flag::kTransmit) && enables_.has(flag::kOnTransmit)) {
      events.room = true;
      ask_for_room(false);
    }
    return events;
  }

  // One transfer with 6 bytes.
  [[nodiscard]] ErrorCounters error_counters() noexcept {
    if (state_ == State::kDown) return {};
    const auto errors = read<reg::Trec>();
    return {.transmit = static_cast<std::uint8_t>(errors.get(reg::trec::kTransmitErrors)),
            .receive = static_cast<std::uint8_t>(errors.get(reg::trec::kReceiveErrors))};
  }

  [[nodiscard]] State state() const noexcept { return state_; }

 private:
  static constexpr unsigned kHeaderBytes = 2;        // instruction and address
  static constexpr unsigned kObjectHeaderBytes = 8;  // in the message RAM
  static constexpr std::uint32_t kConAfterReset = 0x0498'0760;

  static constexpr auto kModes =
      Value<reg::Con>()
          .set(reg::con::kRequest, static_cast<std::uint32_t>(Mode::kConfiguration))
          .set(reg::con::kWakeUpFilter)
          .set(reg::con::kWakeUpFiltered)
          .set(reg::con::kNoException)
          .set(reg::con::kIsoCrc);
  static constexpr auto kClock = Value<reg::Osc>().set(reg::osc::kOutput);
  static constexpr auto kEnables = Value<reg::Int>()
                                       .set(reg::interrupt::kOnReceived)
                                       .set(reg::interrupt::kOnModeChanged)
                                       .set(reg::interrupt::kOnRamError)
                                       .set(reg::interrupt::kOnOverrun)
                                       .set(reg::interrupt::kOnSystemError)
                                       .set(reg::interrupt::kOnErrorState);

  // ---- message objects: 2 KB hold 32 + 32 with 8 bytes, or 20 + 8 with 64 ---------------------------------

  [[nodiscard]] bool fd() const noexcept { return payload_ == wire::kMaxFdPayload; }
  [[nodiscard]] unsigned object_bytes() const noexcept { return kObjectHeaderBytes + payload_; }
  [[nodiscard]] unsigned transmit_depth() const noexcept { return fd() ? 20 : 32; }
  [[nodiscard]] unsigned receive_depth() const noexcept { return fd() ? 8 : 32; }
  static_assert((20 + 8) * (kObjectHeaderBytes + 64) <= kRamBytes);
  static_assert((32 + 32) * (kObjectHeaderBytes + 8) <= kRamBytes);

  void write_object(const wire::CanFrame& frame) noexcept {
    const auto id = Value<ObjectId>().set(object::kHighId, frame.id >> 18).set(object::kLowId, frame.id);
    auto control =
        Value<ObjectControl>().set(object::kLength, wire::can_length_code(frame.size)).set(object::kExtended);
    if (frame.format == wire::CanFormat::kFd) control.set(object::kFd);
    if (frame.bit_rate_switch) control.set(object::kSwitchRate);
    std::array<std::uint8_t, kHeaderBytes + kObjectHeaderBytes + wire::kMaxFdPayload> buffer{};
    put_header(buffer, Instruction::kWrite, next_object_);
    put_word(std::span(buffer).subspan(kHeaderBytes), id.word());
    put_word(std::span(buffer).subspan(kHeaderBytes + 4), control.word());
    for (std::size_t i = 0; i < frame.size; ++i) {
      buffer[kHeaderBytes + kObjectHeaderBytes + i] = frame.data[i];
    }
    // The RAM accepts whole words only.
    const unsigned size = (frame.size + 3U) / 4U * 4U;
    spi_.transfer(std::span(buffer).first(kHeaderBytes + kObjectHeaderBytes + size));
  }

  void read_object(std::uint16_t address, wire::CanFrame& out) noexcept {
    std::array<std::uint8_t, kHeaderBytes + kObjectHeaderBytes + wire::kMaxFdPayload> buffer{};
    put_header(buffer, Instruction::kRead, address);
    spi_.transfer(std::span(buffer).first(kHeaderBytes + object_bytes()));
    const Value<ObjectId> id(get_word(std::span(buffer).subspan(kHeaderBytes)));
    const Value<ObjectControl> control(get_word(std::span(buffer).subspan(kHeaderBytes + 4)));
    out.id = id.get(object::kHighId) << 18 | id.get(object::kLowId);
    out.format = control.has(object::kFd) ? wire::CanFormat::kFd : wire::CanFormat::kClassic;
    out.bit_rate_switch = control.has(object::kSwitchRate);
    const std::uint8_t longest = out.format == wire::CanFormat::kFd ? payload_ : wire::kMaxClassicPayload;
    const std::uint8_t length = wire::kCanLengths[control.get(object::kLength)];
    out.size = length < longest ? length : longest;
    // A remote frame has a length, but no data.
    if (control.has(object::kRemote)) out.size = 0;
    for (std::size_t i = 0; i < out.size; ++i) out.data[i] = buffer[kHeaderBytes + kObjectHeaderBytes + i];
  }

  // Counts the free room from the flags, which saves one transfer for each frame that fits. Waits while the
  // FIFO is more than half full: the bus has enough to send.
  bool check_room() noexcept {
    const auto [status, address] = read_pair<reg::TransmitSta, reg::TransmitUa>();
    if (status.has(reg::transmit_sta::kEmpty)) {
      room_ = transmit_depth();
    } else if (status.has(reg::transmit_sta::kHalfEmpty)) {
      room_ = transmit_depth() / 2;
    } else {
      ask_for_room(true);
      return false;
    }
    next_object_ = static_cast<std::uint16_t>(kRamBegin + (address.word() & 0x7FFU));
    return true;
  }

  void ask_for_room(bool on) noexcept {
    enables_.set(reg::interrupt::kOnTransmit, on ? 1 : 0);
    write_byte<reg::Int>(2, enables_);
  }

  void follow_errors(Events& events) noexcept {
    const bool off = read<reg::Trec>().has(reg::trec::kBusOff);
    // The chip may have returned to the bus before this call.
    events.bus_off = read<reg::Bdiag1>().has(reg::bdiag1::kWasBusOff);
    if (events.bus_off) write_byte<reg::Bdiag1>(2, Value<reg::Bdiag1>());
    events.on_bus = !off && (events.bus_off || state_ == State::kBusOff);
    state_ = off ? State::kBusOff : State::kOnBus;
    room_ = 0;
  }

  // After a transmission for which the RAM was too slow, the chip leaves the bus until it is requested back.
  bool mode_held() noexcept {
    const auto mode = static_cast<Mode>(read<reg::Con>().get(reg::con::kMode));
    if (mode == Mode::kConfiguration) return false;
    if (mode != normal_) request(normal_);
    return true;
  }

  // ---- bring-up -------------------------------------------------------------------------------------------

  template <class Delay>
  BringUp reset(Delay& delay_us) noexcept {
    write_byte<reg::Osc>(0, kClock);
    if (const BringUp result = await_clock(delay_us); result != BringUp::kOk) return result;
    // A reset is allowed in configuration mode only. Pending transmissions are aborted.
    write_byte<reg::Con>(3, Value<reg::Con>(kModes).set(reg::con::kAbort));
    if (!await_mode(Mode::kConfiguration, delay_us)) return BringUp::kKeepsMode;
    std::array<std::uint8_t, kHeaderBytes> instruction{};
    put_header(instruction, Instruction::kReset, 0);
    spi_.transfer(instruction);
    delay_us(kPoll_us);
    if (const BringUp result = await_clock(delay_us); result != BringUp::kOk) return result;
    if (read<reg::Con>().word() != kConAfterReset) return BringUp::kOtherChip;
    write_byte<reg::Osc>(0, Value<reg::Osc>(kClock).set(reg::osc::kLowPower));
    const bool low_power = read<reg::Osc>().has(reg::osc::kLowPower);
    write_byte<reg::Osc>(0, kClock);
    return low_power ? BringUp::kOk : BringUp::kOtherChip;
  }

  static constexpr std::uint32_t kPoll_us = 100;
  static constexpr int kPolls = 100;

  template <class Delay>
  BringUp await_clock(Delay& delay_us) noexcept {
    bool answers = false;
    for (int i = 0; i < kPolls; ++i) {
      const auto clock = read<reg::Osc>();
      const bool silent = clock.word() == 0 || clock.word() == ~0U;
      answers = answers || !silent;
      if (!silent && clock.has(reg::osc::kReady)) return BringUp::kOk;
      delay_us(kPoll_us);
    }
    return answers ? BringUp::kNoClock : BringUp::kNoChip;
  }

  template <class Delay>
  bool await_mode(Mode mode, Delay& delay_us) noexcept {
    for (int i = 0; i < kPolls; ++i) {
      if (read<reg::Con>().get(reg::con::kMode) == static_cast<std::uint32_t>(mode)) return true;
      delay_us(kPoll_us);
    }
    return false;
  }

  // With error correction on, each word must be written before it is read.
  bool clear_ram() noexcept {
    write_byte<reg::Ecccon>(0, Value<reg::Ecccon>()
                                   .set(reg::ecccon::kEnable)
                                   .set(reg::ecccon::kOnSingle)
                                   .set(reg::ecccon::kOnDouble));
    constexpr unsigned kChunk = 64;
    for (unsigned at = 0; at < kRamBytes; at += kChunk) {
      std::array<std::uint8_t, kHeaderBytes + kChunk> buffer{};
      put_header(buffer, Instruction::kWrite, static_cast<std::uint16_t>(kRamBegin + at));
      spi_.transfer(buffer);
    }
    constexpr std::uint32_t kPattern = 0xA55A'3CC3;
    constexpr std::uint16_t kLast = kRamBegin + kRamBytes - 4;
    write_word(kLast, kPattern);
    const bool kept = read_word(kLast) == kPattern && read_word(kRamBegin) == 0;
    write_word(kLast, 0);
    return kept;
  }

  void set_bit_timing(const BitTiming& t) noexcept { write(register_of(t)); }

  static constexpr Value<reg::Nbtcfg> register_of(const BitTiming& t) noexcept {
    return Value<reg::Nbtcfg>()
        .set(reg::nbtcfg::kPrescaler, t.prescaler - 1U)
        .set(reg::nbtcfg::kSegment1, t.segment1 - 1U)
        .set(reg::nbtcfg::kSegment2, t.segment2 - 1U)
        .set(reg::nbtcfg::kJumpWidth, t.jump_width - 1U);
  }

  void set_data_timing(const BitTiming& t) noexcept {
    write(Value<reg::Dbtcfg>()
              .set(reg::dbtcfg::kPrescaler, t.prescaler - 1U)
              .set(reg::dbtcfg::kSegment1, t.segment1 - 1U)
              .set(reg::dbtcfg::kSegment2, t.segment2 - 1U)
              .set(reg::dbtcfg::kJumpWidth, t.jump_width - 1U));
    write(Value<reg::Tdc>().set(reg::tdc::kAutomatic).set(reg::tdc::kOffset, transmitter_delay_offset(t)));
  }

  // PLSIZE: 0 for 8 bytes, 7 for 64.
  [[nodiscard]] std::uint32_t payload_size_code() const noexcept { return fd() ? 7 : 0; }

  void set_up_fifos() noexcept {
    write(Value<reg::TransmitCon>()
              .set(reg::transmit_con::kPayloadSize, payload_size_code())
              .set(reg::transmit_con::kDepth, transmit_depth() - 1)
              .set(reg::transmit_con::kAttempts)
              .set(reg::transmit_con::kTransmit)
              .set(reg::transmit_con::kOnHalfEmpty));
    write(Value<reg::ReceiveCon>()
              .set(reg::receive_con::kPayloadSize, payload_size_code())
              .set(reg::receive_con::kDepth, receive_depth() - 1)
              .set(reg::receive_con::kOnOverrun)
              .set(reg::receive_con::kOnNotEmpty));
  }

  void set_filter(std::uint32_t id) noexcept {
    write(Value<reg::Fltobj0>()
              .set(reg::fltobj0::kExtended)
              .set(reg::fltobj0::kHighId, id >> 18)
              .set(reg::fltobj0::kLowId, id));
    write(Value<reg::Mask0>().set(reg::mask0::kExtended).set(reg::mask0::kHighId).set(reg::mask0::kLowId));
    write_byte<reg::Fltcon0>(
        0, Value<reg::Fltcon0>().set(reg::fltcon0::kEnable).set(reg::fltcon0::kFifo, kReceiveFifo));
  }

  bool kept(const BitTiming& nominal) noexcept {
    return read<reg::Nbtcfg>() == register_of(nominal) &&
           read<reg::TransmitCon>().get(reg::transmit_con::kDepth) == transmit_depth() - 1 &&
           read<reg::ReceiveCon>().get(reg::receive_con::kDepth) == receive_depth() - 1;
  }

  void request(Mode mode) noexcept {
    write_byte<reg::Con>(3, Value<reg::Con>().set(reg::con::kRequest, static_cast<std::uint32_t>(mode)));
  }

  // ---- transfers ------------------------------------------------------------------------------------------

  static void put_header(std::span<std::uint8_t> out, Instruction instruction,
                         std::uint16_t address) noexcept {
    out[0] = static_cast<std::uint8_t>(static_cast<unsigned>(instruction) << 4 | address >> 8);
    out[1] = static_cast<std::uint8_t>(address);
  }
  static void put_word(std::span<std::uint8_t> out, std::uint32_t word) noexcept {
    for (unsigned i = 0; i < 4; ++i) out[i] = static_cast<std::uint8_t>(word >> (8 * i));
  }
  static std::uint32_t get_word(std::span<const std::uint8_t> in) noexcept {
    std::uint32_t word = 0;
    for (unsigned i = 0; i < 4; ++i) word |= std::uint32_t{in[i]} << (8 * i);
    return word;
  }

  std::uint32_t read_word(std::uint16_t address) noexcept {
    std::array<std::uint8_t, kHeaderBytes + 4> buffer{};
    put_header(buffer, Instruction::kRead, address);
    spi_.transfer(buffer);
    return get_word(std::span(buffer).subspan(kHeaderBytes));
  }
  void write_word(std::uint16_t address, std::uint32_t word) noexcept {
    std::array<std::uint8_t, kHeaderBytes + 4> buffer{};
    put_header(buffer, Instruction::kWrite, address);
    put_word(std::span(buffer).subspan(kHeaderBytes), word);
    spi_.transfer(buffer);
  }

  template <class R>
  Value<R> read() noexcept {
    return Value<R>(read_word(R::kAddress));
  }

  template <class A, class B>
  struct Pair {
    Value<A> first;
    Value<B> second;
  };
  // Reads two adjacent registers at one instant.
  template <class A, class B>
  Pair<A, B> read_pair() noexcept {
    static_assert(B::kAddress == A::kAddress + 4);
    std::array<std::uint8_t, kHeaderBytes + 8> buffer{};
    put_header(buffer, Instruction::kRead, A::kAddress);
    spi_.transfer(buffer);
    return {Value<A>(get_word(std::span(buffer).subspan(kHeaderBytes))),
            Value<B>(get_word(std::span(buffer).subspan(kHeaderBytes + 4)))};
  }

  template <class R>
  void write(const Value<R>& value) noexcept {
    write_word(R::kAddress, value.word());
  }
  // Writes `count` bytes of the register from byte `first` on.
  template <class R>
  void write_bytes(unsigned first, unsigned count, const Value<R>& value) noexcept {
    std::array<std::uint8_t, kHeaderBytes + 4> buffer{};
    put_header(buffer, Instruction::kWrite, static_cast<std::uint16_t>(R::kAddress + first));
    for (unsigned i = 0; i < count; ++i) buffer[kHeaderBytes + i] = value.byte(first + i);
    spi_.transfer(std::span(buffer).first(kHeaderBytes + count));
  }
  template <class R>
  void write_byte(unsigned index, const Value<R>& value) noexcept {
    write_bytes<R>(index, 1, value);
  }

  S& spi_;
  State state_ = State::kDown;
  Mode normal_ = Mode::kNormalClassic;
  std::uint8_t payload_ = wire::kMaxClassicPayload;
  Value<reg::Int> enables_;
  unsigned room_ = 0;                      // frames that certainly fit
  std::uint16_t next_object_ = kRamBegin;  // address of the next object
};

}  // namespace groma::mcp2518fd
