// Chips on one medium, driven register by register, without the driver.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <utility>
#include <vector>

#include "firmware/sim/dw1000_chip.hpp"
#include "firmware/sim/medium.hpp"
#include "firmware/sim/propagation.hpp"

namespace groma::sim {

inline constexpr SimTime kMicrosecond = kUnitsPerMicrosecond;
inline constexpr SimTime kMillisecond = kUnitsPerMillisecond;
inline constexpr std::uint64_t kMask40 = (std::uint64_t{1} << 40) - 1;
inline constexpr std::uint64_t kTicksPerMicrosecond = 63'898;  // nearly
// Distance that light travels in one tick.
inline constexpr double kMetresPerTick = 299'792'458.0 / 63.8976e9;

// Given propagation between pairs of nodes; a default between all others.
class DistanceTable final : public PropagationModel {
 public:
  void set(std::uint16_t a, std::uint16_t b, const Propagation& propagation) {
    table_[{std::min(a, b), std::max(a, b)}] = propagation;
  }
  void set_default(const Propagation& propagation) { default_ = propagation; }

  [[nodiscard]] Propagation between(std::uint16_t a, std::uint16_t b, double /*t_s*/) const override {
    const auto entry = table_.find({std::min(a, b), std::max(a, b)});
    return entry == table_.end() ? default_ : entry->second;
  }

 private:
  std::map<std::pair<std::uint16_t, std::uint16_t>, Propagation> table_;
  Propagation default_{.audible = true, .flight_m = 0.0};
};

// One chip and the current time of its bus.
class HandDriven {
 public:
  HandDriven(const ChipSpec& spec, Medium& medium) : chip_(spec, medium) {}

  [[nodiscard]] Dw1000Chip& chip() { return chip_; }
  SimTime t = 0;
  std::uint32_t hz = 8'000'000;

  void write_bytes(std::uint8_t file, std::uint16_t offset, const std::vector<std::uint8_t>& bytes) {
    chip_.write(t, header(true, file, offset), bytes, hz);
  }
  void write(std::uint8_t file, std::uint16_t offset, std::uint64_t value, std::size_t count) {
    std::vector<std::uint8_t> bytes(count);
    for (std::size_t i = 0; i < count; ++i) bytes[i] = static_cast<std::uint8_t>(value >> (8 * i));
    write_bytes(file, offset, bytes);
  }
  std::vector<std::uint8_t> read_bytes(std::uint8_t file, std::uint16_t offset, std::size_t count) {
    std::vector<std::uint8_t> bytes(count);
    chip_.read(t, header(false, file, offset), bytes, hz);
    return bytes;
  }
  std::uint64_t read(std::uint8_t file, std::uint16_t offset, std::size_t count) {
    const std::vector<std::uint8_t> bytes = read_bytes(file, offset, count);
    std::uint64_t value = 0;
    for (std::size_t i = bytes.size(); i-- > 0;) value = value << 8 | bytes[i];
    return value;
  }

  // Reset, crystal clock, LDE, PLL, channel 5 at PRF 64 MHz, as in the manual. Takes 5 ms from t.
  void bring_up(std::uint16_t preamble = 128, bool load_lde = true) {
    chip_.set_power(true, t);
    t += 4 * kMillisecond;
    hz = 2'000'000;
    if (load_lde) {
      write(0x36, 0x00, 0x0301, 2);
      write(0x2D, 0x06, 0x8000, 2);
      t += 150 * kMicrosecond;
      write(0x36, 0x00, 0x0200, 2);
    }
    hz = 8'000'000;
    configure(preamble);
    t += 850 * kMicrosecond;
    chip_.advance(t);
  }

