// The serial line to the host: UARTE0 at 1 Mbaud, no flow control. Nothing here waits for it.
//
// Out: a ring, sent in pieces by DMA. In: DMA into a ring of chunks, one after the other by the ENDRX_STARTRX
// shortcut, so that no byte is lost as long as an interrupt a chunk is served within a chunk's time (640 us).
// The controller does not tell how many bytes of a chunk have come. But a frame ends with a zero
// (frame_codec.hpp), and the ring is filled with ones beforehand: all up to the last zero found has come. The
// first byte after a silence interrupts, from then on received() is asked every kPoll_us until the line is
// silent again.
#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <span>

namespace groma::dwm1001 {

class Uarte {
 public:
  void start() noexcept;

  // Queues all of it or, where it does not fit, nothing and returns false.
  [[nodiscard]] bool write(std::span<const std::uint8_t> frame) noexcept;
  // All that was queued is on the line.
  [[nodiscard]] bool idle() const noexcept { return head_ == tail_; }

  // Bytes that have come, up to the end of a frame or of a chunk; release() them before the next call.
  [[nodiscard]] std::span<const std::uint8_t> received(std::uint64_t now_us) noexcept;
  void release(std::size_t bytes) noexcept;
  // Bytes that have come and were overwritten before they were taken.
  [[nodiscard]] std::uint32_t lost() const noexcept { return lost_; }
  // When received() wants to be called next; the maximum: not before an interrupt.
  [[nodiscard]] std::uint64_t next_poll_us() const noexcept;

  // For its vector.
  void on_interrupt() noexcept;

 private:
  static constexpr std::uint64_t kPoll_us = 500;
  static constexpr std::size_t kSendRing = 4096;
  static constexpr std::size_t kChunk = 64;
  static constexpr std::size_t kChunks = 12;
  static constexpr std::size_t kReceiveRing = kChunk * kChunks;
  static constexpr std::uint8_t kNotYet = 0xFF;

  void send_next() noexcept;
  // Up to where the bytes have come for certain, counted as taken_ is.
  [[nodiscard]] std::uint32_t certain_end() noexcept;
  void receive_into(std::uint32_t chunk) noexcept;

  // Static, for there is one UARTE: so they take no flash.
  static inline std::array<std::uint8_t, kSendRing> send_{};
  static inline std::array<std::uint8_t, kReceiveRing> receive_{};
  // All counters run on and wrap at 2^32; the rings' sizes divide that.
  std::atomic<std::uint32_t> head_ = 0;     // bytes queued
  std::atomic<std::uint32_t> tail_ = 0;     // bytes sent
  std::atomic<std::uint32_t> sending_ = 0;  // bytes under way
  std::atomic<std::uint32_t> filled_ = 0;   // chunks
  std::uint32_t taken_ = 0;                 // bytes
  std::uint32_t lost_ = 0;                  // bytes
  std::atomic<bool> silent_ = true;         // the next byte interrupts
  std::uint64_t poll_at_us_ = 0;
};

}  // namespace groma::dwm1001
