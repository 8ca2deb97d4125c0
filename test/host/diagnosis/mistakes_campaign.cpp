// Each mistake on simulated sites and recorded runs, at three sizes where it has one: how often its cause is
// named first, with the right size, and how often another one, by what each command has. Then two mistakes at
// once, mistakes that are too small to matter, drives without any, and how small a mistake worsens anchors or
// poses by half. Prints tables. GROMA_LAST_SEED seeds a site, by default 3; the recorded runs beside the
// repository are used if they are there.
#include <fmt/format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <initializer_list>
#include <limits>
#include <map>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/diagnosis/diagnose.hpp"
#include "host/evaluation/evaluation.hpp"
#include "host/filter/replay.hpp"
#include "host/io/dataset.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/host/diagnosis/mistakes.hpp"
#include "test/support/shared_data.hpp"

namespace groma::diagnosis {
namespace {

// A simulated drive with odometry: white noise, a scale of 1 % and a yaw-rate bias. The robot swings about
// its course, so that it also moves sideways.
Data simulated_drive(test::Route route, std::uint64_t seed) {
  const test::SimulatedSite site = test::simulate_site({.route = route,
                                                        .ranges_per_pair = 250,
                                                        .outlier_share = 0.05,
                                                        .pose_sigma_m = 0.02,
                                                        .pose_yaw_sigma_rad = 0.005},
                                                       seed);
  test::Random random(seed + 1000);
  Data data{.poses = site.poses,
            .odometry = {},
            .ranges = site.ranges,
            .dropped_ranges = {},
            .tags = site.tags,
            .anchors = site.anchors,
            .priors = site.drive().priors,
            .surface = site.floor};
  for (std::size_t i = 0; i + 1 < site.truth.size(); ++i) {
    const model::PoseSample& now = site.truth[i];
    const model::PoseSample& next = site.truth[i + 1];
    const double dt_s = next.t_s - now.t_s;
    const double turn_rad = model::wrap_angle(next.yaw_rad - now.yaw_rad);
    const Eigen::Vector2d moved_m = Eigen::Rotation2Dd(-now.yaw_rad - 0.5 * turn_rad) *
                                    Eigen::Vector2d(next.x_m - now.x_m, next.y_m - now.y_m);
    data.odometry.push_back({now.t_s, 1.01 * moved_m.x() / dt_s + 0.02 * random.gaussian(),
                             1.01 * moved_m.y() / dt_s + 0.02 * random.gaussian(),
                             turn_rad / dt_s + 0.001 + 0.006 * random.gaussian()});
  }
  return data;
}

// What a command has.
enum class Command { kCheck, kCalibrate, kReplay, kGromad };
constexpr std::array kCommands{Command::kCheck, Command::kCalibrate, Command::kReplay, Command::kGromad};
const char* name_of(Command command) {
  switch (command) {
    case Command::kCheck:
      return "check";
    case Command::kCalibrate:
      return "calibrate";
    case Command::kReplay:
      return "replay, smooth";
    case Command::kGromad:
      return "gromad";
  }
  return "";
}
bool has_poses(Command command) {
  return command == Command::kCheck || command == Command::kCalibrate;
}

// Sizes s, 3 s and 10 s of what has a size.
struct Sized {
  const char* name;
  double s;  // stated in docs/reference/commands.md
  std::function<test::MistakeMade(double size)> make;
};
std::vector<Sized> sized_mistakes(Command command) {
  std::vector<Sized> out{
      {"clock-offset, s", 0.1, [](double size) { return test::clock_offset(size); }},
      // 0.24 s over what the command sees.
      {"clock-drift, s/s", command == Command::kGromad ? 2e-3 : 1e-3,
       [](double size) { return test::clock_drift(size); }},
      {"yaw-rate-scale", 0.05, [](double size) { return test::yaw_rate_scale(1.0 + size); }},
      {"odometry-scale", 0.05, [](double size) { return test::odometry_scale(1.0 + size); }},
      {"lever-arm, m", 0.3,
       [](double size) {
         return test::lever_arm({size, 0.0, 0.0});
       }},
  };
  if (has_poses(command)) {
    out.push_back({"heading-offset, rad", 0.15, [](double size) { return test::heading_offset(size); }});
    out.push_back({"surface-height, m", 0.3, [](double size) { return test::surface_height(size); }});
  } else {
    out.push_back({"surface-height, m", 0.3, [](double size) { return test::tags_too_high(size); }});
  }
  return out;
}

std::vector<test::MistakeMade> mistakes(Command command) {
  std::vector<test::MistakeMade> out;
  for (const Sized& sized : sized_mistakes(command)) {
    for (const double times : {1.0, 3.0, 10.0}) out.push_back(sized.make(times * sized.s));
  }
  for (const double factor : {1e3, 1.0 / 0.3048}) {
    out.push_back(test::length_unit(factor));
    out.push_back(test::odometry_length_unit(factor));
  }
  for (const double factor : {1e3, 1e2}) out.push_back(test::lever_arm_unit(factor));
  out.push_back(test::yaw_rate_unit());
  out.push_back(test::yaw_rate_sign());
  out.push_back(test::swapped_tags());
  out.push_back(test::unknown_tag());
  // gromad puts all on one clock by itself.
  if (command != Command::kGromad) {
    for (const double factor : {1e3, 1e6}) {
      out.push_back(test::time_unit(factor));
      out.push_back(test::all_times_unit(factor));
    }
    out.push_back(test::time_overlap());
  }
  if (has_poses(command)) {
    out.push_back(test::angle_unit());
    out.push_back(test::heading_sign());
    out.push_back(test::odometry_of_another_drive());
  }
  if (command != Command::kCalibrate) {
    out.push_back(test::unknown_anchor());
    out.push_back(test::renumbered_anchors());
    out.push_back(test::another_site());
  }
  return out;
}

std::vector<std::pair<test::MistakeMade, test::MistakeMade>> pairs() {
  return {{test::swapped_tags(), test::clock_offset(0.5)},
          {test::odometry_scale(1.2), test::lever_arm({0.6, 0.0, 0.0})},
          {test::yaw_rate_sign(), test::clock_offset(0.3)}};
}

// A drive without a mistake, and the calibration from it.
struct Drive {
  std::string name;
  Data data;
  model::Calibration calibration;
};
model::Calibration calibrated(const Data& data) {
  calibration::Drive drive;
  drive.ranges = data.ranges;
  drive.poses = data.poses;
  drive.tags = data.tags;
  drive.surface = &data.surface;
  drive.priors = data.priors;
  return calibration::calibrate(drive, {}).calibration;
}
Drive make_drive(std::string name, Data data) {
  model::Calibration calibration = calibrated(data);
  return {std::move(name), std::move(data), std::move(calibration)};
}

template <class Samples>
void keep_last(Samples& samples, double from_s) {
  std::erase_if(samples, [&](const auto& sample) { return sample.t_s < from_s; });
}

// What the command names where this is wrong; gromad sees the last two minutes.
template <class Mistakes>
std::vector<Finding> findings_of(Command command, const Drive& drive, const Mistakes& made) {
  Data data = drive.data;
  if (command == Command::kGromad) {
    constexpr double kKept_s = 120.0;
    const double from_s = data.odometry.back().t_s - kKept_s;
    keep_last(data.odometry, from_s);
    keep_last(data.ranges, from_s);
    keep_last(data.poses, from_s);
  }
  const std::vector<model::Anchor> surveyed = data.anchors;
  for (const test::MistakeMade* mistake : made) mistake->make(data);
  if (command == Command::kCalibrate) data.anchors.clear();
  if (has_poses(command)) return diagnose(std::move(data));
  // Anchors that the mistake moves or removes, are moved or removed in the calibration.
  model::Calibration calibration = drive.calibration;
  std::erase_if(calibration.anchors, [&](model::AnchorCalibration& anchor) {
    const auto is_this = [&](const model::Anchor& other) { return other.id == anchor.id; };
    const auto before = std::find_if(surveyed.begin(), surveyed.end(), is_this);
    const auto now = std::find_if(data.anchors.begin(), data.anchors.end(), is_this);
    if (before == surveyed.end()) return false;
    if (now == data.anchors.end()) return true;
    anchor.position_m += now->position_m - before->position_m;
    return false;
  });
  return diagnose(std::move(data), calibration);
}
std::vector<Finding> findings_of(Command command, const Drive& drive, const test::MistakeMade& made) {
  return findings_of(command, drive, std::array{&made});
}
std::vector<Finding> findings_of(Command command, const Drive& drive) {
  return findings_of(command, drive, std::array<const test::MistakeMade*, 0>{});
}

std::string causes_of(const std::vector<Finding>& findings) {
  std::string out;
  for (const Finding& finding : findings) out += fmt::format("{}{}", out.empty() ? "" : ", ", finding.cause);
  return out;
}

// Mistakes that a drive cannot show without poses: right is to name nothing.
struct Hidden {
  const char* drive;
  const char* cause;
  double below;  // of the size
  const char* why;
};
constexpr std::array kHidden{
    Hidden{"real/lias_fast", "surface-height", std::numeric_limits<double>::infinity(),
           "anchors and tags are at one height, so that ranges hardly change with it"},
    Hidden{"real/mcd_ntu_day_09", "surface-height", 2.0,
           "the calibration knows the heights of all anchors together to 0.4 m, and five sigma are named"},
};
const Hidden* hidden(Command command, const std::string& drive, const test::MistakeMade& made) {
  if (has_poses(command)) return nullptr;
  const auto found = std::find_if(kHidden.begin(), kHidden.end(), [&](const Hidden& of) {
    return drive == of.drive && made.cause == of.cause && std::abs(made.value.front()) < of.below;
  });
  return found != kHidden.end() ? &*found : nullptr;
}

struct Count {
  int cases = 0;
  int named = 0;
  int other = 0;
  int sized = 0;  // of those named that have a sigma
  int sizes = 0;
};

class Table {
 public:
  void add(const test::MistakeMade& made, const std::vector<Finding>& findings) {
    Count& count = counts_[made.cause];
    ++count.cases;
    if (findings.empty()) return;
    const Finding& first = findings.front();
    if (first.cause != made.cause) {
      ++count.other;
      return;
    }
    ++count.named;
    if (first.sigma.size() != made.value.size()) return;
    for (std::size_t i = 0; i < first.sigma.size(); ++i) {
      ++count.sizes;
      if (std::abs(first.value[i] - made.value[i]) < 3.0 * first.sigma[i]) ++count.sized;
    }
  }
  // Of a mistake that cannot be seen.
  void add_hidden(const test::MistakeMade& made, const std::vector<Finding>& findings) {
    Count& count = counts_[made.cause];
    ++count.cases;
    ++(findings.empty() ? count.named : count.other);
  }
  // The causes of which too few cases are right.
  [[nodiscard]] std::string often_missed(double least_share) const {
    std::string out;
    for (const auto& [cause, count] : counts_) {
      if (count.named < least_share * count.cases) out += cause + " ";
    }
    return out;
  }
  void print() const {
    std::printf("%-28s %6s %6s %6s %14s\n", "cause", "cases", "right", "other", "within 3 sigma");
    for (const auto& [cause, count] : counts_) {
      std::printf("%-28s %6d %6d %6d %7d of %3d\n", cause.c_str(), count.cases, count.named, count.other,
                  count.sized, count.sizes);
    }
    const Count all = total();
    std::printf("%-28s %6d %6d %6d %7d of %3d\n", "all", all.cases, all.named, all.other, all.sized,
                all.sizes);
  }
  [[nodiscard]] Count total() const {
    Count sum;
    for (const auto& [cause, count] : counts_) {
      sum.cases += count.cases;
      sum.named += count.named;
      sum.other += count.other;
      sum.sized += count.sized;
      sum.sizes += count.sizes;
    }
    return sum;
  }

