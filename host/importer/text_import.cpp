// Tables as text: CSV in any layout, TUM and KITTI trajectories; the arrays of MAT files as such.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cmath>
#include <optional>
#include <set>
#include <utility>

#include <Eigen/Geometry>

#include "host/importer/import.hpp"
#include "host/importer/mat_file.hpp"
#include "host/io/csv.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"

namespace groma::importer {

namespace {

using Fields = std::vector<std::string_view>;

std::string_view trimmed(std::string_view text) {
  const std::size_t first = text.find_first_not_of(" \t\r\"");
  if (first == std::string_view::npos) return {};
  return text.substr(first, text.find_last_not_of(" \t\r\"") + 1 - first);
}

// Without blanks and quotes around each field. ' ' separates at any number of blanks.
void split(std::string_view line, char separator, Fields& out) {
  out.clear();
  if (separator != ' ') {
    for (bool more = true; more;) {
      const std::size_t end = line.find(separator);
      more = end != std::string_view::npos;
      out.push_back(trimmed(line.substr(0, end)));
      if (more) line.remove_prefix(end + 1);
    }
    return;
  }
  for (std::size_t at = 0; (at = line.find_first_not_of(" \t\r", at)) != std::string_view::npos;) {
    const std::size_t end = std::min(line.find_first_of(" \t\r", at), line.size());
    out.push_back(trimmed(line.substr(at, end - at)));
    at = end;
  }
}

// The names of a header for a message. A file that is no text may have a header of any length.
std::string joined(const Fields& names) {
  constexpr std::size_t kMostNames = 40;
  std::string text;
  for (std::size_t i = 0; i < names.size() && i < kMostNames; ++i)
    text += (text.empty() ? "" : ", ") + io::escaped(names[i]);
  return names.size() > kMostNames ? text + ", ..." : text;
}

// "2022-08-15 9:42:24.765958", with a T or a blank, in UTC: seconds since 1970. None: it is no date.
std::optional<double> parse_date(std::string_view text) {
  if (text.ends_with('Z')) text.remove_suffix(1);
  // Reads a number, and one of these characters after it; none: the end.
  const auto read = [&](auto& value, std::string_view ends) {
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
    if (error != std::errc()) return false;
    text.remove_prefix(static_cast<std::size_t>(end - text.data()));
    if (ends.empty() || text.empty()) return ends.empty() && text.empty();
    const bool is_end = ends.find(text.front()) != std::string_view::npos;
    text.remove_prefix(1);
    return is_end;
  };
  int year = 0;
  unsigned month = 0;
  unsigned day = 0;
  int hours = 0;
  int minutes = 0;
  double seconds = 0.0;
  if (!read(year, "-") || !read(month, "-") || !read(day, "T ") || !read(hours, ":") || !read(minutes, ":") ||
      !read(seconds, ""))
    return std::nullopt;
  const std::chrono::year_month_day date{std::chrono::year(year), std::chrono::month(month),
                                         std::chrono::day(day)};
  const bool is_time = hours >= 0 && hours < 24 && minutes >= 0 && minutes < 60 && seconds >= 0.0 &&
                       seconds < 61.0;  // with a leap second
  if (!date.ok() || !is_time) return std::nullopt;
  const auto days = std::chrono::sys_days(date).time_since_epoch().count();
  return 86400.0 * static_cast<double>(days) + 3600.0 * hours + 60.0 * minutes + seconds;
}

// The rows of one text file, as a source describes them.
class TextRows {
 public:
  TextRows(const std::filesystem::path& path, std::string_view text, const Source& source)
      : path_(path), source_(source), lines_(text) {
    if (source.header == Source::Header::kComment) {
      read_comment(text);
    } else if (source.header == Source::Header::kFirst && lines_.next()) {
      split(lines_.line(), source.separator, names_);
      header_line_ = lines_.number();
    }
    if (source.header == Source::Header::kSkip) static_cast<void>(lines_.next());
    const bool has_names =
        source.header == Source::Header::kFirst || source.header == Source::Header::kComment;
    if (has_names && names_.empty())
      throw io::DataError({path, 1, 0}, "has no header",
                          "add a line with the names of the columns, or write header: none in the map");
  }

