// The file that says which column or field of a recording is which column of a data set (YAML, schema 1).
#pragma once

#include <array>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/importer/table.hpp"
#include "host/io/error.hpp"

namespace groma::importer {

enum class Format { kCsv, kTum, kKitti, kRosbag2, kMat };
// In the order of Format.
inline constexpr std::array<std::string_view, 5> kFormatNames{"csv", "tum", "kitti", "rosbag2", "mat"};

// A column of a source: by its name, or by its number from 1; or a constant.
struct SourceColumn {
  std::string name;
  std::size_t number = 0;  // 0: by its name
  std::optional<double> constant;
};

// Ranges of one pair in a column of their own.
struct PairColumn {
  model::NodeId tag_id = 0;
  model::NodeId anchor_id = 0;
  SourceColumn column;
};

struct Source {
  std::string from;  // file name or topic; empty: each input
  Table to = Table::kRanges;
  std::map<std::string, SourceColumn, std::less<>> columns;  // by the data set's names
  std::vector<PairColumn> pairs;                             // in place of anchor_id, tag_id and range_m
  Units units;
  std::optional<Eigen::Isometry3d> base_link;  // in the frame whose poses these are
  // Of text files and MAT files.
  // Names are in the first line, in a comment, nowhere; or the first line has none that can be used.
  enum class Header { kFirst, kComment, kNone, kSkip };
  Header header = Header::kFirst;
  char separator = ',';                  // ' ': any blanks
  std::optional<SourceColumn> row_kind;  // only rows that have this text there
  std::string row_kind_text;
  bool sort_by_time = false;  // rows may be in any order
  std::string array;          // of MAT files: its name
  // Of messages: their definition, in the syntax of .msg files; empty: from the file, or known.
  std::string definition;
  io::FilePlace place;
};

enum class Axes { kDetected, kRobot, kCamera };

struct ImportMap {
  io::Dataset site;                // name, tags, anchors, noise, priors, surface: those given
  std::vector<std::string> given;  // keys of the site that were given
  std::vector<Source> sources;
  Axes axes = Axes::kDetected;  // of KITTI poses
};

// The map of inputs of this format: a key that the format does not use is an error. Throws io::ConfigError,
// or io::DataError of a file that the map names.
[[nodiscard]] ImportMap read_import_map(const std::filesystem::path& path, Format format);

}  // namespace groma::importer
