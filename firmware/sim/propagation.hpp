// What the medium asks of the world: how a frame gets from one antenna to another.
#pragma once

#include <cstdint>

namespace groma::sim {

// One frame's way from a transmitter to a receiver.
struct Propagation {
  bool audible = false;   // strong enough to be detected at all
  double flight_m = 0.0;  // time of flight of the first path times c: geometry, bends, pair bias and all
  double receive_power_dbm = -80.0;
  double first_path_power_dbm = -80.0;
};

class PropagationModel {
 public:
  PropagationModel() = default;
  PropagationModel(const PropagationModel&) = delete;
  PropagationModel& operator=(const PropagationModel&) = delete;
  virtual ~PropagationModel() = default;

  // Symmetric in the two nodes, and the same whenever it is asked for the same instant (world time, s).
  [[nodiscard]] virtual Propagation between(std::uint16_t transmitter, std::uint16_t receiver,
                                            double t_s) const = 0;
};

}  // namespace groma::sim
