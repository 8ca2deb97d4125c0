#include "host/io/estimate_file.hpp"

#include <fmt/format.h>

#include <cstddef>
#include <future>
#include <iterator>
#include <string_view>

#include "host/io/csv.hpp"
#include "host/io/input_file.hpp"

namespace groma::io {

namespace {

constexpr std::string_view kPlanarColumns = "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt";
constexpr std::string_view kSpatialColumns = "z_m,roll_rad,pitch_rad,p_zz,p_zr,p_zp,p_rr,p_rp,p_pp";

void add_planar(std::string& text, const model::PlanarEstimate& row) {
  const Eigen::Matrix3d& p = row.covariance;
  fmt::format_to(std::back_inserter(text), "{},{},{},{},{},{},{},{},{},{}", row.t_s, row.x_m, row.y_m,
                 row.yaw_rad, p(0, 0), p(0, 1), p(0, 2), p(1, 1), p(1, 2), p(2, 2));
}

}  // namespace

std::string format_estimate(std::span<const model::PlanarEstimate> rows) {
  std::string text(kPlanarColumns);
  text += '\n';
  for (const model::PlanarEstimate& row : rows) {
    add_planar(text, row);
    text += '\n';
  }
  return text;
}

std::string format_estimate(std::span<const model::PlanarEstimate> rows,
                            std::span<const model::SpatialEstimate> spatial, const model::Surface& surface,
                            std::span<const RowWords> words) {
  const bool floors = surface.chart_count() > 1;
  // Pages of memory that are touched once cost as much as the digits in them.
  constexpr std::size_t kTypicalRow = 340;
  const auto add = [&](std::string& text, std::size_t first, std::size_t end) {
    for (std::size_t i = first; i < end; ++i) {
      add_planar(text, rows[i]);
      const model::SpatialEstimate& at = spatial[i];
      const auto p = at.covariance.block<3, 3>(2, 2);
      fmt::format_to(std::back_inserter(text), ",{},{},{},{},{},{},{},{},{},{},{}", words[i].state,
                     words[i].reason, at.z_m, at.roll_rad, at.pitch_rad, p(0, 0), p(0, 1), p(0, 2), p(1, 1),
                     p(1, 2), p(2, 2));
      if (floors) {
        fmt::format_to(std::back_inserter(text), ",{}",
                       surface.charts()[static_cast<std::size_t>(at.chart)].name);
      }
      text += '\n';
    }
  };
  const std::size_t half = rows.size() / 2;
  auto second = std::async(std::launch::async, [&] {
    std::string text;
    text.reserve(kTypicalRow * (rows.size() - half));
    add(text, half, rows.size());
    return text;
  });
  std::string text =
      fmt::format("{},state,reason,{}{}\n", kPlanarColumns, kSpatialColumns, floors ? ",floor" : "");
  text.reserve(text.size() + kTypicalRow * rows.size());
  add(text, 0, half);
  text += second.get();
  return text;
}

std::vector<model::PlanarEstimate> read_estimate(const std::filesystem::path& path) {
  const std::string text = read_file(path);
  CsvReader csv(
      path, text,
      {{"t_s"}, {"x_m"}, {"y_m"}, {"yaw_rad"}, {"p_xx"}, {"p_xy"}, {"p_xt"}, {"p_yy"}, {"p_yt"}, {"p_tt"}});
  std::vector<model::PlanarEstimate> rows;
  while (csv.next()) {
    model::PlanarEstimate row{csv.number(0), csv.number(1), csv.number(2), csv.number(3)};
    if (!rows.empty() && !(row.t_s > rows.back().t_s)) {
      throw DataError(csv.place(0), "the times do not increase", "sort the rows by t_s, each time once");
    }
    row.covariance << csv.number(4), csv.number(5), csv.number(6),  //
        csv.number(5), csv.number(7), csv.number(8),                //
        csv.number(6), csv.number(8), csv.number(9);
    rows.push_back(row);
  }
  if (rows.empty())
    throw DataError({path}, "there are no rows", "give an estimate that groma replay has written");
  return rows;
}

std::vector<StateRow> read_states(const std::filesystem::path& path) {
  const std::string text = read_file(path);
  constexpr auto kOptional = CsvReader::Presence::kOptional;
  CsvReader csv(path, text, {{"t_s"}, {"state", kOptional}, {"reason", kOptional}});
  std::vector<StateRow> rows;
  while (csv.next()) {
    if (csv.has(1)) rows.push_back({csv.number(0), std::string(csv.text(1)), std::string(csv.text(2))});
  }
  return rows;
}

}  // namespace groma::io
