// The part of a run that a command uses: a time interval, tags, anchors.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <CLI/App.hpp>

#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::cli {

class Selection {
 public:
  // Declares --from, --to, --tags, --anchors and --section.
  void add_options(CLI::App& command);

  // Removes the rest from the data set: ranges by time, tag and anchor, pose priors by time, tags by id.
  // Throws CLI::ValidationError for a tag that the data set lacks, for an anchor that it has neither ranges
  // to nor a surveyed position of and that is not among `calibrated`, an empty time interval, or --section
  // with a folder.
  void apply(io::Dataset& dataset, std::span<const model::AnchorCalibration> calibrated = {}) const;

  [[nodiscard]] std::optional<double> from_s() const { return from_s_; }
  [[nodiscard]] std::optional<double> to_s() const { return to_s_; }
  [[nodiscard]] std::optional<std::size_t> section() const { return section_; }

 private:
  std::optional<double> from_s_;
  std::optional<double> to_s_;
  std::optional<std::size_t> section_;
  std::vector<model::NodeId> tags_;     // empty: all
  std::vector<model::NodeId> anchors_;  // empty: all
};

// One finite number. Throws CLI::ValidationError, which names the option and `unit`.
[[nodiscard]] double parse_number(const std::string& option, const std::string& text, std::string_view unit);
// Comma-separated values, such as "1,2" or "0.5,-2,3.1". Throws CLI::ValidationError, which names the option.
[[nodiscard]] std::vector<model::NodeId> parse_ids(const std::string& option, const std::string& text);
[[nodiscard]] std::vector<double> parse_numbers(const std::string& option, const std::string& text,
                                                std::size_t count);

}  // namespace groma::cli
