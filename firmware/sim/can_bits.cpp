#include "firmware/sim/can_bits.hpp"

namespace groma::sim {

namespace {

constexpr unsigned kRunToStuff = 5;
constexpr std::uint32_t kCrc15Polynomial = 0x4599;
constexpr unsigned kCrc15Bits = 15;
constexpr unsigned kStuffCountBits = 4;
// Acknowledge slot and delimiter, end of frame; without the CRC delimiter.
constexpr unsigned kEndBits = 9;

class Coder {
 public:
  void put(bool bit) noexcept {
    if (run_ == kRunToStuff) stuff();
    emit(bit);
    const bool feedback = ((crc_ >> (kCrc15Bits - 1)) & 1U) != (bit ? 1U : 0U);
    crc_ = (crc_ << 1U) & ((1U << kCrc15Bits) - 1U);
    if (feedback) crc_ ^= kCrc15Polynomial;
  }
  // Most significant first.
  void put(std::uint32_t value, unsigned bits) noexcept {
    while (bits-- > 0) put(((value >> bits) & 1U) != 0);
  }
  void put_crc15() noexcept {
    put(crc_, kCrc15Bits);
    if (run_ == kRunToStuff) stuff();
  }
  void put_plain(unsigned bits) noexcept { (data_phase_ ? bits_.data : bits_.nominal) += bits; }
  void put_fixed_stuff(unsigned bits) noexcept {
    put_plain(bits);
    bits_.stuff += bits;
  }
  void set_data_phase(bool on) noexcept { data_phase_ = on; }
  [[nodiscard]] const CanBits& bits() const noexcept { return bits_; }

 private:
  // A stuff bit has the rate of the bit that follows it: the rate changes with the bit before it.
  void stuff() noexcept {
    ++bits_.stuff;
    emit(!last_);
  }
  void emit(bool bit) noexcept {
    put_plain(1);
    run_ = run_ != 0 && bit == last_ ? run_ + 1 : 1;
    last_ = bit;
  }

  CanBits bits_;
  std::uint32_t crc_ = 0;
  unsigned run_ = 0;
  bool last_ = true;
  bool data_phase_ = false;
};

}  // namespace

CanBits can_bits(const wire::CanFrame& frame, bool error_passive) noexcept {
  Coder coder;
  const bool fd = frame.format == wire::CanFormat::kFd;
  coder.put(false);               // SOF
  coder.put(frame.id >> 18, 11);  // the id's high bits
  coder.put(true);                // SRR
  coder.put(true);                // IDE
  coder.put(frame.id, 18);        // the id's low bits
  coder.put(false);               // RTR, or RRS
  if (fd) {
    coder.put(true);   // FDF
    coder.put(false);  // res
    coder.put(frame.bit_rate_switch);
    coder.set_data_phase(frame.bit_rate_switch);
    coder.put(error_passive);  // ESI
  } else {
    coder.put(0, 2);  // r1, r0
  }
  coder.put(wire::can_length_code(frame.size), 4);
  for (const std::uint8_t byte : frame.payload()) coder.put(byte, 8);
  if (fd) {
    // Fixed stuff bits: one before the stuff count and one after every four bits from there. The first one
    // replaces the stuff bit that the last data bits may have required.
    const unsigned crc_bits = frame.size <= 16 ? 17 : 21;
    const unsigned field_bits = kStuffCountBits + crc_bits;
    coder.put_plain(field_bits);
    coder.put_fixed_stuff((field_bits + 3) / 4);
  } else {
    coder.put_crc15();
  }
  coder.put_plain(1);  // CRC delimiter
  coder.set_data_phase(false);
  coder.put_plain(kEndBits);
  return coder.bits();
}

}  // namespace groma::sim
