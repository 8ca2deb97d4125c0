#include "test/baseline/graph.hpp"

#include <ceres/loss_function.h>
#include <ceres/problem.h>
#include <ceres/solver.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <set>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>

#include "test/baseline/graph_factors.hpp"
#include "test/baseline/kalman.hpp"

namespace groma::baseline {

namespace {

constexpr double kKeyframe_s = 0.2;
// Factor on the slow range bias of another drive than the calibration's, as in the filter's configuration.
constexpr double kBiasGrowth = 2.5;
// Parts of its correlation length over which a slow bias is one unknown.
constexpr double kBiasParts = 2.0;
constexpr double kWide = 8.0;        // of the first kernel over the last
constexpr std::size_t kPlaced = 10;  // keyframes

// R with R R^T = covariance, which may be singular.
Eigen::MatrixXd root_of(const Eigen::MatrixXd& covariance) {
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> axes(0.5 * (covariance + covariance.transpose()));
  return axes.eigenvectors() * axes.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
}

struct Unknown {
  std::vector<double> value;
  [[nodiscard]] int size() const { return static_cast<int>(value.size()); }
  [[nodiscard]] Eigen::Map<Eigen::VectorXd> vector() { return {value.data(), std::ssize(value)}; }
};

struct Factor {
  std::unique_ptr<ceres::CostFunction> cost;
  std::vector<Unknown*> unknowns;
  bool is_range = false;

  [[nodiscard]] bool touches(const std::set<Unknown*>& others) const {
    return std::any_of(unknowns.begin(), unknowns.end(),
                       [&](Unknown* unknown) { return others.count(unknown) > 0; });
  }
};

struct Keyframe {
  double t_s = 0.0;
  double way_m = 0.0;  // driven so far
  std::unique_ptr<Unknown> pose;
  int chart = 0;
};

struct SlowBias {
  double from_m = 0.0;  // way driven
  std::unique_ptr<Unknown> value;
};

}  // namespace

class Graph::Model {
 public:
  Model(const Drive& drive, const GraphOptions& options)
      : drive_(drive),
        options_(options),
        range_sigma_m_(options.parameters.range_factor * drive.range_noise.white_sigma_m),
        bias_sigma_m_(kBiasGrowth * drive.range_noise.bias_sigma_m),
        bias_length_m_(drive.range_noise.bias_length_m) {
    if (options.parameters.kernel > 0.0)
      loss_ = std::make_unique<ceres::CauchyLoss>(options.parameters.kernel);
    const Site& site = *drive.site;
    odometry_.value.assign(kOdometrySize, 0.0);
    odometry_.value[kDelay] = drive.range_delay_s;
    const Eigen::Vector3d sigmas(kScaleSigma, kYawRateBiasSigma_radps, drive.range_delay_sigma_s);
    add_prior(odometry_, sigmas.cwiseInverse());
    frame_.value.assign(4, 0.0);
    add_prior(frame_, Eigen::Vector4d::Ones());
    for (std::size_t i = 0; i < site.tags().size(); ++i) {
      lever_arms_.push_back(std::make_unique<Unknown>());
      lever_arms_.back()->value.assign(3, 0.0);
      add_prior(*lever_arms_.back(), Eigen::Vector3d::Ones());
    }
    const Eigen::Matrix4d frame_root = root_of(site.frame_covariance());
    const Eigen::Index tags = std::ssize(site.tags());
    biases_.resize(site.anchors().size());
    for (const SiteAnchor& anchor : site.anchors()) {
      const Eigen::MatrixXd root = root_of(anchor.own_covariance);
      anchors_.push_back(std::make_unique<Unknown>());
      anchors_.back()->value.assign(static_cast<std::size_t>(root.cols()), 0.0);
      add_prior(*anchors_.back(), Eigen::VectorXd::Ones(root.cols()));
      for (Eigen::Index tag = 0; tag < tags; ++tag) {
        const auto indices = model::pair_indices(tag, tags);
        const model::NodeId tag_id = site.tags()[static_cast<std::size_t>(tag)].id;
        pairs_.push_back({.pair = site.find(tag_id, anchor.id),
                          .root = root(indices, Eigen::all),
                          .frame_root = model::position_by_frame(anchor.values.head<3>()) * frame_root});
      }
    }
    const model::PlanarPose& start = drive.start.pose;
    keyframes_.push_back({drive.start.t_s, 0.0, std::make_unique<Unknown>(), start.chart});
    const Keyframe& first = keyframes_.back();
    first.pose->value = {start.x_m, start.y_m, start.theta_rad};
    add_prior(*first.pose, Eigen::Vector3d(1.0 / kStartSigma_m, 1.0 / kStartSigma_m, 1.0 / kStartSigma_rad));
  }

