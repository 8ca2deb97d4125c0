#include "host/diagnosis/finding.hpp"

#include <fmt/format.h>

#include <nlohmann/json.hpp>

namespace groma::diagnosis {

Finding map_mismatch(std::optional<double> share) {
  return {.cause = "map-mismatch",
          .evidence = share ? fmt::format("{:.0f} % of the ranges contradict the calibration, at any pose",
                                          100.0 * *share)
                            : "no pose on this calibration explains half of the ranges",
          .remedy =
              "load the calibration of this site; if anchors were moved or renumbered since, drive and "
              "calibrate again (groma calibrate --update)"};
}

Finding lever_arms_in(const Unit& unit, std::string_view evidence) {
  return {.cause = "length-unit",
          .evidence = fmt::format("{}: the lever arms seem to be in {}", evidence, unit.name),
          .remedy = "give the positions of tags.csv in metres",
          .value = {unit.factor}};
}

nlohmann::ordered_json to_json(std::span<const Finding> findings) {
  auto out = nlohmann::ordered_json::array();
  for (const Finding& finding : findings) {
    nlohmann::ordered_json& json = out.emplace_back(nlohmann::ordered_json{
        {"cause", finding.cause}, {"evidence", finding.evidence}, {"remedy", finding.remedy}});
    const auto add = [&](const char* key, const std::vector<double>& numbers) {
      if (numbers.size() == 1) json[key] = numbers.front();
      if (numbers.size() > 1) json[key] = numbers;
    };
    add("value", finding.value);
    add("sigma", finding.sigma);
    if (!finding.of.empty()) json["of"] = finding.of;
  }
  return out;
}

}  // namespace groma::diagnosis
