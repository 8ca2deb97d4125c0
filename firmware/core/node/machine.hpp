// The tag or the anchor that a node runs while it is on the air; neither before and after.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <type_traits>

#include "firmware/core/mac/anchor.hpp"
#include "firmware/core/mac/tag.hpp"

namespace groma::node {

class Machine {
 public:
  // Starts a tag, or an anchor, in place of the present machine. `counters`, and what `site` points to,
  // outlive it.
  mac::Station& become(bool tag, const mac::Site& site, groma_Counters& counters) noexcept {
    forget();
    if (tag) {
      station_ = &tag_.emplace(site, counters);
    } else {
      station_ = &anchor_.emplace(site, counters);
    }
    return *station_;
  }
  void forget() noexcept {
    station_ = nullptr;
    tag_.reset();
    anchor_.reset();
  }

  // Null if it is not one.
  [[nodiscard]] mac::Tag* tag() noexcept { return tag_ ? &*tag_ : nullptr; }
  [[nodiscard]] mac::Anchor* anchor() noexcept { return anchor_ ? &*anchor_ : nullptr; }
  // Null if there is no machine.
  [[nodiscard]] mac::Station* station() const noexcept { return station_; }

  // Passes on an event (mac/step.hpp), such as &mac::Station::on_late. Returns an empty step if there is no
  // machine.
  template <class... Args>
  mac::Step on(mac::Step (mac::Station::*event)(Args...) noexcept,
               std::type_identity_t<Args>... args) noexcept {
    return station_ != nullptr ? (station_->*event)(args...) : mac::Step();
  }
  // As of the machine; 0 and nothing without one.
  std::size_t precompute() noexcept {
    if (tag_) return tag_->precompute();
    return anchor_ ? anchor_->precompute() : 0;
  }
  [[nodiscard]] std::optional<mac::Action> next_rx_window() const noexcept {
    if (tag_) return tag_->next_rx_window();
    return anchor_ ? anchor_->next_rx_window() : std::nullopt;
  }

  // On the air and synchronized with its network.
  [[nodiscard]] bool in_step() const noexcept {
    return station_ != nullptr && station_->sync().state() != mac::SyncState::kSearching;
  }
  // The superframe in progress; 0 if there is no machine.
  [[nodiscard]] std::uint32_t superframe() const noexcept {
    return station_ != nullptr ? station_->superframe_number() : 0;
  }

 private:
  // At most one. A std::variant would save some kilobytes, but its emplace() may throw as far as clang-tidy
  // sees.
  std::optional<mac::Tag> tag_;
  std::optional<mac::Anchor> anchor_;
  mac::Station* station_ = nullptr;  // the one there is
};

}  // namespace groma::node
