// gromad's event loop: descriptors and timers, served on one thread. It is a thin layer over Boost.Asio, so
// that few sources compile Asio.
#pragma once

#include <functional>
#include <memory>
#include <vector>

namespace boost::asio {
class io_context;
}

namespace groma::daemon {

class EventLoop {
 public:
  using Action = std::function<void()>;
  // The time in s, of any origin; it never decreases. All times of gromad come from here.
  using Clock = std::function<double()>;
  // CLOCK_MONOTONIC.
  [[nodiscard]] static double monotonic_s();

  // Timers that are due are called within this time.
  static constexpr double kTick_s = 0.010;

  // Watches a descriptor. It is destroyed before the descriptor is closed, also by its own actions.
  class Watch {
   public:
    // on_readable: whenever there is something to read, or the other side has gone. If it leaves bytes, it is
    // called again after the other descriptors that are ready.
    Watch(EventLoop& loop, int fd, Action on_readable, Action on_writable = {});
    ~Watch();
    Watch(const Watch&) = delete;
    Watch& operator=(const Watch&) = delete;

    // Calls on_writable once, as soon as the descriptor can be written to.
    void await_writable();

   private:
    struct State;
    std::shared_ptr<State> state_;
  };

  // Calls an action each period_s by the loop's clock, first at once; with 0 at each tick. The action does
  // not destroy its own timer.
  class Timer {
   public:
    Timer(EventLoop& loop, double period_s, Action action);
    ~Timer();
    Timer(const Timer&) = delete;
    Timer& operator=(const Timer&) = delete;

   private:
    friend class EventLoop;
    EventLoop& loop_;
    double period_s_;
    Action action_;
    double next_s_;
  };

  explicit EventLoop(Clock clock = monotonic_s);
  ~EventLoop();
  EventLoop(const EventLoop&) = delete;
  EventLoop& operator=(const EventLoop&) = delete;

  [[nodiscard]] double now_s() const { return clock_(); }

  // Serves until stop(). An exception of an action ends it and is passed on.
  void run();
  void stop();
  // Serves what is ready and due, without waiting: for a caller with a clock of its own.
  void poll();

  [[nodiscard]] boost::asio::io_context& context() noexcept;

 private:
  struct Reactor;
  void call_timers();
  void tick();

  Clock clock_;
  std::unique_ptr<Reactor> reactor_;
  std::vector<Timer*> timers_;  // null: destroyed
};

}  // namespace groma::daemon
