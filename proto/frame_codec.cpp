#include "proto/frame_codec.hpp"

namespace groma::wire {
namespace {

constexpr std::uint8_t kFullBlock = 0xFF;  // 254 bytes, not followed by a zero

std::uint32_t load_little_endian(const std::uint8_t* bytes) noexcept {
  return static_cast<std::uint32_t>(bytes[0]) | static_cast<std::uint32_t>(bytes[1]) << 8 |
         static_cast<std::uint32_t>(bytes[2]) << 16 | static_cast<std::uint32_t>(bytes[3]) << 24;
}

}  // namespace

FrameWriter::FrameWriter(std::span<std::uint8_t> out) noexcept : out_(out.data()) {
  out_[0] = 0;
  crc_.add(kFrameVersion);
  add(kFrameVersion);
}

void FrameWriter::put(std::span<const std::uint8_t> payload) noexcept {
  for (const std::uint8_t byte : payload) {
    crc_.add(byte);
    add(byte);
  }
}

std::size_t FrameWriter::finish() noexcept {
  const std::uint32_t check = crc_.value();
  for (unsigned shift = 0; shift < 32; shift += 8) add(static_cast<std::uint8_t>(check >> shift));
  out_[block_] = static_cast<std::uint8_t>(end_ - block_);
  out_[end_++] = 0;
  return end_;
}

void FrameWriter::add(std::uint8_t byte) noexcept {
  if (byte != 0) out_[end_++] = byte;
  const std::size_t code = end_ - block_;
  if (byte != 0 && code != kFullBlock) return;
  out_[block_] = static_cast<std::uint8_t>(code);
  block_ = end_++;
}

std::size_t encode_frame(std::span<const std::uint8_t> payload, std::span<std::uint8_t> out) noexcept {
  if (payload.size() > kMaxPayload || out.size() < max_encoded_size(payload.size())) return 0;
  FrameWriter writer(out);
  writer.put(payload);
  return writer.finish();
}

bool FrameDecoder::push(std::uint8_t byte) noexcept {
  if (byte == 0) return finish();
  ++received_;
  if (left_in_block_ == 0) {
    if (zero_due_) store(0);
    left_in_block_ = static_cast<std::uint8_t>(byte - 1);
    zero_due_ = byte != kFullBlock;
  } else {
    store(byte);
    --left_in_block_;
  }
  return false;
}

void FrameDecoder::reset() noexcept {
  counters_.bytes_discarded += static_cast<std::uint32_t>(received_);
  begin();
}

void FrameDecoder::store(std::uint8_t byte) noexcept {
  if (size_ == buffer_.size()) {
    overflow_ = true;
    return;
  }
  buffer_[size_++] = byte;
}

void FrameDecoder::begin() noexcept {
  size_ = 0;
  received_ = 0;
  left_in_block_ = 0;
  zero_due_ = false;
  overflow_ = false;
}

bool FrameDecoder::finish() noexcept {
  if (received_ == 0) return false;  // between two frames
  std::uint32_t* error = nullptr;
  if (overflow_) {
    error = &counters_.oversize;
  } else if (left_in_block_ != 0) {
    error = &counters_.cobs_errors;
  } else if (size_ < kFrameOverhead) {
    error = &counters_.truncated;
  } else {
    const std::span<const std::uint8_t> covered(buffer_.data(), size_ - 4);
    if (crc32(covered) != load_little_endian(buffer_.data() + covered.size())) {
      error = &counters_.crc_errors;
    } else if (buffer_[0] != kFrameVersion) {
      error = &counters_.version_errors;
    }
  }
  if (error != nullptr) {
    ++*error;
    counters_.bytes_discarded += static_cast<std::uint32_t>(received_);
  } else {
    ++counters_.frames;
    payload_size_ = size_ - kFrameOverhead;
    encoded_size_ = received_ + 2;
  }
  const bool ready = error == nullptr;
  begin();
  return ready;
}

}  // namespace groma::wire
