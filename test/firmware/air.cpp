#include "test/firmware/air.hpp"

#include <algorithm>
#include <utility>

namespace groma::testing {

template <class F>
Step Air::dispatch(Node& n, F&& f) {
  if (auto* tag = std::get_if<mac::Tag>(&n.machine)) return f(*tag);
  return f(std::get<mac::Anchor>(n.machine));
}

std::size_t Air::add(const NodeSettings& settings, const groma_Schedule& schedule) {
  auto node = std::make_unique<Node>();
  node->settings = settings;
  node->schedule = schedule;
  build(*node);
  nodes_.push_back(std::move(node));
  return nodes_.size() - 1;
}

void Air::add_all(double spread_m, double ppm, std::uint64_t seed) {
  std::mt19937_64 random(seed);
  const auto uniform = [&](double low, double high) {
    return low + (high - low) * static_cast<double>(random() >> 11) * 0x1p-53;
  };
  for (std::size_t i = 0; i < schedule_.anchor_ids_count; ++i) {
    add({.id = schedule_.anchor_ids[i],
         .x_m = uniform(0.0, spread_m),
         .offset_ppm = uniform(-ppm, ppm),
         .phase_ticks = uniform(0.0, 1e12)});
  }
  for (std::size_t i = 0; i < schedule_.tag_ids_count; ++i) {
    add({.id = schedule_.tag_ids[i],
         .x_m = uniform(0.0, spread_m),
         .offset_ppm = uniform(-ppm, ppm),
         .phase_ticks = uniform(0.0, 1e12)});
  }
}

void Air::start(std::size_t node) {
  Node& n = *nodes_[node];
  n.on = true;
  arm(node, dispatch(n, [&](auto& machine) { return machine.start(local(n, now_)); }));
}

void Air::survey(std::size_t node, std::uint16_t lender) {
  Node& n = *nodes_[node];
  mac::Site site = site_of(n);
  site.lender = lender;
  n.machine.emplace<mac::Tag>(site, n.counters);
  start(node);
}

void Air::attach(std::size_t node, mac::ControlChannel& channel) {
  auto& machine = nodes_[node]->machine;
  if (auto* tag = std::get_if<mac::Tag>(&machine)) return tag->attach(channel);
  std::get<mac::Anchor>(machine).attach(channel);
}

void Air::reset(std::size_t node) {
  Node& n = *nodes_[node];
  stop(node);
  ++n.boots;
  n.sessions = 0;
  n.nonces = 0;
  n.signed_places = {};
  build(n);
}

void Air::resume(std::size_t node) {
  Node& n = *nodes_[node];
  n.on = true;
  arm(node, dispatch(n, [&](auto& machine) { return machine.resume(local(n, now_)); }));
}

void Air::run(double seconds) {
  const double end = now_ + seconds * kTicksPerSecond;
  while (step(end)) {
  }
  now_ = end;
}

const mac::Station& Air::station(std::size_t node) const {
  const auto& machine = nodes_[node]->machine;
  if (const auto* tag = std::get_if<mac::Tag>(&machine)) return *tag;
  return std::get<mac::Anchor>(machine);
}

void Air::set_offset_ppm(std::size_t node, double ppm) {
  Node& n = *nodes_[node];
  const double local_now = local_ticks(n, now_);
  n.settings.offset_ppm = ppm;
  n.settings.phase_ticks = local_now - now_ * (1.0 + ppm * 1e-6);
}

mac::Site Air::site_of(Node& node) {
  return {.id = node.settings.id,
          .network_id = 0x55AA,
          .phy = phy_,
          .schedule = &node.schedule,
          .transmit_antenna_delay = node.settings.antenna_delay,
          .boot_count = node.boots,
          .sessions = &node.sessions,
          .network_key = key ? std::span<const std::uint8_t>(*key) : std::span<const std::uint8_t>(),
          .cipher = &witness_,
          .nonces = &node.nonces,
          .signed_places = &node.signed_places};
}

void Air::build(Node& node) {
  const mac::Site site = site_of(node);
  if (node.settings.id < 100) {
    node.machine.emplace<mac::Tag>(site, node.counters);
  } else {
    node.machine.emplace<mac::Anchor>(site, node.counters);
  }
}

void Air::arm(std::size_t index, Step step) {
  carry_out(index, step);
  (void)dispatch(*nodes_[index], [this](auto& machine) {
    if (!only_events) machine.precompute();
    return Step{};
  });
}

void Air::carry_out(std::size_t index, Step step) {
  Node& n = *nodes_[index];
  for (;;) {
    if (step.completed != nullptr) record(index, *step.completed);
    n.action = step.action;
    n.ready = now_ + work_ticks;
    if (n.action.kind == Action::Kind::kTransmit) {
      (void)dispatch(n, [](auto& machine) {
        machine.finish_signing();
        return Step{};
      });
      n.outgoing.assign(n.action.frame.begin(), n.action.frame.end());
      if (true_time(n, n.action.at) - before() >= n.ready) return;
      step = dispatch(n, [&](auto& machine) { return machine.on_late(local(n, n.ready)); });
      continue;
    }
    const double from = n.action.kind == Action::Kind::kListen ? true_time(n, n.action.at) : n.ready;
    n.busy_from = std::max(from, n.ready);
    if (n.action.kind == Action::Kind::kNone || true_time(n, n.action.until) > n.busy_from) return;
    step = dispatch(n, [&](auto& machine) { return machine.on_timeout(local(n, n.ready)); });
  }
}

void Air::record(std::size_t index, const mac::Exchange& exchange) {
  for (std::size_t i = 0; i < exchange.count; ++i) {
    double truth_m = 0.0;
    for (const auto& other : nodes_) {
      if (other->settings.id == exchange.legs[i].anchor) {
        truth_m = std::abs(other->settings.x_m - nodes_[index]->settings.x_m);
      }
    }
    ranges.push_back({nodes_[index]->settings.id, exchange.legs[i].anchor, exchange.superframe,
                      mac::evaluate(exchange, exchange.legs[i]), truth_m});
  }
}

bool Air::step(double end) {
  double first = end;
  std::size_t actor = kGhost;
  const Frame* ghost = nullptr;
  for (std::size_t i = 0; i < nodes_.size(); ++i) {
    const Node& n = *nodes_[i];
    if (!n.on || n.action.kind == Action::Kind::kNone) continue;
    const bool sends = n.action.kind == Action::Kind::kTransmit;
    const double t =
        sends ? true_time(n, leaves_at(n.action)) + after(n.outgoing.size()) : true_time(n, n.action.until);
    if (t < first) {
      first = t;
      actor = i;
    }
  }
  for (const Frame& g : ghosts_) {
    if (g.rmarker + after(g.bytes.size()) < first) {
      first = g.rmarker + after(g.bytes.size());
      ghost = &g;
    }
  }
  if (ghost == nullptr && actor == kGhost) return false;
  now_ = first;
  if (ghost != nullptr) {
    const Frame frame = *ghost;
    ghosts_.erase(ghosts_.begin() + (ghost - ghosts_.data()));
    transmit(frame);
    return true;
  }
  Node& n = *nodes_[actor];
  if (n.action.kind != Action::Kind::kTransmit) {
    arm(actor, dispatch(n, [&](auto& machine) { return machine.on_timeout(local(n, now_)); }));
    return true;
  }
  const ClockTime timestamp = n.action.at;
  witness_.see(n.outgoing);
  transmit({actor, true_time(n, leaves_at(n.action)), n.settings.x_m, n.outgoing});
  arm(actor, dispatch(n, [&](auto& machine) { return machine.on_transmitted(timestamp); }));
  return true;
}

void Air::transmit(const Frame& frame) {
  if (overheard) overheard(frame);
  if (jammed && jammed(frame)) return;
  const double start = frame.rmarker - before();
  const double end = frame.rmarker + after(frame.bytes.size());
  bool collided = false;
  std::vector<std::size_t> receivers;
  for (std::size_t i = 0; i < nodes_.size(); ++i) {
    if (i == frame.source || !nodes_[i]->on || !audible(frame.source, i)) continue;
    if (disturbed(i, frame.source, start, end)) {
      collided = true;
    } else {
      receivers.push_back(i);
    }
  }
  past_.push_back({frame.source, start, end});
  if (past_.size() > 64) past_.erase(past_.begin(), past_.begin() + 32);
  collisions += collided ? 1 : 0;
  for (const std::size_t i : receivers) hear(i, frame, start, end);
}

bool Air::disturbed(std::size_t receiver, std::size_t source, double start, double end) const {
  for (const Past& past : past_) {
    if (past.source != receiver && past.end > start && past.start < end && audible(past.source, receiver)) {
      return true;
    }
  }
  for (std::size_t i = 0; i < nodes_.size(); ++i) {
    const Node& n = *nodes_[i];
    if (i == source || i == receiver || !n.on || n.action.kind != Action::Kind::kTransmit) continue;
    if (!audible(i, receiver)) continue;
    const double other = true_time(n, leaves_at(n.action));
    if (jammed && jammed({i, other, n.settings.x_m, n.outgoing})) continue;
    if (other - before() < end && other + after(n.outgoing.size()) > start) return true;
  }
  return false;
}

void Air::hear(std::size_t index, const Frame& frame, double start, double end) {
  Node& n = *nodes_[index];
  if (!n.on || index == frame.source) return;
  if (n.action.kind != Action::Kind::kListen && n.action.kind != Action::Kind::kListenNow) return;
  const double flight = std::abs(frame.x_m - n.settings.x_m) / kMetresPerTick;
  if (n.busy_from > start + flight || true_time(n, n.action.until) < end + flight) return;
  if (lost && lost(frame, index)) return;
  const double sender_ppm =
      frame.source == kGhost ? n.settings.offset_ppm : nodes_[frame.source]->settings.offset_ppm;
  const double offset_ppb = (sender_ppm - n.settings.offset_ppm) * 1e3;
  mac::Reception reception{.timestamp = local(n, frame.rmarker + flight + timestamp_noise_ticks * gaussian()),
                           .timestamp_valid = true,
                           .frame = frame.bytes};
  if (radio_.carrier) reception.quality.clock_offset_ppb = static_cast<std::int32_t>(std::lround(offset_ppb));
  if (spoil) spoil(index, reception);
  (void)dispatch(n, [&](auto& machine) {
    if (!only_events) machine.begin_verify(reception.frame);
    return Step{};
  });
  arm(index, dispatch(n, [&](auto& machine) { return machine.on_received(reception); }));
}

}  // namespace groma::testing
