// What groma doctor examined, with its verdict.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <nlohmann/json_fwd.hpp>

namespace groma::doctor {

enum class Verdict : std::uint8_t { kGood, kWarning, kBad };
// "good", "warning", "bad".
[[nodiscard]] std::string_view word(Verdict verdict) noexcept;

struct Check {
  std::string kind;  // such as "link"
  std::string name;  // such as its path
  std::vector<std::string> facts{};
  Verdict verdict = Verdict::kGood;
  std::string fault{};   // one word of docs/reference/commands.md; empty if good
  std::string remedy{};  // what to do; empty if good

  // Unless the verdict is as bad already.
  void fail(Verdict to, std::string_view with_fault, std::string_view with_remedy);
};

// The exit code: by the first bad check, else whether there is a warning.
[[nodiscard]] int exit_code(std::span<const Check> checks) noexcept;
[[nodiscard]] Verdict worst(std::span<const Check> checks) noexcept;
// {"verdict", "checks": [{"kind", "name", "verdict", "fault", "facts", "remedy"}]}
[[nodiscard]] nlohmann::ordered_json to_json(std::span<const Check> checks);
// For people: a paragraph for each check.
[[nodiscard]] std::string as_text(std::span<const Check> checks);

}  // namespace groma::doctor
