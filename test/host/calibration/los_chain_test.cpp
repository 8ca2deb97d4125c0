// The LOS/NLOS Markov chain against sums over all state sequences, and the solver's cost with NLOS states
// against numerical derivatives.
#include "host/calibration/los_chain.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/los_solver.hpp"
#include "host/calibration/moved.hpp"
#include "test/host/calibration/blocked_site.hpp"
#include "test/support/numerical_jacobian.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kStates = 3;

// Sums over all state sequences.
struct Enumeration {
  double total = 0.0;
  std::vector<LosVector> prior;  // of each answered poll, without its own residual
  std::vector<LosVector> posterior;
  LosVector answered = LosVector::Zero();
  LosVector missed = LosVector::Zero();
};

Enumeration enumerate(const LosChain& chain, const std::vector<Poll>& polls,
                      const std::vector<LosVector>& likelihoods, const std::vector<double>& hints) {
  Enumeration out;
  out.prior.assign(likelihoods.size(), LosVector::Zero());
  out.posterior.assign(likelihoods.size(), LosVector::Zero());
  std::size_t ways = 1;
  for (std::size_t n = 0; n < polls.size(); ++n) ways *= kStates;
  for (std::size_t way = 0; way < ways; ++way) {
    std::vector<Eigen::Index> states;
    for (std::size_t rest = way, n = 0; n < polls.size(); ++n, rest /= kStates) {
      states.push_back(static_cast<Eigen::Index>(rest % kStates));
    }
    double probability = chain.start(states[0]);
    for (std::size_t n = 1; n < polls.size(); ++n) probability *= chain.transition(states[n - 1], states[n]);
    std::size_t answer = 0;
    for (std::size_t n = 0; n < polls.size(); ++n) {
      if (polls[n] == kMissed) probability *= 1.0 - chain.reply(states[n]);
      if (polls[n] == kReplied) probability *= chain.reply(states[n]);
      if (polls[n] < 0) continue;
      if (!hints.empty() && states[n] != kLos) probability *= hints[answer];
      probability *= chain.reply(states[n]) * likelihoods[answer++](states[n]);
    }
    out.total += probability;
    answer = 0;
    for (std::size_t n = 0; n < polls.size(); ++n) {
      if (polls[n] == kMissed) out.missed(states[n]) += probability;
      if (polls[n] == kReplied) out.answered(states[n]) += probability;
      if (polls[n] < 0) continue;
      out.posterior[answer](states[n]) += probability;
      out.prior[answer](states[n]) += probability / likelihoods[answer](states[n]);
      out.answered(states[n]) += probability;
      ++answer;
    }
  }
  out.answered /= out.total;
  out.missed /= out.total;
  for (LosVector& prior : out.prior) prior /= prior.sum();
  for (LosVector& posterior : out.posterior) posterior /= posterior.sum();
  return out;
}

TEST(LosChain, EqualsTheSumOverAllStateSequences) {
  test::Random random(3);
  const std::vector<Poll> polls{0, kMissed, 1, kUnknownPoll, kReplied, 2, kMissed, kReplied, 3};
  LosPosterior found;
  for (int draw = 0; draw < 20; ++draw) {
    LosChain chain;
    chain.transition = los_transition(random.uniform(0.1, 5.0));
    chain.reply = {random.uniform(0.7, 1.0), random.uniform(0.2, 0.8), random.uniform(0.2, 0.8)};
    std::vector<LosVector> likelihoods(4);
    for (LosVector& likelihood : likelihoods) {
      for (double& density : likelihood) density = random.uniform(0.01, 4.0);
    }
    std::vector<double> hints;
    if (draw % 2 == 0) {
      for (std::size_t i = 0; i < likelihoods.size(); ++i) hints.push_back(random.uniform(0.1, 10.0));
    }
    infer_states(chain, polls, likelihoods, hints, found);
    const Enumeration expected = enumerate(chain, polls, likelihoods, hints);
    EXPECT_NEAR(found.log_evidence, std::log(expected.total), 1e-9);
    EXPECT_TRUE(found.answered.isApprox(expected.answered, 1e-9));
    EXPECT_TRUE(found.missed.isApprox(expected.missed, 1e-9));
    ASSERT_EQ(found.prior.size(), likelihoods.size());
    for (std::size_t i = 0; i < likelihoods.size(); ++i) {
      EXPECT_TRUE(found.prior[i].isApprox(expected.prior[i], 1e-9)) << i;
      EXPECT_TRUE(found.posterior[i].isApprox(expected.posterior[i], 1e-9)) << i;
    }
  }
}