  void add(const Range& range, const Increment& increment) {
    const std::size_t tag = range.pair->tag;
    const std::size_t anchor = range.pair->anchor;
    const PairModel& pair = pairs_[anchor * lever_arms_.size() + tag];
    const Keyframe& keyframe = keyframes_.back();
    Factor factor{
        .cost = std::make_unique<RangeCost>(*drive_.surface, keyframe.chart, predict(increment).chart, pair,
                                            increment, range.range_m, range_sigma_m_, bias_sigma_m_),
        .unknowns = {keyframe.pose.get(), &odometry_, anchors_[anchor].get(), lever_arms_[tag].get(),
                     &frame_},
        .is_range = true};
    if (bias_sigma_m_ > 0.0)
      factor.unknowns.push_back(&slow_bias(anchor, keyframe.way_m + way_of(increment)));
    factors_.push_back(std::move(factor));
  }

  void add_keyframe(const Increment& increment) {
    const model::PlanarPose pose = predict(increment);
    const Keyframe& last = keyframes_.back();
    Keyframe next{last.t_s + increment.passed_s, last.way_m + way_of(increment), std::make_unique<Unknown>(),
                  pose.chart};
    next.pose->value = {pose.x_m, pose.y_m, pose.theta_rad};
    factors_.push_back(
        {.cost = std::make_unique<OdometryCost>(*drive_.surface, last.chart, next.chart, increment),
         .unknowns = {last.pose.get(), next.pose.get(), &odometry_}});
    keyframes_.push_back(std::move(next));
    if (options_.window_s <= 0.0 && keyframes_.size() >= placed_ + kPlaced) place();
  }

  // Pose after the increment from the last keyframe; theta is not wrapped.
  [[nodiscard]] model::PlanarPose predict(const Increment& increment) const {
    const Keyframe& last = keyframes_.back();
    const Eigen::Vector3d from = last.pose->vector();
    const double scale = 1.0 + odometry_.value[kScale];
    const double bias_radps = odometry_.value[kYawRateBias];
    const Eigen::Matrix2d flat =
        model::surface_rotation(drive_.surface->at(from.x(), from.y(), last.chart).gradient)
            .topLeftCorner<2, 2>();
    const Eigen::Vector2d at =
        from.head<2>() +
        flat * (turn(from.z()) * (scale * (increment.moved.head<2>() + bias_radps * increment.by_bias)));
    return {at.x(), at.y(), from.z() + increment.moved.z() - bias_radps * increment.passed_s,
            drive_.surface->follow(last.chart, at.x(), at.y())};
  }

  void solve() {
    const bool slides = options_.window_s > 0.0;
    if (!slides) place();
    ceres::Problem problem(problem_options());
    fill(problem, loss_.get());
    ceres::Solver::Summary summary;
    ceres::Solve(slides ? solver_options(5, 1e-5) : solver_options(30, 1e-6), &problem, &summary);
    Keyframe& last = keyframes_.back();
    last.chart = drive_.surface->follow(last.chart, last.pose->value[0], last.pose->value[1]);
    while (slides && keyframes_.size() > 2 && keyframes_.front().t_s < last.t_s - options_.window_s)
      marginalize();
  }

