// A node's part in its network: brings the radio up and joins, as a tag or an anchor.
//
// If the radio's interrupt does not come, the node restarts the chip and continues in its place in the
// network: the same time, master and slot. Only if that fails twice in a row it joins again.
//
// An unconfigured node sends nothing. It listens for 20 ms each second, to prove that radio, bus, interrupt
// and loop are alive (platform.hpp, proof_of_life()).
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/node/config.hpp"
#include "firmware/core/node/radio_executor.hpp"
#include "firmware/core/node/reporter.hpp"
#include "groma.pb.h"

namespace groma::node {

template <Platform P>
class Participation {
 public:
  // Keeps the references.
  Participation(Shared<P>& shared, RadioExecutor<P>& radio, Reporter<P>& reports) noexcept
      : shared_(shared), radio_(radio), reports_(reports) {}

  // Brings the radio up, and continues in the network, or joins it.
  void bring_up() noexcept {
    next_listening_us_ = kNever_us;
    radio_.bring_up();
    if (!radio_.is_up()) return reports_.log(groma_LogLevel_LOG_ERROR, describe(radio_.state()));
    if (radio_.driver().woken()) reports_.log(groma_LogLevel_LOG_INFO, "radio: woken from sleep");
    if (const char* text = radio_.driver().warning(); text[0] != '\0')
      reports_.log(groma_LogLevel_LOG_WARNING, text);
    resume();
  }
  // Goes off the air until resume() or bring_up().
  void leave() noexcept {
    radio_.stop();
    next_listening_us_ = kNever_us;
  }
  // Continues after leave(). The radio's clock has continued, so a master's beacons come when the other
  // nodes, which have coasted meanwhile, expect them.
  void resume() noexcept {
    if (!radio_.is_up()) return;
    if (machine_.station() == nullptr) return join();
    radio_.resume();
  }
  // As leave(), and gives up the place in the network: resume() joins it from the beginning.
  void forget() noexcept {
    leave();
    machine_.forget();
    reports_.drop_report();
  }

  // Call while the radio's interrupt line is high. Returns false if there was no event.
  bool on_interrupt(std::uint64_t interrupt_us) noexcept {
    if (!radio_.handle_event(interrupt_us)) return false;
    if (!machine_.in_step() || machine_.superframe() != proven_superframe_) {
      proven_superframe_ = machine_.superframe();
      shared_.platform.proof_of_life();
    }
    return true;
  }
  [[nodiscard]] std::uint64_t next_deadline_us() const noexcept {
    return std::min({radio_.deadline_us(), radio_.launch_us(), next_listening_us_, identify_until_us_});
  }
  // Does what is due.
  void on_timer(std::uint64_t now_us) noexcept {
    if (now_us >= radio_.launch_us()) radio_.launch();
    if (now_us >= radio_.deadline_us()) on_deadline();
    if (now_us >= next_listening_us_) {
      next_listening_us_ = now_us + kUnconfiguredPeriod_us;
      radio_.listen(kUnconfiguredListening);
    }
    if (now_us >= identify_until_us_) identify_until_us_ = kNever_us;
  }

  // On the air and synchronized.
  [[nodiscard]] bool in_step() const noexcept { return machine_.in_step(); }

  void identify(std::uint32_t duration_s) noexcept {
    identify_until_us_ = shared_.platform.now_us() + std::uint64_t{duration_s} * 1'000'000;
  }
  // Call after each event: logs a change of the synchronization, and shows the state.
  void show_state() noexcept {
    const bool member = machine_.station() != nullptr;
    const bool in_step = machine_.in_step();
    if (std::exchange(was_in_step_, in_step) != in_step && member) {
      reports_.log(in_step ? groma_LogLevel_LOG_INFO : groma_LogLevel_LOG_WARNING,
                   in_step ? "in step with the master" : "beacons lost, searching");
    }
    Indicator shown = in_step ? Indicator::kRanging : Indicator::kSearching;
    if (!member) shown = Indicator::kUnconfigured;
    if (!radio_.is_up()) shown = Indicator::kRadioFault;
    if (identify_until_us_ != kNever_us) shown = Indicator::kIdentify;
    if (std::exchange(shown_, shown) != shown) shared_.platform.set_indicator(shown);
  }

 private:
  static constexpr std::uint64_t kUnconfiguredPeriod_us = 1'000'000;
  static constexpr ranging::Ticks kUnconfiguredListening = ranging::Ticks::from_us(20'000);

  void join() noexcept {
    P& platform = shared_.platform;
    const std::optional<groma_Config>& config = shared_.config;
    if (!config) {
      next_listening_us_ = platform.now_us() + kUnconfiguredPeriod_us;
      return;
    }
    const bool surveys = shared_.survey.under_way();
    const mac::Site site{
        .id = static_cast<std::uint16_t>(config->id),
        .lender = shared_.survey.lender(),
        .lent_until_us = surveys ? nullptr : &shared_.lent_until_us,
        .network_id = static_cast<std::uint16_t>(config->network_id),
        .phy = radio_.driver().phy(),
        .schedule = &config->schedule,
        .transmit_antenna_delay = radio_.driver().transmit_antenna_delay(),
        .boot_count = platform.boot_count(),
        .on_trial = shared_.trial_end_us != kNever_us,
        .sessions = &sessions_,
        .network_key = std::span(config->network_key.bytes).first(config->network_key.size),
        .cipher = &platform.cipher(),
        .nonces = &nonces_,
        .signed_places = &signed_places_,
    };
    const bool tag = surveys || config->role == groma_Role_ROLE_TAG;
    machine_.become(tag, site, shared_.counters).attach(shared_.air);
    shared_.air.start(site.id, mac::rank_of(config->schedule, site.id).has_value(), site.boot_count);
    radio_.slack().clear();
    radio_.start();
    proven_superframe_ = machine_.superframe();
  }

  void on_deadline() noexcept {
    if (!radio_.is_up()) {
      bring_up();
      if (radio_.is_up()) reports_.send_hello();
      return;
    }
    // Handle an event whose interrupt was lost like any other.
    if (radio_.deadline_us() != 0 && radio_.handle_event(shared_.platform.now_us())) return;
    if (radio_.restart()) {
      reports_.log(groma_LogLevel_LOG_WARNING, "radio: no answer, started again");
      return resume();
    }
    reports_.drop_report();  // it would read the radio's clock
    reports_.log(groma_LogLevel_LOG_WARNING, "radio: no answer, brought up again");
    bring_up();
  }

  Shared<P>& shared_;
  RadioExecutor<P>& radio_;
  Reporter<P>& reports_;
  Machine& machine_ = radio_.machine();
  bool was_in_step_ = false;
  std::optional<Indicator> shown_;
  std::uint32_t proven_superframe_ = 0;  // at the last proof of life
  std::uint16_t sessions_ = 0;           // started in this boot
  std::uint32_t nonces_ = 0;             // made in this boot
  mac::SignedPlaces signed_places_;
  std::uint64_t next_listening_us_ = kNever_us;  // while unconfigured
  std::uint64_t identify_until_us_ = kNever_us;
};

}  // namespace groma::node