  void configure(std::uint16_t preamble) {
    const bool is_short = preamble == 64;
    const bool is_long = preamble == 256;
    write(0x04, 0x00, 0x00041200, 4);
    write(0x1F, 0x00, 0x4A480055, 4);
    write(0x23, 0x04, 0x889B, 2);
    write(0x23, 0x0C, 0x2502A907, 4);
    write(0x23, 0x12, 0x0035, 2);
    write(0x27, 0x02, 0x0001, 2);
    write(0x27, 0x04, 0x008D, 2);
    write(0x27, 0x06, is_short ? 0x0010 : 0x0020, 2);
    write(0x27, 0x08, is_long ? 0x333B00BE : 0x313B006B, 4);
    write(0x27, 0x20, is_short ? 65 : is_long ? 249 : 129, 2);
    write(0x27, 0x26, is_short ? 0x0010 : 0x0028, 2);
    write(0x28, 0x0B, 0xD8, 1);
    write(0x28, 0x0C, 0x001E3FE3, 4);
    write(0x2A, 0x0B, 0xB5, 1);
    write(0x2B, 0x07, 0x0800041D, 4);
    write(0x2B, 0x0B, 0xBE, 1);
    write(0x2E, 0x0806, 0x6D, 1);
    write(0x2E, 0x1806, 0x0607, 2);
    write(0x2E, 0x2804, 0x28F4, 2);
    write(0x18, 0x00, 16436, 2);
    write(0x2E, 0x1804, 16436, 2);
    fctrl_ = is_short ? 0x0006C000 : is_long ? 0x0026C000 : 0x0016C000;
    symbols_ = preamble;
  }

  // Payload and frame check.
  void load(const std::vector<std::uint8_t>& payload) {
    write_bytes(0x09, 0x00, payload);
    write(0x08, 0x00, fctrl_ | (payload.size() + 2), 5);
  }
  void send_now() { write(0x0D, 0x00, 0x02, 4); }
  // The PMSC write works around erratum TX-1.
  void send_at(std::uint64_t dx_time) {
    write(0x36, 0x00, 0x0220, 2);
    write(0x0A, 0x00, dx_time & kMask40, 5);
    write(0x0D, 0x00, 0x06, 1);
  }
  void receive_now() { write(0x0D, 0x00, 0x0100, 2); }
  void receive_at(std::uint64_t dx_time) {
    write(0x0A, 0x00, dx_time & kMask40, 5);
    write(0x0D, 0x00, 0x0300, 2);
  }
  void receiver_reset(bool turn_off = true) {
    if (turn_off) off();
    write(0x36, 0x03, 0xE0, 1);
    write(0x36, 0x03, 0xF0, 1);
  }
  void off() { write(0x0D, 0x00, 0x40, 4); }
  void limit_frame_wait(std::uint16_t uus) {
    write(0x04, 0x00, 0x10041200, 4);
    write(0x0C, 0x00, uus, 2);
  }

  std::uint64_t status() { return read(0x0F, 0x00, 5); }
  std::uint64_t transmit_timestamp() { return read(0x17, 0x00, 5); }
  std::uint64_t receive_timestamp() { return read(0x15, 0x00, 5); }
  std::uint64_t system_time() { return read(0x06, 0x00, 5); }
  [[nodiscard]] std::uint16_t symbols() const { return symbols_; }

 private:
  static std::vector<std::uint8_t> header(bool write, std::uint8_t file, std::uint16_t offset) {
    const auto first = static_cast<std::uint8_t>((write ? 0x80 : 0) | file);
    if (offset == 0) return {first};
    const auto with_offset = static_cast<std::uint8_t>(first | 0x40);
    if (offset < 128) return {with_offset, static_cast<std::uint8_t>(offset)};
    return {with_offset, static_cast<std::uint8_t>(0x80 | (offset & 0x7F)),
            static_cast<std::uint8_t>(offset >> 7)};
  }

  Dw1000Chip chip_;
  std::uint64_t fctrl_ = 0;
  std::uint16_t symbols_ = 128;
};

class RadioBench {
 public:
  explicit RadioBench(const MediumSettings& settings = {.timestamp_noise_s = 0.0, .carrier_noise_ppm = 0.0},
                      std::uint64_t seed = 1)
      : medium(space, settings, seed) {}

  HandDriven& add(const ChipSpec& spec) {
    nodes_.push_back(std::make_unique<HandDriven>(spec, medium));
    return *nodes_.back();
  }

  // Advances all chips to `t`, in the order of their events.
  void run_until(SimTime t) {
    for (;;) {
      HandDriven* next = nullptr;
      for (const auto& node : nodes_)
        if (next == nullptr || node->chip().next_event() < next->chip().next_event()) next = node.get();
      if (next == nullptr || next->chip().next_event() > t) break;
      next->chip().advance(next->chip().next_event());
    }
    for (const auto& node : nodes_) {
      node->chip().advance(t);
      node->t = std::max(node->t, t);
    }
  }

  DistanceTable space;
  Medium medium;

 private:
  std::vector<std::unique_ptr<HandDriven>> nodes_;
};

}  // namespace groma::sim
