// A clock that is late by an offset and drifts.
#pragma once

namespace groma::model {

// Times are late by offset_s + drift (t_s - reference_s).
struct ClockError {
  double offset_s = 0.0;
  double drift = 0.0;  // s/s
  double reference_s = 0.0;

  // The true time of a sample with the timestamp t_s.
  [[nodiscard]] double corrected_s(double t_s) const noexcept {
    return t_s - offset_s - drift * (t_s - reference_s);
  }
};

}  // namespace groma::model
