#include "host/smoother/chain_problem.hpp"

namespace groma::smoother {

ChainProblem::Term::Term(Eigen::Index block_size, Eigen::Index residual_size, Eigen::Index shared_size)
    : by_first(Eigen::MatrixXd::Zero(residual_size, block_size)),
      by_second(Eigen::MatrixXd::Zero(residual_size, block_size)),
      by_shared(Eigen::MatrixXd::Zero(residual_size, shared_size)),
      shared(static_cast<std::size_t>(shared_size)),
      residual(Eigen::VectorXd::Zero(residual_size)),
      information(Eigen::MatrixXd::Zero(residual_size, residual_size)) {}

ChainProblem::ChainProblem(std::size_t blocks, Eigen::Index block_size, Eigen::Index shared_size,
                           Eigen::Index considered)
    : blocks_(blocks), block_size_(block_size), shared_size_(shared_size), considered_(considered) {
  clear();
}

void ChainProblem::clear() {
  for (Block& block : blocks_) {
    block.own.setZero(block_size_, block_size_);
    block.next.setZero(block_size_, block_size_);
    block.shared.setZero(block_size_, shared_size_);
    block.right.setZero(block_size_);
  }
  shared_.setZero(shared_size_, shared_size_);
  shared_right_.setZero(shared_size_);
  cost_ = 0.0;
}

void ChainProblem::add_shared_prior(const Eigen::VectorXd& unknowns) {
  shared_.diagonal().array() += 1.0;
  shared_right_ -= unknowns;
  cost_ += 0.5 * unknowns.squaredNorm();
}

void ChainProblem::add(std::size_t k, const Term& term) {
  cost_ += 0.5 * term.residual.dot(term.information * term.residual);
  Block& first = blocks_[k];
  Block& second = blocks_[k + 1];
  const Eigen::MatrixXd first_weighed = term.by_first.transpose() * term.information;
  const Eigen::MatrixXd second_weighed = term.by_second.transpose() * term.information;
  first.own.noalias() += first_weighed * term.by_first;
  first.next.noalias() += first_weighed * term.by_second;
  first.right.noalias() += first_weighed * term.residual;
  second.own.noalias() += second_weighed * term.by_second;
  second.right.noalias() += second_weighed * term.residual;
  if (term.shared.empty()) return;
  const Eigen::MatrixXd shared_weighed = term.by_shared.transpose() * term.information;
  const Eigen::MatrixXd first_shared = first_weighed * term.by_shared;
  const Eigen::MatrixXd second_shared = second_weighed * term.by_shared;
  const Eigen::MatrixXd own = shared_weighed * term.by_shared;
  const Eigen::VectorXd right = shared_weighed * term.residual;
  for (std::size_t j = 0; j < term.shared.size(); ++j) {
    const Eigen::Index column = term.shared[j];
    const auto from = static_cast<Eigen::Index>(j);
    first.shared.col(column) += first_shared.col(from);
    second.shared.col(column) += second_shared.col(from);
    shared_right_(column) += right(from);
    for (std::size_t i = 0; i < term.shared.size(); ++i) {
      shared_(term.shared[i], column) += own(static_cast<Eigen::Index>(i), from);
    }
  }
}

ChainProblem::Solution ChainProblem::solve(double damping) {
  Eigen::MatrixXd shared = shared_;
  Eigen::VectorXd shared_right = shared_right_;
  for (std::size_t k = 0; k < blocks_.size(); ++k) {
    Block& block = blocks_[k];
    const Eigen::LLT<Eigen::MatrixXd> root(block.own);
    block.inverse = root.solve(Eigen::MatrixXd::Identity(block.own.rows(), block.own.cols()));
    const Eigen::MatrixXd half = root.matrixL().solve(block.shared);
    shared.selfadjointView<Eigen::Lower>().rankUpdate(half.transpose(), -1.0);
    block.to_shared = root.matrixU().solve(half);
    block.alone = root.solve(block.right);
    shared_right.noalias() -= block.shared.transpose() * block.alone;
    if (k + 1 == blocks_.size()) break;
    Block& next = blocks_[k + 1];
    block.to_next = root.solve(block.next);
    next.own.noalias() -= block.next.transpose() * block.to_next;
    next.shared.noalias() -= block.next.transpose() * block.to_shared;
    next.right.noalias() -= block.next.transpose() * block.alone;
  }
  const Eigen::Index solved = shared.rows() - considered_;
  by_considered_.setZero(solved, considered_);
  Solution out;
  out.shared = Eigen::VectorXd::Zero(shared.rows());
  if (solved > 0) {
    shared.diagonal().head(solved).array() += damping;
    shared_root_.compute(shared.topLeftCorner(solved, solved));
    out.shared.head(solved) = shared_root_.solve(shared_right.head(solved));
    if (considered_ > 0)
      by_considered_ = shared_root_.solve(shared.bottomLeftCorner(considered_, solved).transpose());
  }
  out.blocks.resize(blocks_.size());
  for (std::size_t k = blocks_.size(); k-- > 0;) {
    out.blocks[k] = blocks_[k].alone - blocks_[k].to_shared * out.shared;
    if (k + 1 < blocks_.size()) out.blocks[k] -= blocks_[k].to_next * out.blocks[k + 1];
  }
  return out;
}

std::vector<Eigen::MatrixXd> ChainProblem::covariances(const std::vector<Eigen::Index>& shared) const {
  std::vector<Eigen::MatrixXd> out(blocks_.size());
  const auto beside = static_cast<Eigen::Index>(shared.size());
  Eigen::MatrixXd given_shared;  // covariance of the next block given the shared vector
  Eigen::MatrixXd by_shared;     // negative derivative of the next block w.r.t. the shared vector
  for (std::size_t k = blocks_.size(); k-- > 0;) {
    const Block& block = blocks_[k];
    Eigen::MatrixXd own = block.inverse;
    Eigen::MatrixXd by = block.to_shared;
    if (k + 1 < blocks_.size()) {
      own.noalias() += block.to_next * given_shared * block.to_next.transpose();
      by.noalias() -= block.to_next * by_shared;
    }
    given_shared = std::move(own);
    by_shared = std::move(by);
    const Eigen::Index size = given_shared.rows();
    Eigen::MatrixXd with_shared = Eigen::MatrixXd::Zero(size + beside, by_shared.cols());
    with_shared.topRows(size) = by_shared;
    for (Eigen::Index i = 0; i < beside; ++i)
      with_shared(size + i, shared[static_cast<std::size_t>(i)]) = -1.0;
    const auto solved = with_shared.leftCols(with_shared.cols() - considered_);
    out[k] = Eigen::MatrixXd::Zero(size + beside, size + beside);
    out[k].topLeftCorner(size, size) = given_shared;
    if (solved.cols() > 0) out[k].noalias() += solved * shared_root_.solve(solved.transpose());
    if (considered_ == 0) continue;
    Eigen::MatrixXd off = -with_shared.rightCols(considered_);
    if (solved.cols() > 0) off.noalias() += solved * by_considered_;
    out[k].noalias() += off * off.transpose();
  }
  return out;
}

}  // namespace groma::smoother
