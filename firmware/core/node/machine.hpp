// The tag or the anchor that a node runs while it is on the air, according to its role; neither before and
// after.
#pragma once

#include <cstdint>
#include <optional>
#include <type_traits>

#include "firmware/core/mac/anchor.hpp"
#include "firmware/core/mac/tag.hpp"

namespace groma::node {

class Machine {
 public:
  // Starts a mac::Tag or a mac::Anchor in place of the present machine. `counters`, and what `site` points
  // to, outlive it.
  template <class Role>
  void become(const mac::Site& site, groma_Counters& counters) noexcept {
    forget();
    if constexpr (std::is_same_v<Role, mac::Tag>) {
      tag_.emplace(site, counters);
    } else {
      anchor_.emplace(site, counters);
    }
  }
  void forget() noexcept {
    tag_.reset();
    anchor_.reset();
  }

  // Null if it is not one.
  [[nodiscard]] mac::Tag* tag() noexcept { return tag_ ? &*tag_ : nullptr; }
  [[nodiscard]] const mac::Tag* tag() const noexcept { return tag_ ? &*tag_ : nullptr; }
  [[nodiscard]] mac::Anchor* anchor() noexcept { return anchor_ ? &*anchor_ : nullptr; }
  [[nodiscard]] const mac::Anchor* anchor() const noexcept { return anchor_ ? &*anchor_ : nullptr; }

  // Returns f(tag) or f(anchor); if there is neither, an empty result: for an event an empty Step.
  template <class F>
  std::invoke_result_t<F, mac::Tag&> call(F&& f) noexcept {
    if (mac::Tag* it = tag()) return f(*it);
    if (mac::Anchor* it = anchor()) return f(*it);
    return std::invoke_result_t<F, mac::Tag&>();
  }

  // Null if there is no machine.
  [[nodiscard]] const mac::Station* station() const noexcept {
    if (const mac::Tag* it = tag()) return it;
    return anchor();
  }
  // On the air and synchronized with its network.
  [[nodiscard]] bool in_step() const noexcept {
    const mac::Station* member = station();
    return member != nullptr && member->sync().state() != mac::SyncState::kSearching;
  }
  // The superframe in progress; 0 if there is no machine.
  [[nodiscard]] std::uint32_t superframe() const noexcept {
    const mac::Station* member = station();
    return member == nullptr ? 0 : member->superframe_number();
  }

 private:
  // At most one. A std::variant would save some kilobytes, but its emplace() may throw as far as clang-tidy
  // sees.
  std::optional<mac::Tag> tag_;
  std::optional<mac::Anchor> anchor_;
};

}  // namespace groma::node
