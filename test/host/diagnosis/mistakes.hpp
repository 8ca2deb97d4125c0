// Mistakes as people make them, put into the data of a drive.
#pragma once

#include <algorithm>
#include <functional>
#include <map>
#include <numbers>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/model/pose.hpp"

namespace groma::test {

struct MistakeMade {
  std::string name;   // of the case
  std::string cause;  // the contract's word; empty: none
  std::function<void(diagnosis::Data&)> make;
  std::vector<double> value = {};      // what the data then has wrong; empty if the cause has no value
  std::vector<model::NodeId> of = {};  // tags or anchors concerned
};

template <class Samples>
void shift_times(Samples& samples, double by_s) {
  for (auto& sample : samples) sample.t_s += by_s;
}

inline MistakeMade clock_offset(double by_s) {
  return {
      "ranges late", "clock-offset", [=](diagnosis::Data& data) { shift_times(data.ranges, by_s); }, {by_s}};
}
inline MistakeMade pose_clock_offset(double by_s) {
  return {
      "poses early", "clock-offset", [=](diagnosis::Data& data) { shift_times(data.poses, -by_s); }, {by_s}};
}
inline MistakeMade odometry_clock_offset(double by_s) {
  return {"odometry early",
          "clock-offset",
          [=](diagnosis::Data& data) { shift_times(data.odometry, -by_s); },
          {by_s}};
}
inline MistakeMade clock_drift(double drift) {
  return {"ranges' clock fast",
          "clock-drift",
          [=](diagnosis::Data& data) {
            for (model::RangeSample& range : data.ranges) range.t_s *= 1.0 + drift;
          },
          {drift}};
}
inline MistakeMade time_overlap() {
  return {"another epoch", "time-overlap", [](diagnosis::Data& data) { shift_times(data.ranges, 1.6e9); }};
}
inline MistakeMade time_unit(double factor) {
  return {"times of ranges",
          "time-unit",
          [=](diagnosis::Data& data) {
            for (model::RangeSample& range : data.ranges) range.t_s *= factor;
          },
          {factor}};
}
inline MistakeMade all_times_unit(double factor) {
  return {"times of all tables",
          "time-unit",
          [=](diagnosis::Data& data) {
            for (model::RangeSample& range : data.ranges) range.t_s *= factor;
            for (model::OdometrySample& sample : data.odometry) sample.t_s *= factor;
            for (model::PoseSample& pose : data.poses) pose.t_s *= factor;
          },
          {factor}};
}
inline MistakeMade length_unit(double factor) {
  return {"unit of ranges",
          "length-unit",
          [=](diagnosis::Data& data) {
            for (model::RangeSample& range : data.ranges) range.range_m *= factor;
            // As the reader does.
            const auto out_of_bounds = std::stable_partition(
                data.ranges.begin(), data.ranges.end(), [](const model::RangeSample& range) {
                  return range.range_m > 0.0 && range.range_m <= 1000.0;
                });
            data.dropped_ranges.assign(out_of_bounds, data.ranges.end());
            data.ranges.erase(out_of_bounds, data.ranges.end());
          },
          {factor}};
}
inline MistakeMade lever_arm_unit(double factor) {
  return {"unit of lever arms",
          "length-unit",
          [=](diagnosis::Data& data) {
            for (model::Tag& tag : data.tags) tag.lever_arm_m *= factor;
          },
          {factor}};
}
inline constexpr double kDegrees = 180.0 / std::numbers::pi;  // in a radian
inline MistakeMade angle_unit() {
  return {"yaw in degrees",
          "angle-unit",
          [](diagnosis::Data& data) {
            for (model::PoseSample& pose : data.poses) pose.yaw_rad *= kDegrees;
          },
          {kDegrees}};
}
inline MistakeMade tilt_unit() {
  return {"roll and pitch in degrees",
          "angle-unit",
          [](diagnosis::Data& data) {
            for (model::PoseSample& pose : data.poses) {
              pose.roll_rad = kDegrees * 0.03;
              pose.pitch_rad = kDegrees * -0.01;
            }
          },
          {kDegrees}};
}
inline MistakeMade heading_offset(double by_rad) {
  return {"heading off",
          "heading-offset",
          [=](diagnosis::Data& data) {
            for (model::PoseSample& pose : data.poses)
              pose.yaw_rad = model::wrap_angle(pose.yaw_rad + by_rad);
          },
          {by_rad}};
}
inline MistakeMade heading_sign() {
  return {"heading negated", "heading-sign", [](diagnosis::Data& data) {
            for (model::PoseSample& pose : data.poses) pose.yaw_rad = -pose.yaw_rad;
          }};
}
inline MistakeMade lateral_sign() {
  return {"y to the right", "lateral-sign", [](diagnosis::Data& data) {
            for (model::OdometrySample& sample : data.odometry) sample.vy_mps = -sample.vy_mps;
          }};
}
inline MistakeMade yaw_rate_sign() {
  return {"yaw rate negated", "yaw-rate-sign", [](diagnosis::Data& data) {
            for (model::OdometrySample& sample : data.odometry) sample.omega_radps = -sample.omega_radps;
          }};
}
inline MistakeMade yaw_rate_scale(double factor) {
  return {"yaw rate scaled",
          "yaw-rate-scale",
          [=](diagnosis::Data& data) {
            for (model::OdometrySample& sample : data.odometry) sample.omega_radps *= factor;
          },
          {factor}};
}
inline MistakeMade speeds_times(double factor, const char* name, const char* cause) {
  return {name,
          cause,
          [=](diagnosis::Data& data) {
            for (model::OdometrySample& sample : data.odometry) {
              sample.vx_mps *= factor;
              sample.vy_mps *= factor;
            }
          },
          {factor}};
}
inline MistakeMade odometry_scale(double factor) {
  return speeds_times(factor, "speed scaled", "odometry-scale");
}
inline MistakeMade swapped_tags() {
  return {.name = "first two tags swapped", .cause = "swapped-tags", .make = [](diagnosis::Data& data) {
            std::swap(data.tags[0].lever_arm_m, data.tags[1].lever_arm_m);
          }};
}
inline MistakeMade lever_arm(const Eigen::Vector3d& by_m) {
  return {"lever arm of the last tag",
          "lever-arm",
          [=](diagnosis::Data& data) { data.tags.back().lever_arm_m += by_m; },
          {by_m.x(), by_m.y(), by_m.z()}};
}
// The poses are given lower than they are.
inline MistakeMade surface_height(double by_m) {
  return {"poses below the surface",
          "surface-height",
          [=](diagnosis::Data& data) {
            for (model::PoseSample& pose : data.poses) pose.z_m -= by_m;
          },
          {by_m}};
}
inline model::Surface raised(const model::Surface& surface, double by_m) {
  std::vector<model::Chart> charts = surface.charts();
  for (model::Chart& chart : charts) {
    if (auto* const spline = std::get_if<model::BSpline>(&chart.shape)) {
      std::vector<double> heights_m = spline->heights_m();
      for (double& height_m : heights_m) height_m += by_m;
      *spline = model::BSpline(spline->grid(), std::move(heights_m));
    } else {
      const model::SurfacePoint at = std::get<model::Plane>(chart.shape).at(0.0, 0.0);
      chart.shape = model::Plane(at.z_m + by_m, {-at.gradient.x(), -at.gradient.y(), 1.0});
    }
  }
  return model::Surface(std::move(charts));
}
// The surface is given this much too high: seen without poses, the tags are too high.
inline MistakeMade tags_too_high(double by_m) {
  return {"surface too high",
          "surface-height",
          [=](diagnosis::Data& data) { data.surface = raised(data.surface, by_m); },
          {by_m}};
}
// The drive backwards and half as fast again, so that no symmetry of the route hides it.
inline MistakeMade odometry_of_another_drive() {
  return {"odometry of another drive", "poses-contradict-odometry", [](diagnosis::Data& data) {
            const std::vector<model::OdometrySample> own = data.odometry;
            for (std::size_t i = 0; i < own.size(); ++i) {
              const double t_s = own[i].t_s;
              data.odometry[i] = own[own.size() - 1 - 3 * i / 2 % own.size()];
              data.odometry[i].t_s = t_s;
            }
          }};
}
// Of the first and the third, as the ranges have them.
inline MistakeMade renumbered_anchors() {
  return {"two anchors' ids exchanged", "renumbered-anchors", [](diagnosis::Data& data) {
            const model::NodeId a = data.anchors[0].id;
            const model::NodeId b = data.anchors[2].id;
            for (model::RangeSample& range : data.ranges) {
              if (range.anchor_id == a || range.anchor_id == b)
                range.anchor_id = static_cast<model::NodeId>(a + b - range.anchor_id);
            }
          }};
}
inline MistakeMade all_anchors_renumbered() {
  return {"all anchors' ids in another order", "renumbered-anchors", [](diagnosis::Data& data) {
            std::map<model::NodeId, model::NodeId> next;
            for (std::size_t i = 0; i < data.anchors.size(); ++i)
              next[data.anchors[i].id] = data.anchors[(i + 1) % data.anchors.size()].id;
            for (model::RangeSample& range : data.ranges) range.anchor_id = next.at(range.anchor_id);
          }};
}
inline MistakeMade odometry_length_unit(double factor) {
  return speeds_times(factor, "unit of speeds", "length-unit");
}
inline MistakeMade yaw_rate_unit() {
  return {"yaw rate in degrees",
          "angle-unit",
          [](diagnosis::Data& data) {
            for (model::OdometrySample& sample : data.odometry) sample.omega_radps *= kDegrees;
          },
          {kDegrees}};
}
// No turn and shift makes it the right one.
inline MistakeMade another_site() {
  return {"anchors of another site", "map-mismatch", [](diagnosis::Data& data) {
            for (model::Anchor& anchor : data.anchors) {
              anchor.position_m.head<2>() =
                  Eigen::Vector2d(30.0 - 1.6 * anchor.position_m.x(), 11.0 + 0.7 * anchor.position_m.y());
            }
          }};
}
// As the reader does with what the configuration lacks.
template <class IsUnknown>
void drop_ranges(diagnosis::Data& data, const IsUnknown& is_unknown) {
  std::copy_if(data.ranges.begin(), data.ranges.end(), std::back_inserter(data.dropped_ranges), is_unknown);
  std::erase_if(data.ranges, is_unknown);
}
inline MistakeMade unknown_tag() {
  return {"a tag that is not configured", "unknown-tag", [](diagnosis::Data& data) {
            const model::NodeId id = data.tags.back().id;
            data.tags.pop_back();
            drop_ranges(data, [=](const model::RangeSample& range) { return range.tag_id == id; });
          }};
}
inline MistakeMade unknown_anchor() {
  return {"an anchor that is not configured", "unknown-anchor", [](diagnosis::Data& data) {
            const model::NodeId id = data.anchors.back().id;
            data.anchors.pop_back();
            drop_ranges(data, [=](const model::RangeSample& range) { return range.anchor_id == id; });
          }};
}

}  // namespace groma::test
