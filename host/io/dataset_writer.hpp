// Writes the data sets that dataset.hpp reads.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "host/io/dataset.hpp"

namespace groma::io {

// The files that describe the site and the robot: tags.csv, surface.csv (for a spline; surface_i.csv for the
// i-th of several floors), and last dataset.yaml, which completes a folder.
[[nodiscard]] std::vector<DescriptionFile> describe(const Dataset& dataset);

// The text of a spline surface's file.
[[nodiscard]] std::string format_spline(const model::BSpline& spline);

// Writes the folder's files, each atomically; numbers have the shortest form that reads back exactly. If the
// folder was empty, read_dataset() then reads an equal data set, except `dropped`, `log` and `sha256`. A
// table without rows has no file, except ranges.csv and odometry.csv; without pose_prior.csv, read_dataset()
// takes the ground truth instead. Name and origin must not contain line ends. Throws as write_file().
void write_dataset(const std::filesystem::path& folder, const Dataset& dataset);

}  // namespace groma::io
