// Errors of a drive that all its ranges share: slow pose drift, range delay, lever arms and antenna patterns.
// Solved jointly with all anchors.
#pragma once

#include <span>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/shared_unknowns.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/range_model.hpp"

namespace groma::calibration {

struct KnotShare {
  Eigen::Index first = 0;  // index of the knot's first unknown
  double fraction = 0.0;   // towards the next knot
};
[[nodiscard]] KnotShare knot_share(const Knots& knots, double t_s) noexcept;

// Derivative of one predicted range by the shared unknowns that it depends on: the knots before and after it
// (6), the delay, the body terms of its tag.
inline constexpr Eigen::Index kSharedTerms = 7 + kBodyTerms;
using SharedRow = Eigen::Matrix<double, kSharedTerms, 1>;
// `fraction` is that of the observation's KnotShare.
[[nodiscard]] SharedRow shared_jacobian(const Observation& row, const model::AntennaPrediction& predicted,
                                        double fraction) noexcept;

// Corrects an observation by a step of the unknowns: moves the antenna, subtracts the pattern from the range.
// `anchor_m` is the anchor's estimated position.
void move_row(const SharedUnknowns& unknowns, const Eigen::VectorXd& step, const Eigen::Vector3d& anchor_m,
              Observation& row) noexcept;

// One anchor's equations after elimination: its step is information^-1 descent - gain times the shared step.
struct AnchorPart {
  Eigen::LLT<Eigen::MatrixXd> information;
  Eigen::VectorXd descent;
  Eigen::MatrixXd gain;  // information^-1 times the cross information with the shared unknowns
};

struct JointEquations : SharedEquations {
  std::vector<AnchorPart> anchors;
};

// Eliminates the anchors from the joint normal equations. `inflation` of each anchor divides its information:
// its residuals are correlated.
[[nodiscard]] JointEquations eliminate_anchors(std::span<const AnchorFit> fits,
                                               std::span<const double> inflation,
                                               const SharedUnknowns& unknowns);

// Lever-arm error and antenna pattern of one tag.
struct BodyError {
  BodyVector mean = BodyVector::Zero();
  BodyMatrix covariance = BodyMatrix::Zero();
};

struct DriveError {
  double range_delay_s = 0.0;  // removed if the ranges show it clearly; reported in any case
  double range_delay_sigma_s = 0.0;
  std::vector<BodyError> body;  // per tag; empty unless the ranges show it clearly
  // Covariance that the error's remaining uncertainty adds to each anchor, in the order of the fits.
  std::vector<Eigen::MatrixXd> added_covariance;
  // Correlation of the anchors: covariance of the shared unknowns, and the response of each anchor's unknowns
  // to them. Empty if nothing was corrected.
  Eigen::MatrixXd shared_covariance;
  std::vector<Eigen::MatrixXd> shared_gain;
  // Covariance of the shift and turn (x, y, z in m, yaw in rad, about the map's origin) common to all poses,
  // and the part of it that no range observes and added_covariance lacks. Both zero if an anchor was
  // surveyed: the survey then defines the frame.
  Eigen::Matrix4d frame_covariance = Eigen::Matrix4d::Zero();
  Eigen::Matrix4d unseen_frame_covariance = Eigen::Matrix4d::Zero();
  // Layout and prior of the shared unknowns, and the estimate that has been removed from the rows.
  SharedUnknowns unknowns;
  SharedPrior prior;
  Eigen::VectorXd shared_mean;
};

// Estimates the error, moves the antennas of the association's observations (which the fits refer to) by it,
// subtracts the patterns from the ranges, and solves the fits again. Gathers the fits' evidence.
[[nodiscard]] DriveError correct_drive(Association& association, std::vector<AnchorFit>& fits);
// Continues from there after the fits' NLOS states have changed; the prior stays.
void correct_further(Association& association, std::vector<AnchorFit>& fits, DriveError& drive_error);

}  // namespace groma::calibration
