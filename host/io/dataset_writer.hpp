// Data sets out: what dataset.hpp reads.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "host/io/dataset.hpp"

namespace groma::io {

// What tells of the site and the robot: tags.csv, surface.csv (of a spline; of the i-th of several
// floors surface_i.csv), and last dataset.yaml, with
// which a folder is whole.
[[nodiscard]] std::vector<DescriptionFile> describe(const Dataset& dataset);

// The file of a spline surface.
[[nodiscard]] std::string format_spline(const model::BSpline& spline);

// Writes the folder's files, each whole or not at all, numbers as short as they read back exactly. From a
// folder that was empty read_dataset() reads an equal data set, except what describes the reading: `dropped`,
// `log` and `sha256`. A table without rows has no file, except ranges.csv and odometry.csv: without
// pose_prior.csv the ground truth is read in its place. Name and origin contain no line ends. Throws as
// write_file().
void write_dataset(const std::filesystem::path& folder, const Dataset& dataset);

}  // namespace groma::io
