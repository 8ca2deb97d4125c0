// An anchor's rows as the solver's inner loops read them: tag by tag, column by column.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/robust_kernel.hpp"

namespace groma::calibration {

// A copy: rows that change later are not seen.
class RowColumns {
 public:
  RowColumns(std::span<const Observation> rows, std::size_t tag_count) : tags_(tag_count) {
    for (const Observation& row : rows) ++tags_[row.tag].count;
    Eigen::Index size = 0;
    for (Tag& tag : tags_) {
      tag.first = size;
      size += (tag.count + kLanes - 1) / kLanes * kLanes;
    }
    columns_.resize(size, kColumns);
    index_.resize(static_cast<std::size_t>(size));
    std::vector<Eigen::Index> next;
    next.reserve(tag_count);
    for (const Tag& tag : tags_) next.push_back(tag.first);
    for (const Observation& row : rows) {
      const Eigen::Index at = next[row.tag]++;
      columns_(at, 0) = row.tag_m.x();
      columns_(at, 1) = row.tag_m.y();
      columns_(at, 2) = row.tag_m.z();
      columns_(at, kRange) = row.range_m;
      index_[static_cast<std::size_t>(at)] = row.index;
    }
    const auto is_told = [](const Observation& row) { return !row.pose_spread_m2.isZero(0.0F); };
    if (std::any_of(rows.begin(), rows.end(), is_told)) {
      spread_m2_.setZero(size, 3);
      std::vector<Eigen::Index> again;
      again.reserve(tag_count);
      for (const Tag& tag : tags_) again.push_back(tag.first);
      for (const Observation& row : rows) {
        spread_m2_.row(again[row.tag]++) = row.pose_spread_m2.transpose().cast<double>().array();
      }
    }
    // What fills the last lanes up is no range: it has no weight.
    for (std::size_t tag = 0; tag < tag_count; ++tag) {
      const Eigen::Index filled = tags_[tag].first + blocks(tag) * kLanes;
      for (Eigen::Index at = next[tag]; at < filled; ++at) {
        columns_.row(at).setZero();
        columns_(at, kRange) = std::numeric_limits<double>::quiet_NaN();
      }
    }
  }

  // kLanes rows of a tag, the last of them filled up with ranges that are no number.
  [[nodiscard]] Eigen::Index blocks(std::size_t tag) const noexcept {
    return (tags_[tag].count + kLanes - 1) / kLanes;
  }
  [[nodiscard]] Eigen::Index rows_in(std::size_t tag, Eigen::Index block) const noexcept {
    return std::min(kLanes, tags_[tag].count - block * kLanes);
  }
  // axis 0..2 of the antenna's place, m
  [[nodiscard]] auto antenna_m(std::size_t tag, Eigen::Index block, Eigen::Index axis) const noexcept {
    return columns_.col(axis).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  [[nodiscard]] auto range_m(std::size_t tag, Eigen::Index block) const noexcept {
    return columns_.col(kRange).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  // Whether some row has a spread; term 0..2 of it, m^2.
  [[nodiscard]] bool tells_spread() const noexcept { return spread_m2_.rows() > 0; }
  [[nodiscard]] auto spread_m2(std::size_t tag, Eigen::Index block, Eigen::Index term) const noexcept {
    return spread_m2_.col(term).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  // Observation::index
  [[nodiscard]] std::uint32_t index(std::size_t tag, Eigen::Index block, Eigen::Index lane) const noexcept {
    return index_[static_cast<std::size_t>(tags_[tag].first + block * kLanes + lane)];
  }

 private:
  struct Tag {
    Eigen::Index first = 0;
    Eigen::Index count = 0;
  };
  static constexpr Eigen::Index kRange = 3;
  static constexpr Eigen::Index kColumns = 4;

  std::vector<Tag> tags_;
  Eigen::Array<double, Eigen::Dynamic, kColumns> columns_;
  Eigen::Array<double, Eigen::Dynamic, 3> spread_m2_;  // of the antennas; empty where none is told
  std::vector<std::uint32_t> index_;
};

}  // namespace groma::calibration
