// Hypotheses of what is wrong with the data of a drive, as ranges show it.
#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <optional>
#include <string_view>
#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/diagnosis/range_fit.hpp"
#include "host/diagnosis/units.hpp"

namespace groma::diagnosis {

// Of a scene that decides. By hand: enough for a gain of 1 %, few enough for a second or two.
inline constexpr std::size_t kMostRows = 3000;

// Least gain of a hypothesis without a parameter over the data as given, in log likelihood of a range. By
// hand: in all runs such a mistake costs at least four times as much.
inline constexpr double kLeastDiscreteGain = 0.1;

struct Hypothesis {
  std::function<void(Data&)> change;  // of the data, before the fit; may be empty
  std::vector<Parameters> starts{Parameters{}};
  double least_gain = 0.0;          // over the data as given, in log likelihood of a range
  double penalty = 0.0;             // beside that of its parameters, to others that explain as much
  bool resembles_odometry = false;  // a part of it looks like the errors that good odometry has
  // The finding, if the error is large and certain enough to be named.
  std::function<std::optional<Finding>(const RangeFit&)> name;
  // Whether the error is one that good runs have too. May be empty.
  std::function<bool(const RangeFit&)> is_usual;
  // Removes the estimated error from the data.
  std::function<void(const RangeFit&, Data&)> correct = [](const RangeFit&, Data&) {};
};

// `reference`: whose clock the ranges are compared with, such as "poses'". `start_s`: a further start; the
// drive is from begin_s to end_s.
[[nodiscard]] Hypothesis clock_offset(std::optional<double> start_s, std::string_view reference);
[[nodiscard]] Hypothesis clock_drift(std::optional<double> start_s, double begin_s, double end_s,
                                     std::string_view reference);
// A mistake that has no size: the data without it, and what is named.
[[nodiscard]] Hypothesis without_size(std::function<void(Data&)> change, Finding finding);
// Indices of tags.
[[nodiscard]] Hypothesis swapped_tags(std::size_t a, std::size_t b, const Data& data);
// `height_variance_m2`: how well the anchors' heights are known, together.
[[nodiscard]] Hypothesis wrong_lever_arm(std::size_t tag, const Data& data, double height_variance_m2);
// Of all tags.
[[nodiscard]] Hypothesis unit_of_lever_arms(const Unit& unit);
// All tags' y to the right.
[[nodiscard]] Hypothesis mirrored_tags();
[[nodiscard]] Hypothesis heading_offset();
[[nodiscard]] Hypothesis heading_sign();

// Ranges with their unknowns, thinned to about most_rows; the data outlives the scene.
using MakeScene = std::function<std::unique_ptr<Scene>(const Data&, std::size_t most_rows)>;
// `given`: the fit without any.
using MakeHypotheses = std::function<std::vector<Hypothesis>(const Data&, const RangeFit& given)>;

// Those of the ranges' clock and the tags' places. A clock that is far off is searched for, which takes
// longest, if `searches_clock`.
[[nodiscard]] std::vector<Hypothesis> of_clock_and_tags(const Data& data, const RangeFit& given,
                                                        const MakeScene& make_scene,
                                                        std::string_view reference,
                                                        double height_variance_m2 = 0.0,
                                                        bool searches_clock = true);

// The mistakes that are named, each corrected in the data before the next is looked for: the hypothesis under
// which the ranges are likeliest, if they are clearly likelier than as given, by `least_gain` in log
// likelihood of a range at least. `prepare` corrects errors in the data, before each search, that are no
// mistakes; may be empty.
[[nodiscard]] std::vector<Finding> find_mistakes(Data& data, const MakeScene& make_scene,
                                                 const MakeHypotheses& hypotheses_of, double least_gain = 0.0,
                                                 const std::function<void(Data&)>& prepare = {});

}  // namespace groma::diagnosis
