#include "host/daemon/link_input.hpp"

#include <fmt/format.h>

#include <array>
#include <utility>

namespace groma::daemon {
namespace {

// The device is plugged in, its server starts, another program ends.
bool may_come(link::LinkFault fault) {
  return fault == link::LinkFault::kNoDevice || fault == link::LinkFault::kBusy;
}

}  // namespace

LinkInput::LinkInput(EventLoop& loop, Setup setup)
    : loop_(loop), setup_(std::move(setup)), link_(setup_.open) {}

link::LinkError LinkInput::open() {
  if (link_.service(loop_.now_s())) {
    opened(false);
  } else if (!may_come(link_.last_error().fault)) {
    return link_.last_error();
  }
  return {};
}

void LinkInput::service() {
  if (link_.service(loop_.now_s())) {
    const bool again = link_.counters().opened > 1;
    setup_.log(fmt::format("{}: {}", setup_.name, again ? "reopened" : "opened"));
    opened(again);
  }
  if (has_more_) read();
  if (link_.get() != nullptr) {
    log_news();
  } else if (logged_error_ != link_.last_error().message) {
    logged_error_ = link_.last_error().message;
    if (!logged_error_.empty()) setup_.log(logged_error_);
  }
}

void LinkInput::opened(bool again) {
  logged_error_.clear();
  setup_.on_opened(again);
  watch_.emplace(loop_, link_.get()->poll_fd(), [this] { read(); });
}

void LinkInput::read() {
  std::array<std::uint8_t, kReadSize> buffer{};
  has_more_ = false;
  for (int i = 0; i < kReadsPerTurn; ++i) {
    const link::ReadResult result = link_.read(buffer, loop_.now_s());
    if (result.gone) {
      watch_.reset();
      setup_.log(fmt::format("{}: the link is lost; it will be reopened as soon as possible", setup_.name));
      return;
    }
    if (result.bytes == 0) return log_news();
    setup_.on_bytes(std::span(buffer).first(result.bytes), loop_.now_s());
  }
  has_more_ = true;
  log_news();
}

void LinkInput::log_news() {
  if (const std::string news = link_.get()->take_news(); !news.empty()) setup_.log(news);
}

}  // namespace groma::daemon
