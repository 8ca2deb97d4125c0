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

Json to_json(const Band& band, double paper = kNotGiven) {
  const auto value = [](double number) { return std::isfinite(number) ? Json(number) : Json(nullptr); };
  return {{"median", value(band.median)},
          {"low", value(band.low)},
          {"high", value(band.high)},
          {"seeds", band.count},
          {"paper", value(paper)}};
}

// The member of a result at a path of names; null if one is missing.
const Json* at(const Json& result, std::initializer_list<std::string_view> names) {
  const Json* found = &result;
  for (const std::string_view name : names) {
    if (!found->is_object() || !found->contains(name)) return nullptr;
    found = &found->at(std::string(name));
  }
  return found;
}

// Over the seeds.
Band band_at(const Seeds& seeds, std::initializer_list<std::string_view> names) {
  std::vector<double> values;
  for (const auto& [seed, result] : seeds) {
    if (const Json* value = at(result, names); value != nullptr && value->is_number())
      values.push_back(value->get<double>());
  }
  return band(std::move(values));
}

Json table(const TableSpec& table, const Seeds& seeds) {
  Json out = Json::object();
  for (const TableRow& row : table.rows) {
    Json& of = out[row.group.empty() ? row.key : fmt::format("{}: {}", row.group, row.key)];
    for (const Column& column : columns()) {
      const std::string metric = fmt::format("{}_{}", column.figure, column.statistic);
      for (const auto& [name, who] :
           {std::pair{"ours", Who::kOurs}, std::pair{"published", Who::kPublished}}) {
        of[name][metric] = to_json(band(values_of(seeds, row, who, column.figure, column.statistic)),
                                   paper_value(row, column));
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
    out[method][is_ours ? "ours" : "published"] = {
        {"ate_m_mean", to_json(band_at(seeds, {method, "score", "ate_m", "mean"}))},
        {"ate_m_max", to_json(band_at(seeds, {method, "score", "ate_m", "max"}))},
        {"nees_mean", to_json(band_at(seeds, {method, "score", "nees", "mean"}))},
        {"us_per_range", to_json(band_at(seeds, {method, "us_per_range"}))}};
  }
  return out;
}

// Of one call; the paper's are upper bounds.
Json effort(const Seeds& table2) {
  Json out = Json::object();
  for (const char* key : {"original", "adapted", "anchor-states", "joint"}) {
    out[key]["ours"] = {
        {"propagate_ns", to_json(band_at(table2, {key, "ours", "propagate_ns"}), 1e3 * kPropagate_us)},
        {"update_ns", to_json(band_at(table2, {key, "ours", "update_ns"}), 1e3 * kUpdate_us)}};
  }
  return out;
}

Json recorded(const std::map<std::string, Seeds>& parts) {
  Json out = Json::object();
  for (const auto& [run, seeds] : parts) {
    for (const auto& [filter, both] : seeds.begin()->second.items()) {
      for (const auto& [who, scored] : both.items()) {
        out[fmt::format("{}: {}", run, filter)][who] = {
            {"ate_m_mean", to_json(band_at(seeds, {filter, who, "score", "ate_m", "mean"}))},
            {"ate_m_max", to_json(band_at(seeds, {filter, who, "score", "ate_m", "max"}))},
            {"nees_mean", to_json(band_at(seeds, {filter, who, "score", "nees", "mean"}))}};
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

LevelBands bands_of(const Seeds& seeds, std::size_t level) {
  std::vector<double> ate_m;
  std::vector<double> nees;
  std::vector<double> anchors_m;
  const auto add = [](std::vector<double>& to, const Json& value) {
    if (value.is_number()) to.push_back(value.get<double>());
  };
  for (const auto& [seed, result] : seeds) {
    const Json& at = result.at(level);
    add(anchors_m, at.at("anchor_error_m"));
    if (!at.at("score").is_object()) continue;
    add(ate_m, at.at("score").at("ate_m").at("mean"));
    if (at.at("score").at("nees").is_object()) add(nees, at.at("score").at("nees").at("mean"));
  }
  return {band(ate_m), band(nees), band(anchors_m)};
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
         {{"ours", {{"error_m", to_json(band_at(parts.begin()->second, {"mean_m"}), kTable1Mean_m)}}}}}};
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
