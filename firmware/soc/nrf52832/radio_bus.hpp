// The DW1000 on SPIM2. Implements the driver's SPI interface (firmware/core/dw1000/spi.hpp).
#pragma once

#include <array>
#include <cstdint>
#include <cstring>
#include <span>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/dw1000/spi.hpp"
#include "firmware/soc/nrf52832/spim.hpp"

namespace groma::nrf52832 {

class RadioBus {
 public:
  explicit constexpr RadioBus(const SpiPins& pins) noexcept : spim_(spim::kBase2, pins) {}

  void start() noexcept { spim_.start(SpiFrequency::k2MHz); }

  void write(std::span<const std::uint8_t> header, std::span<const std::uint8_t> out) noexcept {
    put(header);
    std::memcpy(buffer_.data() + header.size(), out.data(), out.size());
    spim_.transfer(std::span(buffer_).first(header.size() + out.size()), {});
  }

  void read(std::span<const std::uint8_t> header, std::span<std::uint8_t> in) noexcept {
    put(header);
    spim_.transfer(std::span(buffer_).first(header.size()),
                   std::span(buffer_).first(header.size() + in.size()));
    std::memcpy(in.data(), buffer_.data() + header.size(), in.size());
  }

  void set_speed(dw1000::SpiSpeed speed) noexcept {
    spim_.set_frequency(speed == dw1000::SpiSpeed::kFast ? SpiFrequency::k8MHz : SpiFrequency::k2MHz);
  }

  void select(bool low) noexcept { spim_.select(low); }

 private:
  // Header and body are copied to one buffer in RAM: EasyDMA cannot read flash, and erratum 58 forbids
  // transfers of one byte.
  void put(std::span<const std::uint8_t> header) noexcept {
    buffer_[0] = header[0];
    if (header.size() > 1) buffer_[1] = header[1];
    if (header.size() > 2) buffer_[2] = header[2];
  }

  static constexpr std::size_t kHeaderBytes = 3;

  Spim spim_;
  std::array<std::uint8_t, kHeaderBytes + dw1000::kMaxFrameBytes> buffer_{};
};

static_assert(dw1000::Spi<RadioBus>);

}  // namespace groma::nrf52832
