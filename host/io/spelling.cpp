#include "host/io/spelling.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstddef>
#include <vector>

namespace groma::io {

namespace {

// Shorter words begin too many others.
constexpr std::size_t kShortestBeginning = 3;

// One change for each three characters.
std::size_t most_changes(std::string_view word) {
  return (word.size() + 2) / 3;
}

// Optimal string alignment distance.
std::size_t changes_between(std::string_view a, std::string_view b) {
  std::vector<std::size_t> before;
  std::vector<std::size_t> above(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) above[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::vector<std::size_t> row(b.size() + 1, i);
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t replaced = above[j - 1] + (a[i - 1] == b[j - 1] ? 0 : 1);
      row[j] = std::min({above[j] + 1, row[j - 1] + 1, replaced});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1])
        row[j] = std::min(row[j], before[j - 2] + 1);
    }
    before = std::move(above);
    above = std::move(row);
  }
  return above.back();
}

}  // namespace

std::optional<std::string_view> closest(std::string_view word, std::span<const std::string_view> candidates) {
  std::optional<std::string_view> best;
  std::size_t fewest = most_changes(word) + 1;
  for (const std::string_view candidate : candidates) {
    const bool is_begun = word.size() >= kShortestBeginning && candidate.starts_with(word);
    const std::size_t changes = is_begun ? 1 : changes_between(word, candidate);
    if (changes >= fewest) continue;
    fewest = changes;
    best = candidate;
  }
  return best;
}

std::string did_you_mean(std::string_view word, std::span<const std::string_view> candidates) {
  const std::optional<std::string_view> found = closest(word, candidates);
  return found ? fmt::format("did you mean '{}'? ", *found) : std::string();
}

}  // namespace groma::io
