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

// Writes the folder's files, each whole or not at all, numbers as short as they read back exactly. Files for
// which the data set has nothing are left out: anchors.csv, groundtruth.csv, pose_prior.csv. Its name and
// origin are written plain: no line ends in them. Throws as write_file().
void write_dataset(const std::filesystem::path& folder, const Dataset& dataset);

}  // namespace groma::io
