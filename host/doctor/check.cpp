#include "host/doctor/check.hpp"

#include <fmt/format.h>

#include <algorithm>

#include <nlohmann/json.hpp>

#include "host/io/exit_code.hpp"

namespace groma::doctor {
namespace {

using OrderedJson = nlohmann::ordered_json;

int code_of(std::string_view fault) noexcept {
  if (fault == "no-permission") return io::kNoPermission;
  if (fault == "bad-configuration" || fault == "bad-calibration") return io::kBadConfiguration;
  if (fault == "no-calibration" || fault == "map-mismatch") return io::kBadData;
  return io::kUnavailable;
}

OrderedJson null_if_empty(const std::string& text) {
  return text.empty() ? OrderedJson(nullptr) : OrderedJson(text);
}

}  // namespace

std::string_view word(Verdict verdict) noexcept {
  switch (verdict) {
    case Verdict::kGood:
      return "good";
    case Verdict::kWarning:
      return "warning";
    case Verdict::kBad:
      return "bad";
  }
  return "";
}

void Check::fail(Verdict to, std::string_view with_fault, std::string_view with_remedy) {
  if (to <= verdict) return;
  verdict = to;
  fault = with_fault;
  remedy = with_remedy;
}

int exit_code(std::span<const Check> checks) noexcept {
  for (const Check& check : checks) {
    if (check.verdict == Verdict::kBad) return code_of(check.fault);
  }
  return worst(checks) == Verdict::kWarning ? io::kDoneWithWarnings : io::kGood;
}

Verdict worst(std::span<const Check> checks) noexcept {
  Verdict verdict = Verdict::kGood;
  for (const Check& check : checks) verdict = std::max(verdict, check.verdict);
  return verdict;
}

OrderedJson to_json(std::span<const Check> checks) {
  OrderedJson list = OrderedJson::array();
  for (const Check& check : checks) {
    list.push_back(OrderedJson{{"kind", check.kind},
                               {"name", check.name},
                               {"verdict", word(check.verdict)},
                               {"fault", null_if_empty(check.fault)},
                               {"facts", check.facts},
                               {"remedy", null_if_empty(check.remedy)}});
  }
  return {{"verdict", word(worst(checks))}, {"checks", std::move(list)}};
}

std::string as_text(std::span<const Check> checks) {
  std::string text;
  for (const Check& check : checks) {
    text += fmt::format("{:<8} {}{}{}\n", word(check.verdict), check.kind, check.name.empty() ? "" : " ",
                        check.name);
    if (!check.fault.empty()) text += fmt::format("         {}\n", check.fault);
    for (const std::string& fact : check.facts) text += fmt::format("           {}\n", fact);
    if (!check.remedy.empty()) text += fmt::format("         -> {}\n", check.remedy);
  }
  return text;
}

}  // namespace groma::doctor
