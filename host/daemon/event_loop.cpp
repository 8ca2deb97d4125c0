#include "host/daemon/event_loop.hpp"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <utility>

#include <boost/asio/io_context.hpp>
#include <boost/asio/posix/stream_descriptor.hpp>
#include <boost/asio/steady_timer.hpp>

namespace groma::daemon {

namespace asio = boost::asio;
using Error = boost::system::error_code;

struct EventLoop::Reactor {
  asio::io_context context{1};  // one thread
  asio::steady_timer timer{context};
};

struct EventLoop::Watch::State {
  State(EventLoop& loop, int fd, Action readable, Action writable)
      : descriptor(loop.context(), fd), on_readable(std::move(readable)), on_writable(std::move(writable)) {}

  // An operation holds the state, so that an action may destroy its watch.
  static void await_readable(const std::shared_ptr<State>& state) {
    state->descriptor.async_wait(asio::posix::stream_descriptor::wait_read, [state](const Error& error) {
      if (error || !state->watched) return;
      state->on_readable();
      if (state->watched) await_readable(state);
    });
  }
  static void await_writable(const std::shared_ptr<State>& state) {
    if (std::exchange(state->awaits_writable, true)) return;
    state->descriptor.async_wait(asio::posix::stream_descriptor::wait_write, [state](const Error& error) {
      state->awaits_writable = false;
      if (!error && state->watched) state->on_writable();
    });
  }

  asio::posix::stream_descriptor descriptor;
  Action on_readable;
  Action on_writable;
  bool watched = true;
  bool awaits_writable = false;
};

EventLoop::Watch::Watch(EventLoop& loop, int fd, Action on_readable, Action on_writable)
    : state_(std::make_shared<State>(loop, fd, std::move(on_readable), std::move(on_writable))) {
  State::await_readable(state_);
}

EventLoop::Watch::~Watch() {
  state_->watched = false;
  // Ends the operations; the descriptor stays open.
  state_->descriptor.release();
}

void EventLoop::Watch::await_writable() {
  State::await_writable(state_);
}

EventLoop::Timer::Timer(EventLoop& loop, double period_s, Action action)
    : loop_(loop), period_s_(period_s), action_(std::move(action)), next_s_(loop.now_s()) {
  loop_.timers_.push_back(this);
}

EventLoop::Timer::~Timer() {
  std::replace(loop_.timers_.begin(), loop_.timers_.end(), this, static_cast<Timer*>(nullptr));
}

EventLoop::EventLoop(Clock clock) : clock_(std::move(clock)), reactor_(std::make_unique<Reactor>()) {}

EventLoop::~EventLoop() = default;

double EventLoop::monotonic_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

asio::io_context& EventLoop::context() noexcept {
  return reactor_->context;
}

void EventLoop::run() {
  reactor_->context.restart();
  tick();
  reactor_->context.run();
}

void EventLoop::stop() {
  reactor_->context.stop();
}

void EventLoop::poll() {
  reactor_->context.restart();
  reactor_->context.poll();
  call_timers();
}

void EventLoop::tick() {
  call_timers();
  reactor_->timer.expires_after(std::chrono::duration_cast<std::chrono::steady_clock::duration>(
      std::chrono::duration<double>(kTick_s)));
  reactor_->timer.async_wait([this](const Error& error) {
    if (!error) tick();
  });
}

void EventLoop::call_timers() {
  const double now_s = clock_();
  // An action may create and destroy timers.
  for (std::size_t i = 0; i < timers_.size(); ++i) {
    Timer* const timer = timers_[i];
    if (timer == nullptr || now_s < timer->next_s_) continue;
    // A call that comes late does not delay the next ones, unless it is late by a whole period.
    const double late_s = now_s - timer->next_s_;
    timer->next_s_ = (late_s < timer->period_s_ ? timer->next_s_ : now_s) + timer->period_s_;
    timer->action_();
  }
  std::erase(timers_, nullptr);
}

}  // namespace groma::daemon
