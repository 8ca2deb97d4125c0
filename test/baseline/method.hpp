// The interface of the methods, their parameters, and the loop that runs one over a drive.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/model/types.hpp"
#include "test/baseline/drive.hpp"
#include "test/baseline/motion.hpp"

namespace groma::baseline {

// The defaults are the plain method; each method uses some.
struct Parameters {
  double range_factor = 1.0;     // on the sigma of ranges
  double odometry_factor = 1.0;  // on the sigmas of odometry
  double gate = 0.0;             // sigmas of the innovation beyond which a range is rejected; 0: no gate
  double kernel = 0.0;           // sigmas: scale of the robust kernel; 0: none
  double window_s = 0.2;         // trilateration: of one fix; ceres-window: of the factor graph
  double particles = 1000.0;
  double outlier_share = 0.0;  // particle filter: share of ranges with a uniform error
};

// The odometry sample that is held, and the error model's factor: its errors are constant over its interval,
// so that a part of the interval has that part of the variance.
struct Held {
  model::OdometrySample sample;
  double interval_s = 0.02;
};

class Method {
 public:
  Method() = default;
  Method(const Method&) = delete;
  Method& operator=(const Method&) = delete;
  virtual ~Method() = default;

  // A new odometry sample is held from now on.
  virtual void hold(const Held& held) { held_ = held; }
  // dt_s > 0 passes at the held sample's velocity.
  virtual void move(double dt_s) = 0;
  // A range measured now; false: it was rejected.
  virtual bool measure(const Range& range) = 0;
  // All samples up to now were given; t_s is an odometry sample's.
  virtual model::PlanarEstimate estimate(double t_s) = 0;
  // Anchor positions, for methods that estimate them: one for each anchor of the site; else empty.
  [[nodiscard]] virtual std::vector<Eigen::Vector3d> anchors_m() const { return {}; }
  // Whether estimate() is asked at this odometry sample. Asked once for each, in order.
  [[nodiscard]] virtual bool has_row(double /*t_s*/) { return true; }

 protected:
  Held held_;  // NOLINT(misc-non-private-member-variables-in-classes)
};

struct AnchorRow {
  double t_s = 0.0;
  std::size_t anchor = 0;
  Eigen::Vector3d position_m;
};

struct Outcome {
  std::vector<model::PlanarEstimate> rows;
  std::vector<AnchorRow> anchors;  // each second
  std::size_t ranges = 0;          // used
  std::size_t rejected = 0;
  // Mean CPU times: of a range, of an odometry sample (motion and estimate), and of both for each range.
  double ns_per_range = 0.0;
  double ns_per_odometry = 0.0;
  double ns_in_all_per_range = 0.0;
};

// One estimate for each odometry sample from the start on, causal: with all samples up to and at its time.
[[nodiscard]] Outcome run(const Drive& drive, Method& method);

// A parameter that `tune` searches, on a logarithmic scale.
struct Searched {
  std::string_view name;
  double Parameters::*value;
  double least;
  double most;
};

struct MethodInfo {
  std::string_view name;
  std::string_view text;
  Parameters plain;
  Parameters tuned;
  std::vector<Searched> searched;
  std::unique_ptr<Method> (*make)(const Drive& drive, const Parameters& parameters, std::uint64_t seed);
};
[[nodiscard]] const std::vector<MethodInfo>& methods();
// Null if there is none.
[[nodiscard]] const MethodInfo* find_method(std::string_view name);

// SplitMix64: the same numbers on every machine.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  double uniform() noexcept;  // in [0, 1)
  double gaussian() noexcept;

 private:
  std::uint64_t state_;
  double spare_ = 0.0;
  bool has_spare_ = false;
};

}  // namespace groma::baseline
