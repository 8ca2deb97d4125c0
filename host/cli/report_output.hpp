// --report DIR of the commands: DIR/report.html, with the command and the date at its foot.
#pragma once

#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include <CLI/App.hpp>

#include "host/filter/replay.hpp"
#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"
#include "host/report/drive_report.hpp"
#include "host/report/page.hpp"
#include "host/smoother/smoother.hpp"

namespace groma::cli {

// The program's arguments, the first of which is its name. Call it once, before a report is written.
void note_command_line(std::span<char* const> arguments);

using ReportFolder = std::optional<std::filesystem::path>;

void add_report_option(CLI::App& command, ReportFolder& folder);

// Makes the folder if one is given. Throws as io::write_file() if the report could not be written.
void prepare_report(const ReportFolder& folder);

// Writes the page. `versions`: of the inputs, by name. Throws as io::write_file().
void write_page(const std::filesystem::path& folder, report::Page page,
                std::vector<std::pair<std::string, std::string>> versions);

// The program and the input that made a calibration.
[[nodiscard]] std::string version_of(const model::Calibration& calibration);

// Digests and versions of the inputs of a filter.
[[nodiscard]] std::vector<std::pair<std::string, std::string>> versions_of(
    const io::Dataset& dataset, const model::Calibration& calibration);

// Appends each range that reaches the gate to `rows`, after what the options already call.
void record_ranges(filter::ReplayOptions& options, std::vector<report::RangeRow>& rows);

[[nodiscard]] std::vector<report::StateSpan> state_spans(const filter::ReplayResult& result);

// The ground truth of a data set folder, for a report alone; empty if there is none. Throws as
// io::read_dataset().
[[nodiscard]] std::vector<model::PoseSample> truth_of(const std::filesystem::path& dataset);

// Ranges less those that the calibration predicts at the smoothed poses, with the smoother's weights; no
// range outside the poses' times, or on a surface of several charts.
[[nodiscard]] std::vector<report::RangeRow> residuals(const filter::Run& run, const smoother::Result& result);

}  // namespace groma::cli
