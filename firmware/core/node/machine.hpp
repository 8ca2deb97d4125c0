// The tag or the anchor that a node runs while it is on the air, according to its role; neither before and
// after.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/anchor.hpp"
#include "firmware/core/mac/tag.hpp"

namespace groma::node {

class Machine {
 public:
  // All arguments must outlive the machine.
  void become_tag(const mac::Site& site, groma_Counters& counters) noexcept {
    anchor_.reset();
    tag_.emplace(site, counters);
  }
  void become_anchor(const mac::Site& site, groma_Counters& counters) noexcept {
    tag_.reset();
    anchor_.emplace(site, counters);
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

  // Passes an event to the machine and returns its Step; an empty Step if there is no machine.
  template <class F>
  mac::Step dispatch(F&& f) noexcept {
    if (tag_) return f(*tag_);
    if (anchor_) return f(*anchor_);
    return {};
  }
  [[nodiscard]] std::optional<mac::Action> next_rx_window() const noexcept {
    if (tag_) return tag_->next_rx_window();
    if (anchor_) return anchor_->next_rx_window();
    return std::nullopt;
  }
  // The calls besides events, see step.hpp.
  void begin_verify(std::span<const std::uint8_t> frame) noexcept {
    if (tag_) tag_->begin_verify(frame);
    if (anchor_) anchor_->begin_verify(frame);
  }
  void finish_signing() noexcept {
    if (tag_) tag_->finish_signing();
    if (anchor_) anchor_->finish_signing();
  }
  [[nodiscard]] std::size_t precompute() noexcept {
    if (tag_) return tag_->precompute();
    if (anchor_) return anchor_->precompute();
    return 0;
  }
  void attach(mac::ControlChannel& channel) noexcept {
    if (tag_) tag_->attach(channel);
    if (anchor_) anchor_->attach(channel);
  }
  void set_health(const mac::Health& health) noexcept {
    if (tag_) tag_->set_health(health);
    if (anchor_) anchor_->set_health(health);
  }

  // The clock has continued over a restart, with an error of some us.
  void on_clock_restart() noexcept {
    if (tag_) tag_->on_clock_restart();
    if (anchor_) anchor_->on_clock_restart();
  }

  [[nodiscard]] const mac::Station* station() const noexcept {
    if (tag_) return &tag_->station();
    if (anchor_) return &anchor_->station();
    return nullptr;
  }
  // On the air and synchronized with its network.
  [[nodiscard]] bool in_step() const noexcept {
    const mac::Station* member = station();
    return member != nullptr && member->sync().state() != mac::SyncState::kSearching;
  }
  // The superframe in progress; 0 if there is no machine.
  [[nodiscard]] std::uint32_t superframe() const noexcept {
    if (tag_) return tag_->superframe_number();
    if (anchor_) return anchor_->superframe_number();
    return 0;
  }

 private:
  std::optional<mac::Tag> tag_;
  std::optional<mac::Anchor> anchor_;
};

}  // namespace groma::node
