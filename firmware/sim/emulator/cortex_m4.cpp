#include "firmware/sim/emulator/cortex_m4.hpp"

#include <utility>

#include "firmware/sim/emulator/cortex_m4_core.hpp"

namespace groma::sim {

CortexM4::CortexM4(std::span<std::uint8_t> flash, std::span<std::uint8_t> ram, Bus& bus,
                   const CpuTiming& timing)
    : core_(std::make_unique<Core>(flash, ram, bus, timing)) {}

CortexM4::~CortexM4() = default;

void CortexM4::reset(SimTime t) {
  core_->reset(t);
}
void CortexM4::run(SimTime until) {
  core_->run(until);
}
void CortexM4::limit(SimTime t) {
  core_->limit(t);
}
void CortexM4::stall(SimTime duration) {
  core_->stall(duration);
}
SimTime CortexM4::now() const {
  return core_->now();
}
void CortexM4::idle_until(SimTime t) {
  core_->idle_until(t);
}
bool CortexM4::sleeping() const {
  return core_->sleeping();
}
bool CortexM4::sleeping_deep() const {
  return core_->sleeping_deep();
}
SimTime CortexM4::next_wake() const {
  return core_->next_wake();
}
void CortexM4::set_irq(unsigned irq, bool level) {
  core_->set_line(exception::kFirstIrq + irq, level);
}
void CortexM4::pend_nmi() {
  core_->pend(exception::kNmi);
}
void CortexM4::set_event() {
  core_->set_event();
}
bool CortexM4::lockup() const {
  return core_->lockup();
}
bool CortexM4::reset_requested() const {
  return core_->reset_requested();
}
void CortexM4::guard_wake_up(bool on) {
  core_->guard_wake_up(on);
}
void CortexM4::flash_changed(std::uint32_t address, std::size_t bytes) {
  core_->flash_changed(address, bytes);
}
std::uint32_t CortexM4::pc() const {
  return core_->pc();
}
std::uint32_t CortexM4::get_register(Register which) const {
  return core_->get_register(which);
}
void CortexM4::set_register(Register which, std::uint32_t value) {
  core_->set_register(which, value);
}
std::uint64_t CortexM4::instructions() const {
  return core_->instructions();
}
std::uint64_t CortexM4::exceptions() const {
  return core_->exceptions();
}
void CortexM4::trace(bool on) {
  core_->trace(on);
}
std::uint64_t CortexM4::trace_hash() const {
  return core_->trace_hash();
}
void CortexM4::set_semihosting(std::function<std::uint32_t(std::uint32_t, std::uint32_t)> handler) {
  core_->set_semihosting(std::move(handler));
}

}  // namespace groma::sim
