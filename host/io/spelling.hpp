// Finds the word that was meant where a name is misspelled.
#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>

namespace groma::io {

// The candidate that `word` most likely misspells; none if no candidate is close. Close is: one that begins
// with the word, or few insertions, deletions, replacements and exchanges of neighbours away.
[[nodiscard]] std::optional<std::string_view> closest(std::string_view word,
                                                      std::span<const std::string_view> candidates);

// "did you mean 'CANDIDATE'? " with the closest candidate; empty if there is none.
[[nodiscard]] std::string did_you_mean(std::string_view word, std::span<const std::string_view> candidates);

}  // namespace groma::io