  // The inverse of the normal equations, the last pose's part.
  [[nodiscard]] Eigen::Matrix3d covariance() {
    ceres::Problem problem(problem_options());
    fill(problem, loss_.get());
    ceres::Problem::EvaluateOptions options;
    // Ceres would order them by their addresses, which differ from run to run.
    std::set<const double*> seen;
    for (const Factor& factor : factors_) {
      for (Unknown* unknown : factor.unknowns) {
        if (seen.insert(unknown->value.data()).second)
          options.parameter_blocks.push_back(unknown->value.data());
      }
    }
    ceres::CRSMatrix crs;
    problem.Evaluate(options, nullptr, nullptr, nullptr, &crs);
    using Sparse = Eigen::SparseMatrix<double, Eigen::RowMajor>;
    const Eigen::Map<const Sparse> jacobian(crs.num_rows, crs.num_cols, std::ssize(crs.values),
                                            crs.rows.data(), crs.cols.data(), crs.values.data());
    const Eigen::SparseMatrix<double> normal = (jacobian.transpose() * jacobian).eval();
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> root(normal);
    Eigen::Index column = 0;
    for (double* block : options.parameter_blocks) {
      if (block == keyframes_.back().pose->value.data()) break;
      column += problem.ParameterBlockSize(block);
    }
    Eigen::MatrixXd unit = Eigen::MatrixXd::Zero(crs.num_cols, 3);
    unit.middleRows(column, 3).setIdentity();
    return root.solve(unit).middleRows(column, 3);
  }

 private:
  static ceres::Solver::Options solver_options(int iterations, double tolerance) {
    ceres::Solver::Options options;
    options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
    // Without BLAS: the same bytes on each machine.
    options.sparse_linear_algebra_library_type = ceres::EIGEN_SPARSE;
    options.logging_type = ceres::SILENT;
    options.max_num_iterations = iterations;
    options.initial_trust_region_radius = 1e8;
    options.function_tolerance = tolerance;
    return options;
  }

  static ceres::Problem::Options problem_options() {
    ceres::Problem::Options options;
    options.cost_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
    options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
    return options;
  }

  void fill(ceres::Problem& problem, ceres::LossFunction* loss, std::size_t first = 0) {
    std::vector<double*> blocks;
    for (std::size_t i = first; i < factors_.size(); ++i) {
      Factor& factor = factors_[i];
      blocks.clear();
      for (Unknown* unknown : factor.unknowns) blocks.push_back(unknown->value.data());
      problem.AddResidualBlock(factor.cost.get(), factor.is_range ? loss : nullptr, blocks);
    }
  }

  // Moves the poses that are new since the last call to their ranges, all else fixed. By odometry alone they
  // are far from the optimum in units of the ranges' noise, hence first with a wide kernel.
  void place() {
    std::set<double*> free;
    for (std::size_t i = placed_; i < keyframes_.size(); ++i) free.insert(keyframes_[i].pose->value.data());
    const double kernel = options_.parameters.kernel;
    ceres::CauchyLoss wide(kernel > 0.0 ? kWide * kernel : 1.0);
    for (ceres::CauchyLoss* loss : {kernel > 0.0 ? &wide : nullptr, loss_.get()}) {
      ceres::Problem problem(problem_options());
      fill(problem, loss, placed_factors_);
      std::vector<double*> blocks;
      problem.GetParameterBlocks(&blocks);
      for (double* block : blocks) {
        if (free.count(block) == 0) problem.SetParameterBlockConstant(block);
      }
      ceres::Solver::Summary summary;
      ceres::Solve(solver_options(10, 1e-4), &problem, &summary);
      if (kernel <= 0.0) break;
    }
    placed_ = keyframes_.size();
    placed_factors_ = factors_.size();
  }

  void add_prior(Unknown& unknown, const Eigen::VectorXd& per_sigma) {
    factors_.push_back(
        {.cost = std::make_unique<LinearCost>(std::vector<int>{unknown.size()}, per_sigma.asDiagonal(),
                                              unknown.vector(), Eigen::VectorXd::Zero(per_sigma.size())),
         .unknowns = {&unknown}});
  }

  static double way_of(const Increment& increment) { return increment.moved.head<2>().norm(); }

