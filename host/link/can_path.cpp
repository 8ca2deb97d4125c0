#include "host/link/can_path.hpp"

#include <net/if.h>

#include <algorithm>
#include <charconv>

namespace groma::link {
namespace {

constexpr std::string_view kClassicScheme = "can:";
constexpr std::string_view kFdScheme = "canfd:";
constexpr std::string_view kLogScheme = "can-log:";

struct Target {
  std::string_view name;
  std::uint16_t node;
};

// NAME/NODE
std::optional<Target> parse_target(std::string_view text) noexcept {
  const std::size_t slash = text.rfind('/');
  if (slash == std::string_view::npos || slash == 0) return std::nullopt;
  const std::string_view digits = text.substr(slash + 1);
  std::uint16_t node = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), node);
  if (digits.empty() || error != std::errc{} || end != digits.data() + digits.size()) return std::nullopt;
  return Target{text.substr(0, slash), node};
}

// Linux: dev_valid_name()
bool is_interface_name(std::string_view name) noexcept {
  return !name.empty() && name.size() < IFNAMSIZ && name != "." && name != ".." &&
         std::none_of(name.begin(), name.end(),
                      [](char c) { return c == '/' || c == ':' || c == ' ' || (c >= '\t' && c <= '\r'); });
}

}  // namespace

bool is_can_path(std::string_view path) noexcept {
  return path.starts_with(kClassicScheme) || path.starts_with(kFdScheme);
}

std::optional<CanPath> parse_can_path(std::string_view path) {
  if (!is_can_path(path)) return std::nullopt;
  const bool fd = path.starts_with(kFdScheme);
  const auto target = parse_target(path.substr((fd ? kFdScheme : kClassicScheme).size()));
  if (!target || !is_interface_name(target->name)) return std::nullopt;
  return CanPath{fd ? wire::CanFormat::kFd : wire::CanFormat::kClassic, std::string(target->name),
                 target->node};
}

bool is_can_log_path(std::string_view path) noexcept {
  return path.starts_with(kLogScheme);
}

std::optional<CanLogPath> parse_can_log_path(std::string_view path) {
  if (!is_can_log_path(path)) return std::nullopt;
  const auto target = parse_target(path.substr(kLogScheme.size()));
  if (!target) return std::nullopt;
  return CanLogPath{std::string(target->name), target->node};
}

}  // namespace groma::link
