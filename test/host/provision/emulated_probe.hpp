// A debug probe on a socket: OpenOCD's remote_bitbang adapter drives its pins, which connect to a JTAG-DP
// with a MEM-AP and the CTRL-AP of an emulated part. Sources: OpenOCD's manual, remote_bitbang.txt; IEEE
// 1149.1 (the state machine); ARM IHI 0031 (debug port and access ports).
#pragma once

#include <atomic>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include "host/io/descriptor.hpp"
#include "test/host/provision/emulated_part.hpp"

namespace groma::provision::test {

// The four JTAG wires.
class JtagPort {
 public:
  // Keeps the pointer to the part; null: nothing is wired to the probe.
  explicit JtagPort(EmulatedPart* part) : part_(part) {}

  void set(bool tck, bool tms, bool tdi);
  [[nodiscard]] bool tdo() const noexcept { return part_ == nullptr || (shift_ & 1U) != 0; }

 private:
  enum class State : std::uint8_t {
    kReset,
    kIdle,
    kSelectDr,
    kCaptureDr,
    kShiftDr,
    kExit1Dr,
    kPauseDr,
    kExit2Dr,
    kUpdateDr,
    kSelectIr,
    kCaptureIr,
    kShiftIr,
    kExit1Ir,
    kPauseIr,
    kExit2Ir,
    kUpdateIr,
  };
  [[nodiscard]] static State next(State state, bool tms) noexcept;

  void capture();
  void update();
  void access_debug_port(unsigned address, bool read, std::uint32_t value);
  void access_access_port(unsigned address, bool read, std::uint32_t value);
  void access_memory(unsigned reg, bool read, std::uint32_t value);

  EmulatedPart* part_;
  bool tck_ = false;
  State state_ = State::kReset;
  std::uint8_t instruction_ = 0xE;  // IDCODE
  std::uint64_t shift_ = 0;
  unsigned shift_bits_ = 32;
  // Debug port
  std::uint32_t result_ = 0;  // of the previous access
  std::uint32_t select_ = 0;
  std::uint32_t control_ = 0;
  bool sticky_error_ = false;
  // Memory access port
  std::uint32_t csw_ = 0;
  std::uint32_t tar_ = 0;
};

class EmulatedProbe {
 public:
  // Listens at `socket`. part: as for JtagPort.
  EmulatedProbe(std::filesystem::path socket, EmulatedPart* part);
  ~EmulatedProbe();
  EmulatedProbe(const EmulatedProbe&) = delete;
  EmulatedProbe& operator=(const EmulatedProbe&) = delete;

  // Called after each batch of pin changes; true: unplugs the probe.
  void set_unplug(std::function<bool()> unplug);
  [[nodiscard]] int sessions() const { return sessions_; }

 private:
  void run();
  void serve(int client);

  std::filesystem::path socket_;
  EmulatedPart* part_;
  io::Descriptor listening_;
  std::mutex mutex_;
  std::function<bool()> unplug_;
  std::atomic<bool> stop_ = false;
  std::atomic<int> sessions_ = 0;
  std::thread thread_;
};

}  // namespace groma::provision::test