  // A Gauss-Markov process in units of its sigma: one unknown for each part of the correlation length.
  Unknown& slow_bias(std::size_t anchor, double way_m) {
    std::deque<SlowBias>& all = biases_[anchor];
    const double part_m = bias_length_m_ / kBiasParts;
    if (!all.empty() && way_m < all.back().from_m + part_m) return *all.back().value;
    SlowBias next{way_m, std::make_unique<Unknown>()};
    next.value->value.assign(1, 0.0);
    if (all.empty()) {
      add_prior(*next.value, Eigen::VectorXd::Ones(1));
    } else {
      const double kept = std::exp(-(way_m - all.back().from_m) / bias_length_m_);
      const double per_sigma = 1.0 / std::sqrt(1.0 - kept * kept);
      next.value->value[0] = kept * all.back().value->value[0];
      factors_.push_back({.cost = std::make_unique<LinearCost>(
                              std::vector<int>{1, 1}, Eigen::RowVector2d(-kept * per_sigma, per_sigma),
                              Eigen::Vector2d::Zero(), Eigen::VectorXd::Zero(1)),
                          .unknowns = {all.back().value.get(), next.value.get()}});
    }
    all.push_back(std::move(next));
    return *all.back().value;
  }

  // Replaces the first keyframe, and slow biases that no later range has, by the prior that they leave on the
  // rest.
  void marginalize() {
    std::set<Unknown*> dropped{keyframes_.front().pose.get()};
    const double next_m = keyframes_[1].way_m;
    for (const std::deque<SlowBias>& all : biases_) {
      for (std::size_t i = 0; i + 1 < all.size() && all[i].from_m + bias_length_m_ / kBiasParts <= next_m;
           ++i)
        dropped.insert(all[i].value.get());
    }
    const auto take = [this](const auto& matches) {
      const auto middle = std::stable_partition(factors_.begin(), factors_.end(),
                                                [&](const Factor& factor) { return !matches(factor); });
      std::vector<Factor> taken(std::make_move_iterator(middle), std::make_move_iterator(factors_.end()));
      factors_.erase(middle, factors_.end());
      return taken;
    };
    std::vector<Factor> involved = take([&](const Factor& factor) { return factor.touches(dropped); });
    std::set<Unknown*> touched;
    for (const Factor& factor : involved) touched.insert(factor.unknowns.begin(), factor.unknowns.end());
    // Their own priors, so that the rest is determined.
    for (Factor& factor :
         take([&](const Factor& other) { return other.unknowns.size() == 1 && other.touches(touched); }))
      involved.push_back(std::move(factor));

    // Dropped unknowns first; the rest in the order in which the factors name them.
    std::map<Unknown*, Eigen::Index> begins;
    std::vector<Unknown*> kept;
    Eigen::Index size = 0;
    const auto place = [&](Unknown* unknown) {
      if (!begins.emplace(unknown, size).second) return false;
      size += unknown->size();
      return true;
    };
    for (const bool drops : {true, false}) {
      for (const Factor& factor : involved) {
        for (Unknown* unknown : factor.unknowns) {
          if ((dropped.count(unknown) > 0) == drops && place(unknown) && !drops) kept.push_back(unknown);
        }
      }
    }
    Eigen::Index first = size;
    for (Unknown* unknown : kept) first = std::min(first, begins[unknown]);

    Eigen::MatrixXd normal = Eigen::MatrixXd::Zero(size, size);
    Eigen::VectorXd right = Eigen::VectorXd::Zero(size);
    for (const Factor& factor : involved) accumulate(factor, begins, normal, right);
    const Eigen::Index rest = size - first;
    const Eigen::LDLT<Eigen::MatrixXd> corner(normal.topLeftCorner(first, first));
    const Eigen::MatrixXd gain = corner.solve(normal.topRightCorner(first, rest)).transpose();
    const Eigen::MatrixXd left =
        normal.bottomRightCorner(rest, rest) - gain * normal.topRightCorner(first, rest);
    const Eigen::VectorXd left_right = right.tail(rest) - gain * right.head(first);
    const Eigen::LLT<Eigen::MatrixXd> root(0.5 * (left + left.transpose()));
    Factor prior;
    std::vector<int> sizes;
    Eigen::VectorXd at(rest);
    for (Unknown* unknown : kept) {
      sizes.push_back(unknown->size());
      at.segment(begins[unknown] - first, unknown->size()) = unknown->vector();
    }
    prior.cost = std::make_unique<LinearCost>(sizes, root.matrixU(), at, root.matrixL().solve(left_right));
    prior.unknowns = kept;
    factors_.insert(factors_.begin(), std::move(prior));

    keyframes_.pop_front();
    for (std::deque<SlowBias>& all : biases_) {
      while (!all.empty() && dropped.count(all.front().value.get()) > 0) all.pop_front();
    }
  }

