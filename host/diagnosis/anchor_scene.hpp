// Ranges of a drive whose poses are known; each anchor's position and biases are unknown.
#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Core>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/range_fit.hpp"
#include "host/model/pose.hpp"

namespace groma::diagnosis {

// A block: position (m), gamma, then beta of each tag (m). `data` must outlive the scene.
class AnchorScene final : public Scene {
 public:
  // Evenly thinned to at most most_rows ranges, but to no fewer than 20 a pair.
  AnchorScene(const Data& data, std::size_t most_rows);

  [[nodiscard]] std::size_t block_count() const override { return anchors_.size(); }
  // Of each block.
  [[nodiscard]] const std::vector<model::NodeId>& anchors() const noexcept { return anchors_; }
  void locate(const Mistake& mistake, std::vector<Eigen::Vector3d>& antennas_m) const override;
  [[nodiscard]] double predict_m(const RangeRow& row, const Eigen::Vector3d& antenna_m,
                                 const Eigen::VectorXd& block, RangeDerivatives& out) const override;
  [[nodiscard]] std::vector<Eigen::VectorXd> starts(
      std::span<const RangeRow> rows, std::span<const Eigen::Vector3d> antennas_m) const override;

 private:
  [[nodiscard]] Eigen::Vector3d antenna_m(const RangeRow& row, const Mistake& mistake) const;

  const Data& data_;
  std::vector<model::NodeId> anchors_;
};

}  // namespace groma::diagnosis
