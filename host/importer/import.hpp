// Recordings of other programs as a data set.
#pragma once

#include <cstddef>
#include <filesystem>
#include <span>
#include <string>
#include <vector>

#include "host/importer/import_map.hpp"
#include "host/importer/table.hpp"
#include "host/io/dataset.hpp"

namespace groma::importer {

// What one source gave.
struct ImportedTable {
  Table table = Table::kRanges;
  std::string source;  // file or topic
  std::size_t rows = 0;
  std::string note;  // how it was read, where that was not obvious
};

struct Imported {
  io::Dataset dataset;
  std::vector<ImportedTable> tables;
  std::vector<std::string> warnings;
};

// Adds what the inputs contain to `base`: a table that they contain replaces that of `base`, as a key of the
// map replaces its own. Throws io::DataError (an input cannot be read, or is implausible), io::ConfigError
// (the map does not fit) or io::PermissionError.
[[nodiscard]] Imported import_files(Format format, std::span<const std::filesystem::path> inputs,
                                    const ImportMap& map, io::Dataset base);

// The parts of import_files(): each adds its rows to `out`.
void import_text(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out);
void import_tum(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out);
void import_kitti(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out);
void import_bags(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out);

// Call it before a source adds rows to a table: its first source replaces what was there. Returns the number
// of rows that are there then.
[[nodiscard]] std::size_t begin_table(Table table, Imported& out);

// Checks the rows from `begin` on that one source has added to a table: times that increase at a plausible
// step, ranges and headings of plausible size. Units that the user gave are not checked. Throws
// io::DataError.
void expect_plausible(const std::filesystem::path& path, const ImportedTable& imported, std::size_t begin,
                      const Units& units, const io::Dataset& dataset);

}  // namespace groma::importer
