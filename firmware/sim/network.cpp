#include "firmware/sim/network.hpp"

#include <algorithm>
#include <string>
#include <utility>

namespace groma::sim {

Network::Network(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed)
    : medium_(propagation, settings, seed) {}

Network::~Network() = default;

std::size_t Network::add(std::unique_ptr<NodeHost> host) {
  due_.push_back({&host->chip(), host->next_work(), host->shares_bus()});
  shared_bus_ = shared_bus_ || host->shares_bus();
  nodes_.push_back(std::move(host));
  return nodes_.size() - 1;
}

void Network::set_threads(unsigned threads) {
  workers_ = threads > 1 ? std::make_unique<WorkerPool>(threads) : nullptr;
}

void Network::run_until(SimTime t) {
  if (workers_ != nullptr && !shared_bus_) {
    run_in_windows(t);
  } else {
    run_in_order(t);
  }
  if (t > now_) now_ = t;
}

SimTime Network::next_of(std::size_t node) {
  const SimTime work = due_[node].shares_bus ? nodes_[node]->next_work() : due_[node].work;
  return std::min(work, due_[node].chip->next_event());
}

void Network::run_node(std::size_t node, SimTime now) {
  const auto fail = [&](const std::string& cause) {
    throw SimulationError("node " + std::to_string(nodes_[node]->chip().id()) + " at " +
                          std::to_string(to_seconds(now)) + " s: " + cause);
  };
  try {
    nodes_[node]->run(now);
  } catch (const SimulationError& error) {
    fail(error.what());
  }
  due_[node].work = nodes_[node]->next_work();
  if (const std::string& fault = nodes_[node]->chip().fault(); !fault.empty()) fail(fault);
}

void Network::run_in_order(SimTime t) {
  for (;;) {
    SimTime next = kNever;
    std::size_t node = 0;
    for (std::size_t i = 0; i < due_.size(); ++i) {
      const SimTime event = next_of(i);
      if (event < next) {
        next = event;
        node = i;
      }
    }
    if (next > t) return;
    // A node whose next event is already past (a frame was announced to it late) runs now.
    if (next > now_) now_ = next;
    run_node(node, now_);
  }
}

void Network::run_in_windows(SimTime t) {
  for (;;) {
    SimTime next = kNever;
    for (std::size_t i = 0; i < due_.size(); ++i) next = std::min(next, next_of(i));
    if (next > t) return;
    now_ = std::max(now_, next);
    const SimTime end = std::min(t, now_ + kWindow);
    at_work_.clear();
    for (std::size_t i = 0; i < due_.size(); ++i)
      if (next_of(i) <= end) at_work_.push_back(i);
    failures_.assign(at_work_.size(), nullptr);

    medium_.hold();
    workers_->run(static_cast<std::uint16_t>(at_work_.size()), [&](std::uint16_t piece) {
      const std::size_t node = at_work_[piece];
      try {
        for (SimTime event = next_of(node); event <= end; event = next_of(node))
          run_node(node, std::max(now_, event));
      } catch (...) {
        failures_[piece] = std::current_exception();
      }
    });
    medium_.release();
    for (const std::exception_ptr& failure : failures_)
      if (failure != nullptr) std::rethrow_exception(failure);
  }
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
