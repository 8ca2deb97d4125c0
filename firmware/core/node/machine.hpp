// The tag or the anchor that a node runs while it is on the air, according to its role; neither before and
// after.
#pragma once

#include <cstdint>
#include <type_traits>
#include <variant>

#include "firmware/core/mac/anchor.hpp"
#include "firmware/core/mac/tag.hpp"

namespace groma::node {

class Machine {
 public:
  // Starts a mac::Tag or a mac::Anchor in place of the present machine. `counters`, and what `site` points
  // to, outlive it.
  template <class Role>
  void become(const mac::Site& site, groma_Counters& counters) noexcept {
    machine_.emplace<Role>(site, counters);
  }
  void forget() noexcept { machine_.emplace<std::monostate>(); }

  // Null if it is not one.
  [[nodiscard]] mac::Tag* tag() noexcept { return std::get_if<mac::Tag>(&machine_); }
  [[nodiscard]] const mac::Tag* tag() const noexcept { return std::get_if<mac::Tag>(&machine_); }
  [[nodiscard]] mac::Anchor* anchor() noexcept { return std::get_if<mac::Anchor>(&machine_); }
  [[nodiscard]] const mac::Anchor* anchor() const noexcept { return std::get_if<mac::Anchor>(&machine_); }

  // Returns f(tag) or f(anchor); if there is neither, an empty result: for an event an empty Step.
  template <class F>
  std::invoke_result_t<F, mac::Tag&> call(F&& f) noexcept {
    if (mac::Tag* it = tag()) return f(*it);
    if (mac::Anchor* it = anchor()) return f(*it);
    return std::invoke_result_t<F, mac::Tag&>();
  }

  // Null if there is no machine.
  [[nodiscard]] const mac::Station* station() const noexcept {
    if (const mac::Tag* it = tag()) return &it->station();
    if (const mac::Anchor* it = anchor()) return &it->station();
    return nullptr;
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
  std::variant<std::monostate, mac::Tag, mac::Anchor> machine_;
};

}  // namespace groma::node