  // J^T J and J^T r of a factor, with its robust weight.
  void accumulate(const Factor& factor, const std::map<Unknown*, Eigen::Index>& begins,
                  Eigen::MatrixXd& normal, Eigen::VectorXd& right) const {
    const int rows = factor.cost->num_residuals();
    Eigen::VectorXd residual(rows);
    std::vector<RowMajor> by;
    std::vector<double*> jacobians(factor.unknowns.size());
    std::vector<const double*> values;
    for (Unknown* unknown : factor.unknowns) {
      by.emplace_back(rows, unknown->size());
      values.push_back(unknown->value.data());
    }
    std::transform(by.begin(), by.end(), jacobians.begin(), [](RowMajor& matrix) { return matrix.data(); });
    factor.cost->Evaluate(values.data(), residual.data(), jacobians.data());
    double weight = 1.0;
    if (factor.is_range && loss_ != nullptr) {
      std::array<double, 3> rho{};
      loss_->Evaluate(residual.squaredNorm(), rho.data());
      weight = rho[1];
    }
    for (std::size_t i = 0; i < by.size(); ++i) {
      const Eigen::Index row = begins.at(factor.unknowns[i]);
      right.segment(row, by[i].cols()) += weight * by[i].transpose() * residual;
      for (std::size_t j = 0; j < by.size(); ++j) {
        normal.block(row, begins.at(factor.unknowns[j]), by[i].cols(), by[j].cols()) +=
            weight * by[i].transpose() * by[j];
      }
    }
  }

