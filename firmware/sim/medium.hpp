// The air between the nodes: who hears which frame, when, how strong, and how well.
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
  double stamp_noise_s = 1e-10;     // standard deviation of each receive stamp
  double carrier_noise_ppm = 0.05;  // of the clock offset that a receiver measures of a frame's carrier
  double loss_probability = 0.0;    // of each frame at each receiver, beyond what the propagation model says
  double capture_db = 6.0;          // by which the stronger of two overlapping frames outdoes the other
};

// How a frame fails at a receiver by the draw of loss_probability.
enum class Loss : std::uint8_t {
  kNone,
  kUnheard,  // no preamble found: half of the losses
  kSfd,      // preamble found, but no start of frame: 15 %
  kHeader,   // the PHY header's code fails: 15 %
  kData,     // the frame check fails: 20 %
};

// What a receiver has to agree with to hear a frame.
struct AirFormat {
  std::uint8_t channel = 5;
  std::uint8_t prf_mhz = 64;
  std::uint8_t preamble_code = 9;
  std::uint16_t preamble_symbols = 128;
  friend bool operator==(const AirFormat&, const AirFormat&) = default;
};

// A frame on its way. Instants are those at which the transmitter's antenna radiates them.
struct AirFrame {
  std::size_t source = 0;    // the transmitter's index on the medium
  std::uint32_t number = 0;  // counts the transmitter's frames
  AirFormat format{};
  SimTime preamble_start = 0;
  SimTime rmarker = 0;  // the start of the PHY header, which stamps refer to
  SimTime data_start = 0;
  SimTime end = 0;
  SimTime cut_at = kNever;    // switched off amid the frame
  double clock_offset = 0.0;  // of the transmitter: frequency over nominal, minus 1
  bool ranging = false;       // the header's ranging bit
  std::uint16_t length = 0;   // with frame check
  std::array<std::uint8_t, 127> data{};
};

// A frame as it reaches one receiver's antenna.
struct Reception {
  bool audible = false;
  SimTime delay = 0;                 // flight, in whole units
  double delay_residue_ticks = 0.0;  // and the rest of it
  double receive_power_dbm = 0.0;
  double first_path_power_dbm = 0.0;
  double stamp_noise_ticks = 0.0;
  double carrier_noise_ppm = 0.0;
  std::uint64_t junk = 0;  // for what a receiver makes up when it is misused
  Loss loss = Loss::kNone;
};

// A stretch of time in which frames are lost beyond MediumSettings::loss_probability, each by a draw of its
// own.
struct Fade {
  SimTime from = 0;  // of the frames' RMARKERs
  SimTime until = kNever;
  double probability = 1.0;
  // As behind a wall: nothing is noticed, and the frame disturbs no other either. Otherwise frames fail as
  // by loss_probability, in any of its ways.
  bool silent = false;
  // Which frames, by their content and the ids of the two nodes; empty: all. Depends on nothing else, and
  // bears to be asked by any thread.
  std::function<bool(const AirFrame& frame, std::uint16_t transmitter, std::uint16_t receiver)> hits{};
};

// Looks on at what no node sees. Told by whichever thread runs the node that it is about.
class Witness {
 public:
  Witness() = default;
  Witness(const Witness&) = delete;
  Witness& operator=(const Witness&) = delete;
  virtual ~Witness() = default;

  // Its data are what they are now, and may change until it starts; it may be retracted.
  virtual void announced(const AirFrame& /*frame*/) {}
  // A receiver that was on did not receive `lost`, whether or not it would have cared, because of `by`.
  virtual void overlapped(const AirFrame& /*lost*/, const AirFrame& /*by*/, std::uint16_t /*receiver*/) {}
  // A receiver went off by itself: with a frame, good or not, or by a time-out; `event` of SYS_STATUS.
  virtual void reception_ended(std::uint16_t /*receiver*/, std::uint64_t /*event*/) {}
};

class Medium {
 public:
  Medium(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed);

  // The chip's index. The chip outlives the medium's use. No two chips share an id.
  std::size_t attach(Dw1000Chip& chip, std::uint16_t id);
  // The same for what only sends.
  std::size_t attach_sender(std::uint16_t id);

  // A frame that will surely be sent unless it is retracted; tells all other chips. Its data may still change
  // until it starts.
  void announce(const std::shared_ptr<const AirFrame>& frame);
  // Takes back a frame that has not started.
  void retract(const std::shared_ptr<const AirFrame>& frame);
  // The transmitter is switched off amid its frame.
  void cut(const std::shared_ptr<AirFrame>& frame, SimTime at);

  // Between the two no chip learns of what another one does: each may then be driven by a thread of its own.
  void hold();
  void release();

  // How the frame reaches that chip; the same whenever it is asked.
  [[nodiscard]] Reception reception(const AirFrame& frame, std::size_t receiver) const;

  [[nodiscard]] const MediumSettings& settings() const noexcept { return settings_; }
  void set_settings(const MediumSettings& settings) noexcept { settings_ = settings; }
  // Not while the network runs. A fade that is over by `now` is forgotten.
  void add_fade(Fade fade, SimTime now);
  // Nothing: nobody. The witness outlives the medium's use.
  void set_witness(Witness* witness) noexcept { witness_ = witness; }
  [[nodiscard]] Witness* witness() const noexcept { return witness_; }
  [[nodiscard]] std::uint16_t id_of(std::size_t station) const { return stations_.at(station).id; }

 private:
  // What a chip did while news were held.
  struct News {
    enum class Kind : std::uint8_t { kAnnounced, kRetracted, kCut };
    Kind kind;
    std::shared_ptr<const AirFrame> frame;
    std::shared_ptr<AirFrame> cut_frame;
    SimTime at;
  };
  struct Station {
    Dw1000Chip* chip;  // null for one that only sends
    std::uint16_t id;
    std::vector<News> held;
  };
  void tell(std::size_t source, const News& news);
  void spread(std::size_t source, const News& news);
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
  mutable std::mutex propagation_mutex_;  // the model answers one thread at a time
};

}  // namespace groma::sim