  [[nodiscard]] const Fields& names() const { return names_; }
  [[nodiscard]] bool has(std::string_view name) const {
    return std::find(names_.begin(), names_.end(), name) != names_.end();
  }

  // The index of a column in each row.
  [[nodiscard]] std::size_t index_of(const SourceColumn& column) const {
    if (column.number > 0 && !has(column.name)) return column.number - 1;
    const auto found = std::find(names_.begin(), names_.end(), column.name);
    if (found != names_.end() && std::find(found + 1, names_.end(), column.name) != names_.end())
      throw io::DataError({path_, header_line_, 0}, fmt::format("column {} occurs twice", column.name),
                          "rename one of them, or write the number of the column in the map");
    if (found == names_.end()) {
      throw io::DataError({path_, header_line_, 0}, fmt::format("column {} is missing", column.name),
                          names_.empty() ? "write the number of the column in the map"
                                         : fmt::format("the header has {}", joined(names_)));
    }
    return static_cast<std::size_t>(found - names_.begin());
  }

  bool next() {
    while (lines_.next()) {
      split(lines_.line(), source_.separator, fields_);
      if (!names_.empty() && fields_.size() != names_.size()) {
        throw io::DataError(
            place(), fmt::format("the row has {} fields, the header {}", fields_.size(), names_.size()),
            "complete the row, or remove it");
      }
      if (!source_.row_kind || field(index_of(*source_.row_kind)) == source_.row_kind_text) return true;
    }
    return false;
  }

  [[nodiscard]] std::string_view field(std::size_t index) const {
    if (index >= fields_.size()) {
      throw io::DataError(
          place(), fmt::format("the row has {} fields, and column {} is needed", fields_.size(), index + 1),
          "complete the row, or correct the map");
    }
    return fields_[index];
  }
  [[nodiscard]] io::FilePlace place() const { return {path_, lines_.number(), 0}; }
  [[nodiscard]] io::FilePlace place(std::string_view field) const {
    return {path_, lines_.number(), static_cast<std::size_t>(field.data() - lines_.line().data()) + 1};
  }

 private:
  // The last comment before the first row.
  void read_comment(std::string_view text) {
    if (text.starts_with(io::kByteOrderMark)) text.remove_prefix(io::kByteOrderMark.size());
    while (!text.empty()) {
      const std::size_t end = text.find('\n');
      std::string_view line = trimmed(text.substr(0, end));
      if (!line.starts_with('#')) break;
      ++header_line_;
      line.remove_prefix(1);
      split(trimmed(line), source_.separator, names_);
      if (end == std::string_view::npos) break;
      text.remove_prefix(end + 1);
    }
  }

