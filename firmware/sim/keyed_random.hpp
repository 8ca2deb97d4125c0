// Random numbers that do not depend on the order of the draws: each is a hash of the seed and of its keys.
// Two simulations that draw in different orders, or draw more, get the same values for the same keys.
#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>

namespace groma::sim {

// The draws of one seed. The keys identify a draw: a purpose, then ids and counters.
class KeyedRandom {
 public:
  explicit constexpr KeyedRandom(std::uint64_t seed) noexcept : state_(mix(seed ^ 0x6A09E667F3BCC908ULL)) {}

  // The draws of one purpose, or of one id within it.
  [[nodiscard]] constexpr KeyedRandom of(std::uint64_t key) const noexcept {
    KeyedRandom child = *this;
    child.state_ = mix(state_ + 0x9E3779B97F4A7C15ULL * (key + 1));
    return child;
  }

  template <typename... Keys>
  [[nodiscard]] constexpr KeyedRandom of(std::uint64_t first, Keys... rest) const noexcept {
    return of(first).of(static_cast<std::uint64_t>(rest)...);
  }

  [[nodiscard]] constexpr std::uint64_t bits() const noexcept { return mix(state_ ^ 0xBB67AE8584CAA73BULL); }

  // Uniform in (0, 1), 53 bits.
  [[nodiscard]] constexpr double uniform() const noexcept {
    return (static_cast<double>(bits() >> 11) + 0.5) * 0x1.0p-53;
  }
  [[nodiscard]] constexpr double uniform(double low, double high) const noexcept {
    return low + (high - low) * uniform();
  }

  // Mean 0, standard deviation 1 (Box-Muller).
  [[nodiscard]] double normal() const noexcept {
    const double radius = std::sqrt(-2.0 * std::log(of(0x52).uniform()));
    return radius * std::cos(2.0 * std::numbers::pi * of(0x41).uniform());
  }
  [[nodiscard]] double normal(double mean, double sigma) const noexcept { return mean + sigma * normal(); }

 private:
  // The finalizer of SplitMix64 (Steele, Lea and Flood, 2014).
  static constexpr std::uint64_t mix(std::uint64_t x) noexcept {
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9ULL;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBULL;
    return x ^ (x >> 31);
  }

  std::uint64_t state_;
};

}  // namespace groma::sim
