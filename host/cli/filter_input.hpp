// Input of a filter or smoother for a recorded drive: the drive, a calibration, a start.
#pragma once

#include <array>
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include <CLI/App.hpp>

#include "host/cli/selection.hpp"
#include "host/cli/warnings.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/filter/replay.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "host/model/calibration.hpp"

namespace groma::cli {

class FilterInput {
 public:
  // DATASET_OR_LOG, --calibration, --surveyed, --start and the options of Selection.
  void add_options(CLI::App& command);

  // --relocate, for a filter that may re-initialize elsewhere.
  void add_relocation(CLI::App& command);
  // --json.
  void add_json(CLI::App& command);
  // -o.
  void add_output_file(CLI::App& command, const std::string& description);
  // -o for an estimate file, and --json.
  void add_output(CLI::App& command);

  struct Drive {
    io::Dataset dataset;  // after the selection
    model::Calibration calibration;
    filter::ReplayOptions options;  // the run's sigmas, start and end; the default model

    [[nodiscard]] filter::Run run() const {
      return {dataset.odometry, dataset.ranges, dataset.tags,
              &dataset.surface, &calibration,   &dataset.sensor_samples};
    }
  };
  // Throws as the readers do, CLI::ValidationError for contradicting options and, if a start is needed and
  // there is none, DataError.
  enum class StartIs { kNeeded, kFoundOtherwise };
  [[nodiscard]] Drive read(const char* command, StartIs start, Warnings& warnings) const;
  // For a command that also takes a drive without --calibration and --surveyed: whether one is given, and the
  // drive alone, after the selection.
  [[nodiscard]] bool has_calibration() const noexcept { return surveyed_ || calibration_.has_value(); }
  [[nodiscard]] io::Dataset read_drive(Warnings& warnings) const;

  // Throws DataError, which names the odometry sample, if a pose or covariance is not finite.
  void expect_finite(std::span<const model::PlanarEstimate> rows,
                     std::span<const model::SpatialEstimate> spatial = {}) const;
  // The mistakes that ranges, odometry and calibration show. From any thread.
  [[nodiscard]] static std::vector<diagnosis::Finding> diagnose(const Drive& drive);
  // Warns if the ranges contradict the calibration, and returns the finding.
  static std::optional<diagnosis::Finding> warn_of_mismatch(const filter::ReplayResult& result,
                                                            Warnings& warnings);
  // Warns of dropped odometry and sensor samples that no robot can perform.
  static void warn_of_samples(const filter::Counters& counters, Warnings& warnings);
  // Warns of ranges that the calibration does not cover.
  static void warn_of_ranges(const filter::Counters& counters, Warnings& warnings);
  static void warn_without_ranges(std::size_t ranges_seen, Warnings& warnings);

  [[nodiscard]] const std::filesystem::path& dataset() const noexcept { return dataset_; }
  [[nodiscard]] const std::filesystem::path& output() const noexcept { return output_; }
  [[nodiscard]] const Selection& selection() const noexcept { return selection_; }
  [[nodiscard]] bool json() const noexcept { return json_; }

 private:
  // The drive before the selection.
  [[nodiscard]] io::Dataset read_whole(StartIs start, Warnings& warnings) const;
  [[nodiscard]] model::Calibration load_calibration(const io::Dataset& dataset, Warnings& warnings) const;
  [[nodiscard]] std::optional<filter::Start> find_start(const io::Dataset& dataset) const;
  // The place of the odometry sample at t_s: its line in a folder's odometry.csv, else the log.
  [[nodiscard]] io::FilePlace odometry_place(double t_s) const;

  std::filesystem::path dataset_;
  std::optional<std::filesystem::path> calibration_;
  bool surveyed_ = false;
  Selection selection_;
  std::optional<std::array<double, 3>> start_;
  std::filesystem::path output_;
  bool json_ = false;
  bool relocates_ = false;
};

}  // namespace groma::cli