  std::filesystem::path path_;
  const Source& source_;
  io::LineReader lines_;
  Fields names_;  // empty: no header
  std::size_t header_line_ = 0;
  Fields fields_;
};

Cell parse_cell(std::string_view field, bool is_date, bool is_required, const io::FilePlace& place) {
  if (field.empty() && !is_required) return {};
  if (is_date) {
    const std::optional<double> t_s = parse_date(field);
    if (!t_s)
      throw io::DataError(place, fmt::format("{} is no date", io::shown(field)),
                          "write it as 2026-01-31 12:00:00.5");
    return cell(*t_s);
  }
  std::int64_t whole = 0;
  const auto [end, error] = std::from_chars(field.data(), field.data() + field.size(), whole);
  if (error == std::errc() && end == field.data() + field.size()) return cell(whole);
  if (!is_required && (field == "nan" || field == "NaN")) return {};
  return cell(io::parse_number(field, place));
}

// Where a column of the data set comes from.
struct ColumnOrigin {
  std::optional<std::size_t> index;
  Cell constant;
};

// Those of columns_of(source.to).
std::vector<ColumnOrigin> origins_of(const TextRows& rows, const Source& source) {
  std::vector<ColumnOrigin> origins;
  for (const ColumnType& column : columns_of(source.to)) {
    ColumnOrigin& origin = origins.emplace_back();
    const bool is_of_pair = !source.pairs.empty() && column.name != "t_s";
    const auto given = source.columns.find(column.name);
    if (given != source.columns.end() && given->second.constant) {
      origin.constant = cell(*given->second.constant);
    } else if (given != source.columns.end()) {
      origin.index = rows.index_of(given->second);
    } else if (rows.has(column.name)) {
      origin.index = rows.index_of({.name = std::string(column.name), .number = 0, .constant = {}});
    } else if (column.required && !is_of_pair) {
      const std::string names =
          rows.names().empty() ? "" : fmt::format("; the header has {}", joined(rows.names()));
      throw io::DataError({rows.place().path},
                          fmt::format("nothing gives {} of {}.csv{}", column.name, name_of(source.to), names),
                          fmt::format("write columns: {{{}: COLUMN}} in the map", column.name));
    }
  }
  return origins;
}

void add(const TextRows& rows, const Source& source, std::span<const Cell> cells, Imported& out) {
  const std::string problem = add_row(source.to, cells, source.units, out.dataset);
  if (!problem.empty())
    throw io::DataError(rows.place(), problem, "correct the row, or the columns in the map");
}

// The ranges of a row that has a column for each pair. An empty field, NaN and 0 mean that there is none.
void add_pairs(const TextRows& rows, const Source& source, std::span<const std::size_t> columns,
               std::vector<Cell> cells, Imported& out) {
  for (std::size_t i = 0; i < columns.size(); ++i) {
    const std::string_view field = rows.field(columns[i]);
    const Cell range = parse_cell(field, false, false, rows.place(field));
    if (!range.is_known || range.number == 0.0) continue;
    cells[1] = cell(std::int64_t{source.pairs[i].tag_id});
    cells[2] = cell(std::int64_t{source.pairs[i].anchor_id});
    cells[3] = range;
    add(rows, source, cells, out);
  }
}

void finish_table(const std::filesystem::path& path, const Source& source, std::size_t begin,
                  std::string note, Imported& out) {
  if (source.base_link) move_to_base_link(source.to, begin, *source.base_link, out.dataset);
  if (source.sort_by_time) sort_by_time(source.to, out.dataset);
  const ImportedTable& imported = out.tables.emplace_back(ImportedTable{
      source.to, path.filename().string(), rows_of(source.to, out.dataset) - begin, std::move(note)});
  if (imported.rows == 0) throw io::DataError({path}, "has no rows", "give another file, or correct the map");
  expect_plausible(path, imported, begin, source.units, out.dataset);
}

void import_table(const std::filesystem::path& path, const Source& source, Imported& out) {
  const std::string text = source.array.empty() ? io::read_file(path) : read_mat_array(path, source.array);
  TextRows rows(path, text, source);
  const std::span<const ColumnType> columns = columns_of(source.to);
  const std::vector<ColumnOrigin> origins = origins_of(rows, source);
  std::vector<std::size_t> pair_columns;
  for (const PairColumn& pair : source.pairs) pair_columns.push_back(rows.index_of(pair.column));
  const std::size_t begin = begin_table(source.to, out);
  std::vector<Cell> cells(columns.size());
  while (rows.next()) {
    for (std::size_t i = 0; i < columns.size(); ++i) {
      cells[i] = origins[i].constant;
      if (!origins[i].index) continue;
      const std::string_view field = rows.field(*origins[i].index);
      const bool is_date = source.units.is_date && columns[i].name == "t_s";
      cells[i] = parse_cell(field, is_date, columns[i].required, rows.place(field));
    }
    if (source.pairs.empty()) {
      add(rows, source, cells, out);
    } else {
      add_pairs(rows, source, pair_columns, cells, out);
    }
  }
  finish_table(path, source, begin, "", out);
}

bool is_of(const std::filesystem::path& input, const Source& source) {
  return source.from.empty() || input == source.from || input.filename() == source.from;
}

// The table that a file with our own column names contains.
Table table_of(const std::filesystem::path& input) {
  for (std::size_t i = 0; i < kTableNames.size(); ++i)
    if (input.stem() == kTableNames[i]) return static_cast<Table>(i);
  const std::string text = io::read_file(input);
  const Source plain;
  const TextRows rows(input, text, plain);
  if (rows.has("range_m")) return Table::kRanges;
  if (rows.has("vx_mps")) return Table::kOdometry;
  if (rows.has("x_m") && rows.has("t_s")) return Table::kGroundTruth;
  throw io::DataError({input, 1, 0},
                      fmt::format("its columns {} are not those of a data set", joined(rows.names())),
                      "describe them in a file, and give it as --map FILE");
}

std::string names_of(std::span<const std::filesystem::path> inputs) {
  std::string names;
  for (const std::filesystem::path& input : inputs)
    names += (names.empty() ? "" : ", ") + input.filename().string();
  return names;
}

// The map's sources of an input, or what its own columns say.
std::vector<Source> sources_of(const std::filesystem::path& input, const ImportMap& map) {
  std::vector<Source> sources;
  for (const Source& source : map.sources)
    if (is_of(input, source)) sources.push_back(source);
  if (!map.sources.empty() && sources.empty())
    throw io::DataError({input}, "no source of the map is of this file", "add one with its name as file");
  if (sources.empty()) sources.emplace_back().to = table_of(input);
  return sources;
}

void expect_inputs(std::span<const std::filesystem::path> inputs, const ImportMap& map) {
  for (const Source& source : map.sources) {
    if (std::none_of(inputs.begin(), inputs.end(), [&](const auto& input) { return is_of(input, source); }))
      throw io::ConfigError(source.place, fmt::format("no input is {}", source.from),
                            fmt::format("the inputs are {}", names_of(inputs)));
  }
}

// A trajectory's source: poses to the table, in the units, of the map.
Source trajectory_source(const std::filesystem::path& input, const ImportMap& map) {
  Source source;
  source.to = Table::kGroundTruth;
  for (const Source& given : map.sources) {
    if (!is_of(input, given)) continue;
    source = given;
    const bool is_pose = given.to == Table::kGroundTruth || given.to == Table::kPosePrior;
    if (!is_pose)
      throw io::ConfigError(given.place, "a trajectory has poses alone",
                            "write to: groundtruth or to: pose_prior");
  }
  source.header = Source::Header::kNone;
  source.separator = ' ';
  return source;
}

// Poses as 3x4 matrices, row by row.
std::vector<Eigen::Matrix<double, 3, 4>> read_matrices(const std::filesystem::path& path,
                                                       const std::string& text, const Source& source) {
  std::vector<Eigen::Matrix<double, 3, 4>> out;
  TextRows rows(path, text, source);
  while (rows.next()) {
    Eigen::Matrix<double, 3, 4>& matrix = out.emplace_back();
    for (std::size_t i = 0; i < 12; ++i) {
      const std::string_view field = rows.field(i);
      matrix(static_cast<Eigen::Index>(i / 4), static_cast<Eigen::Index>(i % 4)) =
          io::parse_number(field, rows.place(field));
    }
    const Eigen::Matrix3d rotation = matrix.leftCols<3>();
    constexpr double kTolerance = 0.01;
    if (!(rotation * rotation.transpose()).isIdentity(kTolerance) || rotation.determinant() < 0.0)
      throw io::DataError(rows.place(), "the first three columns of the pose's matrix are no rotation",
                          "a row has the twelve numbers of a 3x4 matrix, row by row");
  }
  return out;
}

// Whether the robot moves along z of its frame, as a camera does, and not along x.
bool moves_along_z(std::span<const Eigen::Matrix<double, 3, 4>> poses) {
  Eigen::Vector3d moved_m = Eigen::Vector3d::Zero();
  for (std::size_t i = 1; i < poses.size(); ++i)
    moved_m += (poses[i].leftCols<3>().transpose() * (poses[i].col(3) - poses[i - 1].col(3))).cwiseAbs();
  return moved_m.z() > moved_m.x();
}

std::vector<double> read_times(const std::filesystem::path& path, const Units& units) {
  const std::string text = io::read_file(path);
  Source source;
  source.header = Source::Header::kNone;
  source.separator = ' ';
  TextRows rows(path, text, source);
  std::vector<double> times_s;
  while (rows.next())
    times_s.push_back(io::parse_number(rows.field(0), rows.place(rows.field(0))) * units.time_s);
  return times_s;
}

}  // namespace

void import_text(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out) {
  expect_inputs(inputs, map);
  for (const std::filesystem::path& input : inputs)
    for (const Source& source : sources_of(input, map)) import_table(input, source, out);
}

void import_tum(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out) {
  expect_inputs(inputs, map);
  constexpr std::array<std::string_view, 8> kColumns{"t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"};
  for (const std::filesystem::path& input : inputs) {
    Source source = trajectory_source(input, map);
    source.columns.clear();
    for (std::size_t i = 0; i < kColumns.size(); ++i)
      source.columns.emplace(kColumns[i], SourceColumn{.name = {}, .number = i + 1, .constant = {}});
    import_table(input, source, out);
  }
}

void import_kitti(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out) {
  if (inputs.size() != 2)
    throw io::DataError({inputs.front()}, "a KITTI trajectory is two files",
                        "give the file of poses, then the file of times");
  const std::filesystem::path& path = inputs.front();
  const Source source = trajectory_source(path, map);
  const std::string text = io::read_file(path);
  const std::vector<Eigen::Matrix<double, 3, 4>> matrices = read_matrices(path, text, source);
  const std::vector<double> times_s = read_times(inputs[1], source.units);
  if (times_s.size() != matrices.size())
    throw io::DataError({inputs[1]},
                        fmt::format("has {} times for {} poses", times_s.size(), matrices.size()),
                        "give the times of the same trajectory");
  const bool is_camera =
      map.axes == Axes::kCamera || (map.axes == Axes::kDetected && moves_along_z(matrices));
  Eigen::Matrix3d to_robot = Eigen::Matrix3d::Identity();  // of the frame and of the map
  if (is_camera) to_robot << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  const std::size_t begin = begin_table(source.to, out);
  Units units = source.units;
  units.time_s = 1.0;  // read_times() has converted them
  for (std::size_t i = 0; i < matrices.size(); ++i) {
    const Eigen::Vector3d position = to_robot * matrices[i].col(3);
    const Eigen::Quaterniond rotation(
        Eigen::Matrix3d(to_robot * matrices[i].leftCols<3>() * to_robot.transpose()));
    std::vector<Cell> cells(columns_of(source.to).size());
    const std::array<double, 8> values{times_s[i],   position.x(), position.y(), position.z(),
                                       rotation.x(), rotation.y(), rotation.z(), rotation.w()};
    constexpr std::array<std::size_t, 8> kColumns{0, 1, 2, 3, 7, 8, 9, 10};
    for (std::size_t k = 0; k < values.size(); ++k) cells[kColumns[k]] = cell(values[k]);
    static_cast<void>(add_row(source.to, cells, units, out.dataset));
  }
  finish_table(path, source, begin,
               is_camera ? "axes of a camera: z forward, x right" : "axes of a robot: x forward, z up", out);
}

}  // namespace groma::importer