 private:
  std::map<std::string, Count> counts_;
};

std::uint64_t last_seed(std::uint64_t usual) {
  const char* const last = std::getenv("GROMA_LAST_SEED");
  return last != nullptr ? std::stoull(last) : usual;
}

constexpr std::array kSites{test::Route::kWaves, test::Route::kEight, test::Route::kEllipse};
std::vector<Drive> simulated_drives(std::uint64_t seeds) {
  std::vector<Drive> out;
  for (const test::Route route : kSites) {
    for (std::uint64_t seed = 1; seed <= seeds; ++seed) {
      out.push_back(make_drive(fmt::format("route {}, seed {}", static_cast<int>(route), seed),
                               simulated_drive(route, seed)));
    }
  }
  return out;
}
std::vector<Drive> recorded_drives(std::initializer_list<const char*> names) {
  std::vector<Drive> out;
  for (const char* name : names) {
    if (const auto path = test::shared_data(name))
      out.push_back(make_drive(name, data_of(io::read_dataset(*path))));
  }
  return out;
}

// calibrate is check without anchors.csv, and gromad is replay of two minutes: fewer drives show that.
bool is_shortened(Command command) {
  return command == Command::kCalibrate || command == Command::kGromad;
}

TEST(MistakesCampaign, NamesTheRightCauseFirst) {
  std::vector<Drive> drives = simulated_drives(last_seed(3));
  for (Drive& drive : recorded_drives({"real/lias_fast", "real/mcd_ntu_day_09"}))
    drives.push_back(std::move(drive));
  for (const Command command : kCommands) {
    Table table;
    for (const Drive& drive : drives) {
      if (is_shortened(command) && drive.name.find("seed") != std::string::npos &&
          drive.name.find("seed 1") == std::string::npos)
        continue;
      for (const test::MistakeMade& made : mistakes(command)) {
        const std::vector<Finding> findings = findings_of(command, drive, made);
        if (const Hidden* const of = hidden(command, drive.name, made)) {
          std::printf("%s, %s: %s of %g cannot be seen (%s), and is '%s'\n", name_of(command),
                      drive.name.c_str(), made.cause.c_str(), made.value.front(), of->why,
                      causes_of(findings).c_str());
          table.add_hidden(made, findings);
          continue;
        }
        if (findings.empty() || findings.front().cause != made.cause) {
          std::printf("%s, %s: %s (%s) is '%s'\n", name_of(command), drive.name.c_str(), made.cause.c_str(),
                      made.name.c_str(), causes_of(findings).c_str());
        }
        table.add(made, findings);
      }
    }
    std::printf("\n%s\n", name_of(command));
    table.print();
    const Count all = table.total();
    EXPECT_GE(all.named, 0.9 * all.cases) << name_of(command);
    EXPECT_EQ(table.often_missed(0.75), "") << name_of(command);
    EXPECT_LE(all.other, 0.02 * all.cases) << name_of(command);
    EXPECT_GE(all.sized, 0.9 * all.sizes) << name_of(command);
  }
}

TEST(MistakesCampaign, NamesTwoAtOnce) {
  const std::vector<Drive> drives = simulated_drives(last_seed(2));
  for (const Command command : {Command::kCheck, Command::kReplay}) {
    int cases = 0;
    int both = 0;
    for (const Drive& drive : drives) {
      for (const auto& [a, b] : pairs()) {
        const std::vector<Finding> findings = findings_of(command, drive, std::array{&a, &b});
        const auto names = [&](const test::MistakeMade& made) {
          return std::any_of(findings.begin(), findings.end(),
                             [&](const Finding& finding) { return finding.cause == made.cause; });
        };
        ++cases;
        if (names(a) && names(b)) {
          ++both;
        } else {
          std::printf("%s, %s: %s and %s are '%s'\n", name_of(command), drive.name.c_str(), a.cause.c_str(),
                      b.cause.c_str(), causes_of(findings).c_str());
        }
      }
    }
    std::printf("two mistakes at once, %s: both named in %d of %d\n", name_of(command), both, cases);
    EXPECT_GE(both, 0.7 * cases) << name_of(command);
  }
}

TEST(MistakesCampaign, NamesNothingBelowAThirdOfTheSmallestSize) {
  const std::vector<Drive> drives = simulated_drives(1);
  for (const Command command : {Command::kCheck, Command::kReplay}) {
    for (const Drive& drive : drives) {
      for (const Sized& sized : sized_mistakes(command)) {
        const test::MistakeMade made = sized.make(sized.s / 3.0);
        EXPECT_EQ(causes_of(findings_of(command, drive, made)), "")
            << name_of(command) << ", " << drive.name << ", " << sized.name;
      }
    }
  }
}

TEST(MistakesCampaign, NamesNothingInDrivesWithoutAMistake) {
  std::vector<Drive> drives = simulated_drives(last_seed(10));
  for (Drive& drive : recorded_drives(
           {"real/inrol_env1", "real/labyrinth", "real/lias_fast", "real/mcd_ntu_day_04",
            "real/mcd_ntu_day_05", "real/mcd_ntu_day_06", "real/mcd_ntu_day_09", "real/mcd_ntu_night_03",
            "real/mcd_ntu_night_09", "real/plaza1", "real/starloc_loop2dfasts1", "real/starloc_loop2ds5",
            "simulated/clean", "simulated/indoor", "simulated/outdoor", "simulated/ramp"}))
    drives.push_back(std::move(drive));
  for (const Command command : {Command::kCheck, Command::kReplay, Command::kGromad}) {
    for (const Drive& drive : drives)
      EXPECT_EQ(causes_of(findings_of(command, drive)), "") << name_of(command) << ", " << drive.name;
  }
  std::printf("%zu drives without a mistake\n", drives.size());
}

double anchor_error_m(const Data& data, const model::Calibration& calibration) {
  double sum_m = 0.0;
  double count = 0.0;
  for (const model::Anchor& truth : data.anchors) {
    const model::AnchorCalibration* anchor = model::find_anchor(calibration, truth.id);
    if (anchor == nullptr || !model::has_position(*anchor)) continue;
    sum_m += (anchor->position_m - truth.position_m).norm();
    count += 1.0;
  }
  return count > 0.0 ? sum_m / count : std::numeric_limits<double>::infinity();
}

double pose_error_m(const Data& data, const Drive& truth) {
  filter::ReplayOptions options;
  options.config.odometry = {.sigma_vx_mps = 0.02, .sigma_vy_mps = 0.02, .sigma_omega_radps = 0.006};
  options.config.range_sigma_m = data.priors.sigma_m;
  const auto start =
      filter::start_from_prior(truth.data.poses, data.odometry.front().t_s, truth.data.surface);
  if (start) options.start = *start;
  const filter::ReplayResult result = filter::replay(
      {data.odometry, data.ranges, data.tags, &data.surface, &truth.calibration, nullptr}, options);
  double sum_m = 0.0;
  const auto errors = evaluation::pose_errors(result.rows, truth.data.poses);
  for (const evaluation::PoseError& error : errors) sum_m += std::hypot(error.x_m, error.y_m);
  return errors.empty() ? std::numeric_limits<double>::infinity()
                        : sum_m / static_cast<double>(errors.size());
}

// s: the size from which on the mean error of anchors (of a calibration from poses) or of poses (of a replay)
// is half as large again, as the mean over the sites.
TEST(MistakesCampaign, MeasuresTheSmallestSizeThatMatters) {
  const std::vector<Drive> drives = simulated_drives(1);
  std::printf("size that worsens anchors or poses by half\n");
  const auto smallest = [&](const Sized& sized, const auto& error_m) {
    double before = 1.0;
    for (double size = 0.1 * sized.s; size < 20.0 * sized.s; size *= 1.3) {
      double ratio = 0.0;
      for (const Drive& drive : drives) {
        Data changed = drive.data;
        sized.make(size).make(changed);
        ratio += error_m(changed, drive) / error_m(drive.data, drive) / static_cast<double>(drives.size());
      }
      // Between the sizes, the error is about linear in the size.
      if (ratio > 1.5) return size * (1.0 - 0.3 / 1.3 * (ratio - 1.5) / (ratio - before));
      before = ratio;
    }
    return std::numeric_limits<double>::infinity();
  };
  for (const Command command : {Command::kCalibrate, Command::kReplay}) {
    for (const Sized& sized : sized_mistakes(command)) {
      if (has_poses(command)) {
        const bool is_of_odometry = std::string_view(sized.name).find("scale") != std::string_view::npos;
        if (is_of_odometry) continue;  // a calibration does not use it
        std::printf("anchors, %s: %.4f\n", sized.name, smallest(sized, [](const Data& data, const Drive&) {
                      return anchor_error_m(data, calibrated(data));
                    }));
      } else {
        std::printf("poses, %s: %.4f\n", sized.name, smallest(sized, pose_error_m));
      }
    }
  }
}

}  // namespace
}  // namespace groma::diagnosis