  const Drive& drive_;  // NOLINT(*-avoid-const-or-ref-data-members)
  GraphOptions options_;
  double range_sigma_m_;
  double bias_sigma_m_;
  double bias_length_m_;
  std::unique_ptr<ceres::CauchyLoss> loss_;
  Unknown odometry_;
  Unknown frame_;
  std::vector<std::unique_ptr<Unknown>> anchors_;
  std::vector<std::unique_ptr<Unknown>> lever_arms_;
  std::vector<PairModel> pairs_;  // by anchor, then tag
  std::vector<std::deque<SlowBias>> biases_;
  std::deque<Keyframe> keyframes_;
  std::vector<Factor> factors_;
  std::size_t placed_ = 0;  // number of keyframes and factors at the last place()
  std::size_t placed_factors_ = 0;
};

Graph::Graph(const Drive& drive, const GraphOptions& options)
    : drive_(drive), options_(options), model_(std::make_unique<Model>(drive, options)) {}

Graph::~Graph() = default;

void Graph::move(double dt_s) {
  const Eigen::Vector3d velocity = velocity_of(held_.sample);
  Increment& i = increment_;
  const double half_s = i.passed_s + 0.5 * dt_s;
  const double middle_rad = i.moved.z() + 0.5 * velocity.z() * dt_s;
  const Eigen::Matrix2d rotation = turn(middle_rad);
  const Eigen::Vector2d by_middle = dt_s * (turn_by_angle(middle_rad) * velocity.head<2>());
  // White noise with the variance of one sample over its interval.
  Eigen::Matrix3d by_pose = Eigen::Matrix3d::Identity();
  by_pose.topRightCorner<2, 1>() = by_middle;
  Eigen::Matrix3d by_velocity = Eigen::Matrix3d::Zero();
  by_velocity.topLeftCorner<2, 2>() = dt_s * rotation;
  by_velocity.topRightCorner<2, 1>() = 0.5 * dt_s * by_middle;
  by_velocity(2, 2) = dt_s;
  i.covariance = by_pose * i.covariance * by_pose.transpose();
  i.covariance +=
      by_velocity *
      (variances_of(drive_.odometry_noise, options_.parameters.odometry_factor) * held_.interval_s / dt_s)
          .asDiagonal() *
      by_velocity.transpose();
  i.moved.head<2>() += dt_s * (rotation * velocity.head<2>());
  i.by_bias -= half_s * by_middle;
  i.moved.z() += velocity.z() * dt_s;
  i.passed_s += dt_s;
}

void Graph::add(const Range& range) {
  const Eigen::Vector3d velocity = velocity_of(held_.sample);
  increment_.velocity << turn(increment_.moved.z()) * velocity.head<2>(), velocity.z();
  model_->add(range, increment_);
}

void Graph::add_keyframe() {
  if (!(increment_.passed_s > 0.0)) return;
  model_->add_keyframe(increment_);
  increment_ = {};
}

void Graph::solve() {
  model_->solve();
}

Eigen::Matrix3d Graph::covariance() const {
  return model_->covariance();
}

model::PlanarEstimate Graph::predict(double t_s, const Eigen::Matrix3d& keyframe_covariance) const {
  const model::PlanarPose keyframe = model_->predict({});
  const model::PlanarPose pose = model_->predict(increment_);
  Eigen::Matrix3d by_keyframe = Eigen::Matrix3d::Identity();
  by_keyframe(0, 2) = -(pose.y_m - keyframe.y_m);
  by_keyframe(1, 2) = pose.x_m - keyframe.x_m;
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
  rotation.topLeftCorner<2, 2>() = turn(keyframe.theta_rad);
  return {t_s, pose.x_m, pose.y_m, model::wrap_angle(pose.theta_rad),
          by_keyframe * keyframe_covariance * by_keyframe.transpose() +
              rotation * increment_.covariance * rotation.transpose()};
}

namespace {

Eigen::Matrix3d start_covariance() {
  return Eigen::Vector3d(model::square(kStartSigma_m), model::square(kStartSigma_m),
                         model::square(kStartSigma_rad))
      .asDiagonal();
}

// Intervals are sums of decimal fractions.
constexpr double kRounding_s = 1e-6;

}  // namespace

CeresWindow::CeresWindow(const Drive& drive, const Parameters& parameters)
    : graph_(drive, {.keyframe_s = kKeyframe_s, .window_s = parameters.window_s, .parameters = parameters}),
      covariance_(start_covariance()) {}

void CeresWindow::hold(const Held& held) {
  graph_.hold(held);
}

void CeresWindow::move(double dt_s) {
  graph_.move(dt_s);
}

bool CeresWindow::measure(const Range& range) {
  graph_.add(range);
  return true;
}

model::PlanarEstimate CeresWindow::estimate(double t_s) {
  if (graph_.since_keyframe_s() >= kKeyframe_s - kRounding_s) {
    graph_.add_keyframe();
    graph_.solve();
    covariance_ = graph_.covariance();
  }
  return graph_.predict(t_s, covariance_);
}

CeresBatch::CeresBatch(const Drive& drive, const Parameters& parameters, std::vector<double> instants_s)
    : graph_(drive, {.keyframe_s = kKeyframe_s, .parameters = parameters}) {
  constexpr double kEach_s = 1.0;
  if (instants_s.empty()) {
    for (double t_s = drive.start.t_s + kEach_s; t_s <= drive.odometry.back().t_s; t_s += kEach_s)
      instants_s.push_back(t_s);
  }
  std::sort(instants_s.begin(), instants_s.end());
  for (const double instant_s : instants_s) {
    const auto after =
        std::upper_bound(drive.odometry.begin(), drive.odometry.end(), instant_s + kRounding_s,
                         [](double t_s, const model::OdometrySample& sample) { return t_s < sample.t_s; });
    if (after == drive.odometry.begin()) continue;
    const double row_s = std::prev(after)->t_s;
    if (row_s >= drive.start.t_s && (rows_s_.empty() || rows_s_.back() < row_s)) rows_s_.push_back(row_s);
  }
}

void CeresBatch::hold(const Held& held) {
  graph_.hold(held);
}

void CeresBatch::move(double dt_s) {
  graph_.move(dt_s);
}

bool CeresBatch::measure(const Range& range) {
  graph_.add(range);
  return true;
}

bool CeresBatch::has_row(double t_s) {
  const bool has = !rows_s_.empty() && t_s >= rows_s_.front();
  if (has || graph_.since_keyframe_s() >= kKeyframe_s - kRounding_s) graph_.add_keyframe();
  if (has) rows_s_.pop_front();
  return has;
}

model::PlanarEstimate CeresBatch::estimate(double t_s) {
  graph_.solve();
  return graph_.predict(t_s, graph_.covariance());
}

}  // namespace groma::baseline
