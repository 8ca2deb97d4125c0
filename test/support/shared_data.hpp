// Locates the recorded and simulated runs that are not part of the project: in GROMA_SHARED, or in a folder
// `shared` beside the repository. Tests skip if it is absent.
#pragma once

#include <cstdlib>
#include <filesystem>
#include <optional>
#include <string>

namespace groma::test {

// A path under shared/data, such as "real/plaza1"; none if it is absent.
inline std::optional<std::filesystem::path> shared_data(const std::string& name) {
  const char* const given = std::getenv("GROMA_SHARED");
  const std::filesystem::path shared = given != nullptr
                                           ? std::filesystem::path(given)
                                           : std::filesystem::path(GROMA_SOURCE_DIR) / ".." / "shared";
  const std::filesystem::path path = shared / "data" / name;
  std::error_code error;
  return std::filesystem::exists(path, error) ? std::optional(path) : std::nullopt;
}

}  // namespace groma::test

// Skips the test if the run is absent; otherwise `variable` is its path.
// A declared name cannot be in parentheses. NOLINTBEGIN(bugprone-macro-parentheses)
#define GROMA_SHARED_OR_SKIP(variable, name)                                               \
  const auto variable##_found = ::groma::test::shared_data(name);                          \
  if (!variable##_found) GTEST_SKIP() << "no data " << (name) << " beside the repository"; \
  const std::filesystem::path& variable = *variable##_found
// NOLINTEND(bugprone-macro-parentheses)
