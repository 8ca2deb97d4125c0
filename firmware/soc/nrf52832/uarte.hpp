// The serial line to the host: UARTE0 at 1 Mbaud, no flow control. No function blocks.
//
// Out: a ring, sent in pieces by DMA. In: DMA into a ring of chunks; the ENDRX_STARTRX shortcut continues
// with the next chunk, so no byte is lost if the interrupt at the end of a chunk is served within a chunk's
// duration (640 us). The controller does not report how many bytes of a chunk it has received. But a frame
// ends with a zero (frame_codec.hpp), and the ring is filled with ones first: all bytes up to the last zero
// have been received. The first byte after silence raises an interrupt; from then on received() is called
// every kPoll_us until the line is silent again.
#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/soc/nrf52832/wiring.hpp"

namespace groma::nrf52832 {

class Uarte {
 public:
  void start(const UartPins& pins) noexcept;

  // Queues the whole frame; if it does not fit, queues nothing and returns false.
  [[nodiscard]] bool write(std::span<const std::uint8_t> frame) noexcept;
  // All queued bytes have been sent.
  [[nodiscard]] bool idle() const noexcept { return head_ == tail_; }
  // A transfer's first byte has not been sent yet: the processor must not sleep, because of anomaly 109.
  [[nodiscard]] bool starting() const noexcept;

  // Received bytes up to the end of a frame or of a chunk; release() them before the next call.
  [[nodiscard]] std::span<const std::uint8_t> received(std::uint64_t now_us) noexcept;
  void release(std::size_t bytes) noexcept;
  // Received bytes that were overwritten before they were taken.
  [[nodiscard]] std::uint32_t lost() const noexcept { return lost_; }
  // When received() has to be called next; the maximum: not before an interrupt.
  [[nodiscard]] std::uint64_t next_poll_us() const noexcept;

  // UARTE0's interrupt handler.
  void on_interrupt() noexcept;

 private:
  static constexpr std::uint64_t kPoll_us = 500;
  static constexpr std::size_t kSendRing = 4096;
  static constexpr std::size_t kChunk = 64;
  static constexpr std::size_t kChunks = 12;
  static constexpr std::size_t kReceiveRing = kChunk * kChunks;
  static constexpr std::uint8_t kNotYet = 0xFF;

  void send_next() noexcept;
  // The end of the bytes that have certainly been received, in the count of taken_.
  [[nodiscard]] std::uint32_t received_end() noexcept;
  void receive_into(std::uint32_t chunk) noexcept;

  std::array<std::uint8_t, kSendRing> send_{};
  std::array<std::uint8_t, kReceiveRing> receive_{};
  // All counters wrap at 2^32.
  std::atomic<std::uint32_t> head_ = 0;     // bytes queued
  std::atomic<std::uint32_t> tail_ = 0;     // bytes sent
  std::atomic<std::uint32_t> sending_ = 0;  // bytes in the present DMA transfer
  std::atomic<std::uint32_t> filled_ = 0;   // chunks
  std::uint32_t taken_ = 0;                 // bytes
  std::uint32_t lost_ = 0;                  // bytes
  std::atomic<bool> silent_ = true;         // the next byte raises an interrupt
  std::uint64_t poll_at_us_ = 0;
};

}  // namespace groma::nrf52832
