// The radio channel between the nodes: which receiver gets which frame, when, and at which power.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <vector>

#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/propagation.hpp"
#include "firmware/sim/time.hpp"

namespace groma::sim {

class Dw1000Chip;

struct MediumSettings {
  double timestamp_noise_s = 1e-10;  // standard deviation of a receive timestamp
  double carrier_noise_ppm = 0.05;   // standard deviation of the clock offset measured on a frame's carrier
  double loss_probability = 0.0;     // of each frame at each receiver, in addition to the propagation model
  double capture_db = 6.0;  // power ratio at which the stronger of two overlapping frames is received
};

// How a frame that loss_probability selects fails at a receiver.
enum class Loss : std::uint8_t {
  kNone,
  kUnheard,  // preamble not detected: half of the losses
  kSfd,      // preamble detected, but no start-of-frame delimiter: 15 %
  kHeader,   // error in the PHY header: 15 %
  kData,     // error in the data: 20 %
};

// The physical-layer parameters that a receiver must share to receive a frame.
struct AirFormat {
  std::uint8_t channel = 5;
  std::uint8_t prf_mhz = 64;
  std::uint8_t preamble_code = 9;
  std::uint16_t preamble_symbols = 128;
  friend bool operator==(const AirFormat&, const AirFormat&) = default;
};

// A frame on the air. All instants are at the transmitter's antenna.
struct AirFrame {
  std::size_t source = 0;    // the transmitter's index on the medium
  std::uint32_t number = 0;  // counts the transmitter's frames
  AirFormat format{};
  SimTime preamble_start = 0;
  SimTime rmarker = 0;  // the start of the PHY header, to which timestamps refer
  SimTime data_start = 0;
  SimTime end = 0;
  SimTime cut_at = kNever;    // the transmitter was switched off during the frame
  double clock_offset = 0.0;  // of the transmitter: frequency over nominal, minus 1
  bool ranging = false;       // the header's ranging bit
  std::uint16_t length = 0;   // bytes, with the frame check
  std::array<std::uint8_t, 127> data{};
};

// A frame at one receiver's antenna.
struct Reception {
  bool audible = false;
  SimTime delay = 0;                 // time of flight, whole units
  double delay_residue_ticks = 0.0;  // the remaining fraction of the time of flight
  double receive_power_dbm = 0.0;
  double first_path_power_dbm = 0.0;
  double timestamp_noise_ticks = 0.0;
  double carrier_noise_ppm = 0.0;
  std::uint64_t junk = 0;  // random bits for invalid results
  Loss loss = Loss::kNone;
};

// A period in which frames are lost in addition to MediumSettings::loss_probability, each by its own draw.
struct Fade {
  SimTime from = 0;  // of the frames' RMARKERs
  SimTime until = kNever;
  double probability = 1.0;
  // True: the receiver does not detect the frame, and the frame disturbs no other. False: frames fail in any
  // of the ways of loss_probability.
  bool silent = false;
  // Selects frames by their content and the ids of the two nodes; empty: all. Must depend on nothing else and
  // be callable from any thread.
  std::function<bool(const AirFrame& frame, std::uint16_t transmitter, std::uint16_t receiver)> hits{};
};

// Observes events that no node sees. Called by the thread that runs the node concerned.
class Witness {
 public:
  Witness() = default;
  Witness(const Witness&) = delete;
  Witness& operator=(const Witness&) = delete;
  virtual ~Witness() = default;

  // The frame's data may still change until it starts, and it may be retracted.
  virtual void announced(const AirFrame& /*frame*/) {}
  // A receiver that was on did not receive `lost` because of `by`. `lost` need not have been meant for it.
  virtual void overlapped(const AirFrame& /*lost*/, const AirFrame& /*by*/, std::uint16_t /*receiver*/) {}
  // A receiver switched itself off after a frame, good or bad, or a time-out; `event`: bits of SYS_STATUS.
  virtual void reception_ended(std::uint16_t /*receiver*/, std::uint64_t /*event*/) {}
};

class Medium {
 public:
  Medium(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed);

  // Returns the chip's index. The chip must live while the medium is used. No two chips may share an id.
  std::size_t attach(Dw1000Chip& chip, std::uint16_t id);
  // The same for a station that only sends.
  std::size_t attach_sender(std::uint16_t id);

  // Announces a frame to all other chips. It will be sent unless it is retracted. Its data may still change
  // until it starts.
  void announce(const std::shared_ptr<const AirFrame>& frame);
  // Retracts a frame that has not started.
  void retract(const std::shared_ptr<const AirFrame>& frame);
  // The transmitter is switched off during its frame.
  void cut(const std::shared_ptr<AirFrame>& frame, SimTime at);

  // Between hold() and release() chips are not notified of each other's actions: each may then be driven by a
  // thread of its own.
  void hold();
  void release();

  // How the frame reaches the chip with this index. Repeated calls give the same result.
  [[nodiscard]] Reception reception(const AirFrame& frame, std::size_t receiver) const;

  [[nodiscard]] const MediumSettings& settings() const noexcept { return settings_; }
  void set_settings(const MediumSettings& settings) noexcept { settings_ = settings; }
  // Not while the network runs. Removes fades that ended before `now`.
  void add_fade(Fade fade, SimTime now);
  // Null: none. The witness must live while the medium is used.
  void set_witness(Witness* witness) noexcept { witness_ = witness; }
  [[nodiscard]] Witness* witness() const noexcept { return witness_; }
  [[nodiscard]] std::uint16_t id_of(std::size_t station) const { return stations_.at(station).id; }
  // The draws of this medium's seed, for the chips on it.
  [[nodiscard]] const KeyedRandom& random() const noexcept { return random_; }

 private:
  // An action of a chip that other chips are notified of.
  struct Notice {
    enum class Kind : std::uint8_t { kAnnounced, kRetracted, kCut };
    Kind kind;
    std::shared_ptr<const AirFrame> frame;
    std::shared_ptr<AirFrame> cut_frame;
    SimTime at;
  };
  struct Station {
    Dw1000Chip* chip;  // null for a station that only sends
    std::uint16_t id;
    std::vector<Notice> pending;
  };
  void post(std::size_t source, const Notice& notice);
  void deliver(std::size_t source, const Notice& notice);
  void fade(const AirFrame& frame, std::uint16_t from, std::uint16_t to, Reception& reception) const;

  const PropagationModel& propagation_;
  MediumSettings settings_;
  KeyedRandom random_;
  std::vector<Station> stations_;
  struct NumberedFade {
    Fade fade;
    std::uint64_t number;  // keys its draws
  };
  std::vector<NumberedFade> fades_;
  std::uint64_t fades_added_ = 0;
  Witness* witness_ = nullptr;
  bool holding_ = false;
  mutable std::mutex propagation_mutex_;  // the model is not thread-safe
};

}  // namespace groma::sim
