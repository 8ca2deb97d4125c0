#include "host/reproduce/summary.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

#include "host/reproduce/paper.hpp"
#include "host/reproduce/tables.hpp"

namespace groma::reproduce {

namespace {

using Pointer = Json::json_pointer;

Json to_json(const Band& band, double paper = kNotGiven) {
  const auto value = [](double number) { return std::isfinite(number) ? Json(number) : Json(nullptr); };
  return {{"median", value(band.median)},
          {"low", value(band.low)},
          {"high", value(band.high)},
          {"seeds", band.count},
          {"paper", value(paper)}};
}

// Of poses, where a result has their score.
Json poses_at(const Seeds& seeds, const Pointer& score) {
  return {{"ate_m_mean", to_json(band_at(seeds, score / "ate_m" / "mean"))},
          {"ate_m_max", to_json(band_at(seeds, score / "ate_m" / "max"))},
          {"nees_mean", to_json(band_at(seeds, score / "nees" / "mean"))}};
}

Json table(const TableSpec& table, const Seeds& seeds) {
  Json out = Json::object();
  for (const TableRow& row : table.rows) {
    Json& of = out[row.group.empty() ? row.key : fmt::format("{}: {}", row.group, row.key)];
    for (const Column& column : columns()) {
      const std::string metric = fmt::format("{}_{}", column.figure, column.statistic);
      for (const auto& [name, who] :
           {std::pair{"ours", Who::kOurs}, std::pair{"published", Who::kPublished}}) {
        const Pointer at = run_of(row, who) / "score" / column.figure / column.statistic;
        of[name][metric] = to_json(band_at(seeds, at), paper_value(row, column));
      }
    }
  }
  return out;
}

Json sensitivity(const std::map<std::string, Seeds>& parts) {
  Json out = Json::object();
  for (const Factor& factor : factors()) {
    const auto part = parts.find(factor.name);
    if (part == parts.end()) continue;
    const LevelBands usual = bands_of(part->second, factor.usual);
    for (std::size_t i = 0; i < factor.levels.size(); ++i) {
      const LevelBands level = bands_of(part->second, i);
      Json& of = out[fmt::format("{}: {}", factor.name, factor.levels[i].label)];
      of["is_broken"] = is_broken(level, usual);
      of["ours"] = {{"ate_m_mean", to_json(level.ate_m)},
                    {"nees_mean", to_json(level.nees)},
                    {"anchor_error_m", to_json(level.anchors_m)}};
    }
  }
  return out;
}

Json baselines(const Seeds& seeds) {
  Json out = Json::object();
  for (const auto& [method, run] : seeds.begin()->second.items()) {
    const bool is_ours = method == "schmidt" || method == "joint";
    const Pointer at = Pointer() / method;
    Json& of = out[method][is_ours ? "ours" : "published"];
    of = poses_at(seeds, at / "score");
    of["us_per_range"] = to_json(band_at(seeds, at / "us_per_range"));
  }
  return out;
}

// Of one call; the paper's are upper bounds.
Json effort(const Seeds& table2) {
  Json out = Json::object();
  for (const char* key : {"original", "adapted", "anchor-states", "joint"}) {
    const Pointer at = Pointer() / key / "ours";
    out[key]["ours"] = {{"propagate_ns", to_json(band_at(table2, at / "propagate_ns"), 1e3 * kPropagate_us)},
                        {"update_ns", to_json(band_at(table2, at / "update_ns"), 1e3 * kUpdate_us)}};
  }
  return out;
}

Json recorded(const std::map<std::string, Seeds>& parts) {
  Json out = Json::object();
  for (const auto& [run, seeds] : parts) {
    for (const auto& [filter, both] : seeds.begin()->second.items()) {
      for (const auto& [who, scored] : both.items()) {
        out[fmt::format("{}: {}", run, filter)][who] = poses_at(seeds, Pointer() / filter / who / "score");
      }
    }
  }
  return out;
}

}  // namespace

Band band(std::vector<double> values) {
  std::erase_if(values, [](double value) { return !std::isfinite(value); });
  if (values.empty()) return {kNotGiven, kNotGiven, kNotGiven, 0};
  std::sort(values.begin(), values.end());
  // Between the values, so that a few seeds have a band too.
  const auto quantile = [&](double share) {
    const double place = share * static_cast<double>(values.size() - 1);
    const auto below = static_cast<std::size_t>(place);
    const std::size_t above = std::min(below + 1, values.size() - 1);
    return values[below] + (place - static_cast<double>(below)) * (values[above] - values[below]);
  };
  return {quantile(0.05), quantile(0.5), quantile(0.95), values.size()};
}

Band band_at(const Seeds& seeds, const Json::json_pointer& at) {
  std::vector<double> values;
  for (const auto& [seed, result] : seeds) {
    if (result.contains(at) && result.at(at).is_number()) values.push_back(result.at(at).get<double>());
  }
  return band(std::move(values));
}

LevelBands bands_of(const Seeds& seeds, std::size_t level) {
  const Pointer at = Pointer() / level;
  return {band_at(seeds, at / "score" / "ate_m" / "mean"), band_at(seeds, at / "score" / "nees" / "mean"),
          band_at(seeds, at / "anchor_error_m")};
}

bool is_broken(const LevelBands& level, const LevelBands& usual) {
  return level.ate_m.median > 2.0 * usual.ate_m.median + 0.05 || level.nees.median > 4.0;
}

Json summary_of(const Outcome& outcome) {
  Json out = Json::object();
  const auto with = [&](const std::string& experiment, const auto& summarize) {
    const auto found = outcome.results.find(experiment);
    if (found != outcome.results.end() && !found->second.empty()) out[experiment] = summarize(found->second);
  };
  using Parts = std::map<std::string, Seeds>;
  with("table1", [](const Parts& parts) {
    return Json{
        {"mean",
         {{"ours",
           {{"error_m", to_json(band_at(parts.begin()->second, Pointer() / "mean_m"), kTable1Mean_m)}}}}}};
  });
  for (const TableSpec& spec : tables())
    with(spec.experiment, [&](const Parts& parts) { return table(spec, parts.begin()->second); });
  if (const auto found = outcome.results.find("table2"); found != outcome.results.end())
    out["effort"] = effort(found->second.begin()->second);
  with("baselines", [](const Parts& parts) { return baselines(parts.begin()->second); });
  with("sensitivity", sensitivity);
  with("recorded", recorded);
  return out;
}

}  // namespace groma::reproduce
