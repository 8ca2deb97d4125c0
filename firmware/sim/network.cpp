#include "firmware/sim/network.hpp"

#include <algorithm>
#include <string>
#include <utility>

namespace groma::sim {

Network::Network(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed)
    : medium_(propagation, settings, seed) {}

Network::~Network() = default;

std::size_t Network::add(std::unique_ptr<NodeHost> host) {
  due_.push_back({&host->chip(), host->next_work()});
  nodes_.push_back(std::move(host));
  return nodes_.size() - 1;
}

void Network::run_until(SimTime t) {
  for (;;) {
    SimTime next = kNever;
    std::size_t who = 0;
    for (std::size_t i = 0; i < due_.size(); ++i) {
      const SimTime event = std::min(due_[i].work, due_[i].chip->next_event());
      if (event < next) {
        next = event;
        who = i;
      }
    }
    if (next > t) break;
    // A node that has fallen due since it last ran (a frame announced to it late) runs now.
    if (next > now_) now_ = next;
    nodes_[who]->run(now_);
    due_[who].work = nodes_[who]->next_work();
    const std::string& fault = nodes_[who]->chip().fault();
    if (!fault.empty())
      throw SimulationError("node " + std::to_string(nodes_[who]->chip().id()) + " at " +
                            std::to_string(to_seconds(now_)) + " s: " + fault);
  }
  if (t > now_) now_ = t;
}

bool Network::send(std::size_t node, std::span<const std::uint8_t> bytes) {
  const bool queued = nodes_.at(node)->uart_in().write(now_, bytes);
  due_[node].work = nodes_[node]->next_work();
  return queued;
}

void Network::take(std::size_t node, std::vector<TimedByte>& out) {
  nodes_.at(node)->uart_out().take(now_, out);
}

void Network::set_power(std::size_t node, bool on) {
  nodes_.at(node)->set_power(on, now_);
  due_[node].work = nodes_[node]->next_work();
}

}  // namespace groma::sim
