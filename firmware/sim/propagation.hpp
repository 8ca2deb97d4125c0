// The interface from the medium to the world: how a frame propagates from one antenna to another.
#pragma once

#include <cstdint>

namespace groma::sim {

// One frame's propagation from a transmitter to a receiver.
struct Propagation {
  bool audible = false;   // strong enough to be detected at all
  double flight_m = 0.0;  // time of flight of the first path times c, NLOS excess and pair bias included
  double receive_power_dbm = -80.0;
  double first_path_power_dbm = -80.0;
};

class PropagationModel {
 public:
  PropagationModel() = default;
  PropagationModel(const PropagationModel&) = delete;
  PropagationModel& operator=(const PropagationModel&) = delete;
  virtual ~PropagationModel() = default;

  // Symmetric in the two nodes. Repeated calls for the same instant (world time, s) give the same result.
  [[nodiscard]] virtual Propagation between(std::uint16_t transmitter, std::uint16_t receiver,
                                            double t_s) const = 0;
};

}  // namespace groma::sim