// Reference: likelihood ratios of the classes, range by range.
TEST(PowerHints, AreTheSharesOfEachClassInEachState) {
  struct Counted {
    model::PowerClass of;
    double los;
  };
  test::Random random(8);
  std::array<double, model::kPowerClasses> ranges{};
  constexpr double kInterval_s = 0.05;
  constexpr std::size_t kUsual = 12;  // strength of LOS ranges
  ranges[kUsual] = 100.0;
  ranges[kUsual - 3] = 150.0;
  ranges[2 * model::kStrengthClasses + 5] = 50.0;
  ranges[kUsual + 2] = 5.0;
  PowerHints hints(ranges, kInterval_s);
  EXPECT_EQ(hints.ratio(model::kNoPowerClass), 1.0);
  const auto expect = [&](const std::vector<Counted>& all) {
    constexpr std::array kSeen{0.8, 0.15, 0.05};
    constexpr std::array kHidden{0.4, 0.3, 0.3};
    double near_all = 0.0;
    for (int i = 0; i < 16; ++i) near_all += std::exp(-std::abs(i - static_cast<int>(kUsual)));
    for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
      const std::size_t hidden = i / 17;
      const int strength = static_cast<int>(i % 17);
      double seen = 30.0 * kSeen[hidden] / 17.0;
      if (strength < 16) {
        seen = 30.0 * kSeen[hidden] * 16.0 / 17.0 * std::exp(-std::abs(strength - static_cast<int>(kUsual))) /
               near_all;
      }
      double blocked = 30.0 * kHidden[hidden] / 17.0;
      double all_seen = 30.0;
      double all_blocked = 30.0;
      for (const Counted& counted : all) {
        all_seen += 0.25 * counted.los;
        all_blocked += 0.25 * (1.0 - counted.los);
        if (counted.of != i) continue;
        seen += 0.25 * counted.los;
        blocked += 0.25 * (1.0 - counted.los);
      }
      const double ratio = std::clamp(blocked / all_blocked / (seen / all_seen), 0.1, 10.0);
      EXPECT_NEAR(hints.ratio(static_cast<model::PowerClass>(i)), ratio, 1e-9 * ratio) << i;
    }
  };
  expect({});
  // Twice: earlier counts do not count.
  for (int round = 0; round < 2; ++round) {
    std::vector<Counted> all;
    PowerCounts counts;
    for (int i = 0; i < 500; ++i) {
      all.push_back(
          {.of = static_cast<model::PowerClass>(random.uniform(0.0, 52.0)), .los = random.uniform()});
      counts.add(all.back().of, all.back().los);
      if (all.back().of == model::kNoPowerClass) all.pop_back();
    }
    hints.estimate(counts);
    expect(all);
  }
}

TEST(LosChain, LeftOutRangesStillCountAsReplies) {
  PollTable table;
  table.polls = {{{0, kMissed, 2, 3}, {1, kUnknownPoll, 4}}, {{0, 1}}};
  keep_rows(table, 0, std::vector<std::size_t>{1, 3});
  EXPECT_EQ(table.polls[0][0], (std::vector<Poll>{kReplied, kMissed, kReplied, 1}));
  EXPECT_EQ(table.polls[0][1], (std::vector<Poll>{0, kUnknownPoll, kReplied}));
  EXPECT_EQ(table.polls[1][0], (std::vector<Poll>{0, 1}));
}

TEST(LosChain, TransitionsCompose) {
  const Eigen::Matrix3d both = los_transition(0.5);
  EXPECT_TRUE((los_transition(0.2) * los_transition(0.3)).isApprox(both, 1e-4));
  EXPECT_TRUE(both.rowwise().sum().isOnes(1e-9));
  EXPECT_GT(both.minCoeff(), 0.0);
  EXPECT_TRUE(los_transition(1e-3).isIdentity(1e-3));
}

TEST(LosChain, DistinguishesMissedPollsFromPollsWithoutAnyReply) {
  Association association;
  association.tags.resize(1);
  association.anchors.resize(2);
  const auto answer = [&](std::size_t anchor, int poll) {
    std::vector<Observation>& rows = association.anchors[anchor].rows;
    Observation& row = rows.emplace_back();
    row.index = static_cast<std::uint32_t>(rows.size() - 1);
    row.t_s = 0.1 * poll + 0.03 * static_cast<double>(anchor);
  };
  // The first anchor misses polls 50, 70 and 90 .. 92; the second only 70.
  for (int poll = 0; poll < 120; ++poll) {
    if (poll != 50 && poll != 70 && (poll < 90 || poll > 92)) answer(0, poll);
    if (poll != 70) answer(1, poll);
  }
  const PollTable table = tabulate_polls(association);
  EXPECT_TRUE(table.regular);
  EXPECT_NEAR(table.interval_s, 0.1, 1e-9);
  const std::vector<Poll>& polls = table.polls[0][0];
  ASSERT_EQ(polls.size(), 120U);
  for (std::size_t poll = 0; poll < polls.size(); ++poll) {
    if (poll == 70) {
      EXPECT_EQ(polls[poll], kUnknownPoll);
    } else if (poll == 50 || (poll >= 90 && poll <= 92)) {
      EXPECT_EQ(polls[poll], kMissed);
    } else {
      EXPECT_GE(polls[poll], 0);
    }
  }
}

