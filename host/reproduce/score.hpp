// One localization of a drive, and what it scored against the truth.
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/evaluation/evaluation.hpp"
#include "host/filter/config.hpp"
#include "host/filter/replay.hpp"
#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"

namespace groma::reproduce {

using Json = nlohmann::ordered_json;

// Which ranges are used; an empty list: all.
struct Subset {
  std::vector<model::NodeId> tags{};
  std::vector<model::NodeId> anchors{};
};

struct Localized {
  std::vector<model::PlanarEstimate> rows;
  std::size_t ranges = 0;
  double update_ns = 0.0;     // median time of a range; 0: not measured
  double propagate_ns = 0.0;  // of an odometry sample
};

// As `groma replay` has them; none without a pose prior to start from.
[[nodiscard]] std::optional<filter::ReplayOptions> replay_options(const io::Dataset& drive,
                                                                  filter::Model model);

// The filter on the drive as `groma replay` runs it. No rows: the drive has no pose prior to start from.
[[nodiscard]] Localized localize(const io::Dataset& drive, const model::Calibration& calibration,
                                 filter::Model model, const Subset& subset = {});

// "ate_m", "ate_rad", "nees" with "mean", "max" and "std"; null if nothing could be scored.
[[nodiscard]] Json score(const std::vector<model::PlanarEstimate>& rows,
                         const std::vector<model::PoseSample>& truth);
// Position error over time, a point each step_s: [[t_s, error_m, nees], ...].
[[nodiscard]] Json error_curve(const std::vector<model::PlanarEstimate>& rows,
                               const std::vector<model::PoseSample>& truth, double step_s);
// [[x_m, y_m, t_s], ...], a point each step_s.
[[nodiscard]] Json path_of(const std::vector<model::PlanarEstimate>& rows, double step_s);
[[nodiscard]] Json path_of(const std::vector<model::PoseSample>& rows, double step_s);
// [[x_m, y_m, variance of x, covariance, variance of y], ...], one each step_s.
[[nodiscard]] Json ellipses_of(const std::vector<model::PlanarEstimate>& rows, double step_s);

// groma-baselines, which may not be there.
class Baselines {
 public:
  // The program beside this one.
  Baselines();
  [[nodiscard]] bool is_there() const noexcept { return program_.has_value(); }

  struct Estimate {
    std::vector<model::PlanarEstimate> rows;
    Json facts;  // the line that the program prints for the method
  };
  // Runs the methods on the drive, in the order of `methods`.
  // Throws io::DeviceError with what the program said.
  [[nodiscard]] std::vector<Estimate> run(const io::Dataset& drive, const model::Calibration& calibration,
                                          const std::vector<std::string>& methods, const Subset& subset,
                                          bool is_tuned, const std::filesystem::path& scratch) const;

 private:
  std::optional<std::filesystem::path> program_;
};

}  // namespace groma::reproduce
