#include "host/doctor/advice.hpp"

#include <array>
#include <utility>

namespace groma::doctor {
namespace {

using Advice = std::pair<std::string_view, std::string_view>;

constexpr std::array<Advice, 8> kByReason{
    {{"no-ranges", "check that the tags are on and in reach of the anchors"},
     {"ranges-disagree", "wait some seconds; if it stays, compare the calibration with the site"},
     {"no-odometry", "check the program that sends the robot's odometry"},
     {"tag-silent", "check the power and the cable of the tag that gives no ranges"},
     {"uncertain", "drive on, where more anchors are in reach"},
     {"off-surface", "extend the surface in the configuration to where the robot drives"},
     {"map-mismatch", "name the calibration of this site, or calibrate again"},
     {"odometry-times", "correct the clock of the computer that sends the odometry"}}};

constexpr std::array<Advice, 7> kByState{
    {{"UNINITIALIZED", "drive some metres: the pose is found from ranges and motion"},
     {"CONVERGING", "drive some metres, and wait until the ranges agree"},
     {"LOST", "drive some metres where several anchors are in reach"},
     {"CALIBRATION_DRIVE", "drive through the whole site, with pose priors, until the drive is over"},
     {"CALIBRATING", "wait until the calibration is solved"},
     {"WAITING_FOR_ODOMETRY", "check the program that sends the robot's odometry"},
     {"ODOMETRY_TIMES_WRONG", "correct the clock of the computer that sends the odometry"}}};

template <typename Table>
std::string_view find_advice(const Table& table, std::string_view word) noexcept {
  for (const Advice& advice : table) {
    if (advice.first == word) return advice.second;
  }
  return {};
}

}  // namespace

std::string_view advice_on(std::string_view state, std::string_view reason) noexcept {
  if (const std::string_view advice = find_advice(kByReason, reason); !advice.empty()) return advice;
  return find_advice(kByState, state);
}

}  // namespace groma::doctor