// The first half of the polls is answered, then every second one.
TEST(LosRows, ManyMissedRepliesAreNlos) {
  const LosModel model = first_los_model({.interval_s = 0.12, .regular = true}, {});
  std::vector<Observation> rows;
  std::vector<Poll> polls;
  for (int i = 0; i < 300; ++i) {
    if (i >= 150 && i % 2 == 1) {
      polls.push_back(kMissed);
      continue;
    }
    polls.push_back(static_cast<Poll>(rows.size()));
    rows.emplace_back().index = static_cast<std::uint32_t>(polls.back());
  }
  const std::vector<bool> los = los_rows(model, std::vector<std::vector<Poll>>{polls}, rows);
  ASSERT_EQ(los.size(), 225U);
  for (const std::size_t i : {20U, 75U, 130U}) EXPECT_TRUE(los[i]) << i;
  for (const std::size_t i : {170U, 190U, 210U}) EXPECT_FALSE(los[i]) << i;
}

TEST(LosChain, IrregularPollsAreNeverMissed) {
  test::Random random(5);
  Association association;
  association.tags.resize(1);
  association.anchors.resize(1);
  double t_s = 0.0;
  for (std::uint32_t i = 0; i < 300; ++i) {
    t_s -= 0.2 * std::log(1.0 - random.uniform());
    Observation& row = association.anchors[0].rows.emplace_back();
    row.index = i;
    row.t_s = t_s;
  }
  const PollTable table = tabulate_polls(association);
  EXPECT_FALSE(table.regular);
  for (const Poll poll : table.polls[0][0]) EXPECT_NE(poll, kMissed);
}

constexpr model::PowerClass class_of(std::size_t hidden, std::size_t strength) {
  return static_cast<model::PowerClass>(hidden * model::kStrengthClasses + strength);
}

TEST(PowerHints, AWeakFirstPathIsNoLosWhereItMeansNlos) {
  constexpr std::size_t kUsual = 9;
  std::array<double, model::kPowerClasses> ranges{};
  ranges[class_of(0, kUsual)] = 900.0;
  ranges[class_of(0, kUsual - 3)] = 100.0;
  PowerHints hints(ranges, 0.12);
  EXPECT_FALSE(hints.is_weak(class_of(0, kUsual - 3))) << "before any estimate";
  PowerCounts counts;
  counts.los[class_of(0, kUsual)] = 880.0;
  counts.blocked[class_of(0, kUsual)] = 20.0;
  counts.los[class_of(0, kUsual - 3)] = 20.0;
  counts.blocked[class_of(0, kUsual - 3)] = 80.0;
  hints.estimate(counts);
  EXPECT_FALSE(hints.is_weak(class_of(0, kUsual)));
  EXPECT_FALSE(hints.is_weak(class_of(0, kUsual - 2))) << "6 dB";
  for (std::size_t hidden = 0; hidden < model::kHiddenClasses; ++hidden) {
    EXPECT_TRUE(hints.is_weak(class_of(hidden, kUsual - 3))) << "9 dB";
    EXPECT_TRUE(hints.is_weak(class_of(hidden, 0)));
    EXPECT_FALSE(hints.is_weak(class_of(hidden, model::kStrengthClasses - 1))) << "unknown strength";
  }
  EXPECT_FALSE(hints.is_weak(model::kNoPowerClass));
  // Where weak ranges are no more frequent in NLOS they say nothing.
  counts.los[class_of(0, kUsual - 3)] = 880.0;
  hints.estimate(counts);
  EXPECT_FALSE(hints.is_weak(class_of(0, kUsual - 3)));
}

