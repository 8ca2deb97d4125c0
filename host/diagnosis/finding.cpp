#include "host/diagnosis/finding.hpp"

#include <fmt/format.h>

namespace groma::diagnosis {

Finding map_mismatch(std::optional<double> share) {
  return {.cause = "map-mismatch",
          .evidence = share ? fmt::format("{:.0f} % of the ranges contradict the calibration, at any pose",
                                          100.0 * *share)
                            : "no pose on this calibration explains half of the ranges",
          .remedy =
              "load the calibration of this site; if anchors were moved or renumbered since, drive and "
              "calibrate again (groma calibrate --update)"};
}

}  // namespace groma::diagnosis
