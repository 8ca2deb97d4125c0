// A DW1000 as seen on SPI: bytes by register file, and a record of every transfer. It has no radio; tests
// write into its registers what the radio would.
#pragma once

#include <array>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <span>
#include <vector>

#include "firmware/core/dw1000/spi.hpp"

namespace groma::testing {

struct Transfer {
  bool write = false;
  std::uint8_t file = 0;
  std::uint16_t sub = 0;
  std::vector<std::uint8_t> bytes;
  dw1000::SpiSpeed speed = dw1000::SpiSpeed::kSlow;

  [[nodiscard]] std::uint64_t word() const {
    std::uint64_t value = 0;
    for (std::size_t i = 0; i < bytes.size() && i < 8; ++i) value |= std::uint64_t{bytes[i]} << (8 * i);
    return value;
  }
};

class FakeChip {
 public:
  static constexpr std::uint64_t kLocked = 1U << 1;

  FakeChip() { reset(); }

  void reset() {
    memory_.clear();
    put(0x00, 0, 0xDECA0130, 4);
    put(0x36, 0x04, 0x81020738, 4);
    status = locks && shows_lock ? kLocked : 0;
    asleep = asleep || sleeps_again;
  }
  // Time passes. The counter runs while the PLL is locked.
  void wait(std::uint32_t us) {
    waited_us += us;
    if (locks) time += std::uint64_t{us} * 63'898;
  }
  // Until so many wake-ups, and again after each reset until its always-on memory is cleared.
  void fall_asleep(int wake_ups = 1) {
    asleep = sleeps_again = true;
    wake_ups_left = wake_ups;
  }
  void select(bool low) noexcept {
    const bool long_enough = selected && !low && waited_us - selected_us >= 500;
    selected = low;
    selected_us = waited_us;
    if (!asleep || !long_enough || --wake_ups_left > 0) return;
    asleep = false;
    put(0x2C, 0x00, 0x0840, 2);
    put(0x2C, 0x06, 0x07, 1);
  }

  void write(std::span<const std::uint8_t> header, std::span<const std::uint8_t> out) noexcept {
    Transfer transfer = decode(header);
    transfer.bytes.assign(out.begin(), out.end());
    log.push_back(transfer);
    if (!transfer.write) {
      headers_bad = true;
      return;
    }
    if (asleep) return;
    if (transfer.file == 0x0F) {
      status &= ~(transfer.word() << (8 * transfer.sub));
    } else if (transfer.file == 0x2D && transfer.sub == 0x06 && (transfer.word() & 2) != 0) {
      put(0x2D, 0x0A, otp[static_cast<std::uint16_t>(get(0x2D, 0x04, 2))], 4);
    }
    if (!deaf) std::copy(out.begin(), out.end(), file(transfer.file).begin() + transfer.sub);
    if (transfer.file == 0x2C && transfer.sub == 0x02 && (transfer.word() & 6) != 0) {
      sleeps_again = get(0x2C, 0x00, 2) != 0 || get(0x2C, 0x06, 1) != 0;
    }
    if (on_write) on_write(transfer);
  }

  void read(std::span<const std::uint8_t> header, std::span<std::uint8_t> in) noexcept {
    Transfer transfer = decode(header);
    if (transfer.write) headers_bad = true;
    if (transfer.file == 0x0F) put(0x0F, 0, status | (interrupt() ? 1U : 0U), 5);
    if (transfer.file == 0x06) put(0x06, 0, time, 5);
    const auto& bytes = file(transfer.file);
    std::copy_n(bytes.begin() + transfer.sub, in.size(), in.begin());
    if (asleep) std::fill(in.begin(), in.end(), 0);
    if (absent || (speed == dw1000::SpiSpeed::kFast && slow_only)) std::fill(in.begin(), in.end(), 0xFF);
    transfer.bytes.assign(in.begin(), in.end());
    log.push_back(transfer);
  }

  void set_speed(dw1000::SpiSpeed to) noexcept { speed = to; }

  void put(std::uint8_t id, std::uint16_t sub, std::uint64_t value, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) file(id)[sub + i] = static_cast<std::uint8_t>(value >> (8 * i));
  }
  void put(std::uint8_t id, std::span<const std::uint8_t> bytes) {
    std::copy(bytes.begin(), bytes.end(), file(id).begin());
  }
  [[nodiscard]] std::uint64_t get(std::uint8_t id, std::uint16_t sub, std::size_t count) {
    std::uint64_t value = 0;
    for (std::size_t i = 0; i < count; ++i) value |= std::uint64_t{file(id)[sub + i]} << (8 * i);
    return value;
  }

  // The interrupt line.
  [[nodiscard]] bool interrupt() { return (status & get(0x0E, 0, 4)) != 0; }

  [[nodiscard]] std::vector<Transfer> writes() const {
    std::vector<Transfer> out;
    for (const Transfer& t : log) {
      if (t.write) out.push_back(t);
    }
    return out;
  }
  // The last value written to that register, or all ones.
  [[nodiscard]] std::uint64_t written(std::uint8_t id, std::uint16_t sub) const {
    for (auto t = log.rbegin(); t != log.rend(); ++t) {
      if (t->write && t->file == id && t->sub == sub) return t->word();
    }
    return ~std::uint64_t{0};
  }

  std::uint64_t status = 0;
  std::uint64_t time = 0;
  std::map<std::uint16_t, std::uint32_t> otp;
  bool locks = true;
  bool shows_lock = true;  // by CPLOCK
  bool absent = false;
  bool asleep = false;        // reads give zeros, writes have no effect
  bool sleeps_again = false;  // after a reset
  int wake_ups_left = 0;
  std::uint64_t waited_us = 0;
  bool selected = false;          // without a transfer
  std::uint64_t selected_us = 0;  // waited_us at the last select()
  bool slow_only = false;
  bool deaf = false;  // writes have no effect
  bool headers_bad = false;
  dw1000::SpiSpeed speed = dw1000::SpiSpeed::kFast;
  std::vector<Transfer> log;
  std::function<void(const Transfer&)> on_write;

 private:
  [[nodiscard]] Transfer decode(std::span<const std::uint8_t> header) {
    Transfer t;
    t.speed = speed;
    t.write = (header[0] & 0x80) != 0;
    t.file = header[0] & 0x3F;
    std::size_t length = 1;
    if ((header[0] & 0x40) != 0) {
      length = 2;
      t.sub = header[1] & 0x7F;
      if ((header[1] & 0x80) != 0) {
        length = 3;
        t.sub = static_cast<std::uint16_t>(t.sub | header[2] << 7);
      }
    }
    if (header.size() != length) headers_bad = true;
    return t;
  }
  std::vector<std::uint8_t>& file(std::uint8_t id) {
    auto& bytes = memory_[id];
    if (bytes.empty()) bytes.resize(0x3000);
    return bytes;
  }

  std::map<std::uint8_t, std::vector<std::uint8_t>> memory_;
};

}  // namespace groma::testing