TEST(AnchorSolver, GradientWithNlosStatesIsTheDerivativeOfTheCost) {
  test::Random random(8);
  constexpr std::size_t kTags = 2;
  std::vector<Observation> rows;
  AnchorLos los_states;
  los_states.has_long_nlos = true;
  los_states.episodes = 2;
  for (std::uint32_t i = 0; i < 60; ++i) {
    Observation& row = rows.emplace_back();
    row.index = i;
    row.tag = i % kTags;
    row.tag_m = {random.uniform(0.0, 8.0), random.uniform(0.0, 8.0), random.uniform(0.3, 2.0)};
    row.range_m = (row.tag_m - Eigen::Vector3d(10.0, 5.0, 3.0)).norm() + 0.2 + 0.3 * random.gaussian();
    RangeLos& of_row = los_states.rows.emplace_back();
    const auto seen = static_cast<float>(random.uniform(0.05, 0.9));
    of_row.los = seen;
    of_row.episode = i < 20 ? 0 : (i < 40 ? 1 : kNoEpisode);
    of_row.long_nlos = of_row.episode == kNoEpisode ? 0.0F : 0.7F * (1.0F - seen);
    of_row.other_density = 0.2F * (1.0F - seen);
  }
  AnchorProblem problem;
  problem.rows = rows;
  problem.tag_count = kTags;
  problem.position.information = 0.01 * Eigen::Matrix3d::Identity();
  problem.los_states = &los_states;
  const std::vector<RobustKernel> kernels(kTags, RobustKernel(KernelShape{.scale_m = 0.15}));
  AnchorVector anchor = anchor_at({9.7, 5.2, 2.5}, kTags, {});
  anchor.segment<4>(3) << 0.1, 0.3, 1.01, 0.99;
  anchor.conservativeResize(anchor.size() + 3);
  anchor.tail<3>() << 0.35, 0.1, -0.15;
  const NormalEquations equations = linearize({.problem = problem, .anchor = anchor, .kernels = kernels});
  EXPECT_NEAR(equations.cost, robust_cost({.problem = problem, .anchor = anchor, .kernels = kernels}), 1e-9);
  const Eigen::MatrixXd numerical = test::numerical_jacobian(
      [&](const Eigen::VectorXd& x) {
        return Eigen::VectorXd::Constant(1,
                                         robust_cost({.problem = problem, .anchor = x, .kernels = kernels}));
      },
      anchor, 1e-4);
  // The kernels' tables are linear between their nodes, and the slope has their error.
  EXPECT_LT((equations.gradient - numerical.transpose()).norm(), 0.02 * numerical.norm());
  EXPECT_EQ(equations.information.llt().info(), Eigen::Success);
}

TEST(ShiftBetween, EqualsTheJointSolutionOfBothHalves) {
  test::Random random(4);
  constexpr Eigen::Index kSize = 7;
  const auto covariance = [&] {
    Eigen::MatrixXd root(kSize, kSize);
    for (Eigen::Index i = 0; i < root.size(); ++i) root(i) = random.gaussian();
    return Eigen::MatrixXd(root * root.transpose() + Eigen::MatrixXd::Identity(kSize, kSize));
  };
  const Eigen::MatrixXd earlier_covariance = covariance();
  const Eigen::MatrixXd later_covariance = covariance();
  const AnchorVector earlier = random.gaussians(kSize);
  const AnchorVector later = random.gaussians(kSize);
  const Shift shift = shift_between(earlier, earlier_covariance, later, later_covariance);

  // Unknowns: both positions, the biases once.
  Eigen::MatrixXd design = Eigen::MatrixXd::Zero(2 * kSize, kSize + 3);
  design.block<3, 3>(0, 0).setIdentity();
  design.block<3, 3>(kSize, 3).setIdentity();
  design.block<kSize - 3, kSize - 3>(3, 6).setIdentity();
  design.block<kSize - 3, kSize - 3>(kSize + 3, 6).setIdentity();
  Eigen::MatrixXd weight = Eigen::MatrixXd::Zero(2 * kSize, 2 * kSize);
  weight.topLeftCorner<kSize, kSize>() = earlier_covariance.inverse();
  weight.bottomRightCorner<kSize, kSize>() = later_covariance.inverse();
  Eigen::VectorXd data(2 * kSize);
  data << earlier, later;
  const Eigen::MatrixXd together = (design.transpose() * weight * design).inverse();
  const Eigen::VectorXd solution = together * design.transpose() * weight * data;
  const Eigen::Vector3d by_m = solution.segment<3>(3) - solution.head<3>();
  const Eigen::Matrix3d spread = together.topLeftCorner<3, 3>() + together.block<3, 3>(3, 3) -
                                 together.block<3, 3>(0, 3) - together.block<3, 3>(3, 0);
  EXPECT_TRUE(shift.by_m.isApprox(by_m, 1e-9));
  EXPECT_NEAR(shift.square_sigmas, by_m.dot(spread.inverse() * by_m), 1e-9 * shift.square_sigmas);
}

}  // namespace
}  // namespace groma::calibration
