#include "host/doctor/link_probe.hpp"

#include <poll.h>

#include <array>
#include <chrono>
#include <memory>
#include <span>

#include "groma.pb.h"
#include "host/link/can_path.hpp"
#include "host/link/network_link.hpp"
#include "host/link/report_decoder.hpp"

namespace groma::doctor {
namespace {

constexpr double kListen_s = 1.5;
constexpr double kLeast_s = 0.5;  // even if all is known before
constexpr double kTry_s = 0.6;    // another bit rate
constexpr std::array<unsigned, 6> kUsualRates{1'000'000, 115'200, 921'600, 460'800, 230'400, 2'000'000};

double steady_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

class Listener : public link::NodeSink {
 public:
  explicit Listener(LinkFacts& facts) : facts_(facts) {}

  void on_range(const model::RangeSample& range) override {
    ++facts_.ranges;
    if (!facts_.node.id) facts_.node.id = range.tag_id;
  }
  void on_hello(const groma_Hello& hello) override {
    has_hello_ = true;
    facts_.node.id = static_cast<model::NodeId>(hello.id);
    facts_.node.network_id = hello.network_id;
    facts_.node.version = hello.version;
    facts_.node.radio_error = hello.radio_error;
    facts_.node.role = link::role_word(hello.role);
  }
  void on_network_status(const groma_NetworkStatus& status) override {
    facts_.node.sync = link::sync_word(status.state);
  }
  [[nodiscard]] bool has_hello() const noexcept { return has_hello_; }

 private:
  LinkFacts& facts_;
  bool has_hello_ = false;
};

std::uint64_t bad_of(const wire::FrameCounters& frames) {
  return std::uint64_t{frames.crc_errors} + frames.version_errors + frames.oversize + frames.cobs_errors +
         frames.truncated + frames.bytes_discarded;
}

// Discards what waited for a reader.
void drain(link::ByteLink& link) {
  std::array<std::uint8_t, 4096> chunk{};
  for (int i = 0; i < 64 && link.read(chunk).bytes > 0; ++i) {
  }
}

// Listens until the node's hello and a range have come, or the time is over.
void listen(link::ByteLink& link, unsigned baud, double for_s, LinkFacts& facts) {
  groma_HostToNode request = groma_HostToNode_init_zero;
  request.request_id = 1;
  request.which_body = groma_HostToNode_get_hello_tag;
  drain(link);
  static_cast<void>(link.write(link::request_frame(request)));
  Listener listener(facts);
  link::ReportDecoder decoder(baud);
  const double begin_s = steady_s();
  double elapsed_s = 0.0;
  std::uint64_t bad_before = 0;  // the first intact frame: the link was opened in the midst of one
  for (bool gone = false; !gone && elapsed_s < for_s; elapsed_s = steady_s() - begin_s) {
    pollfd entry{link.poll_fd(), POLLIN, 0};
    static_cast<void>(::poll(&entry, 1, 20));
    std::array<std::uint8_t, 4096> chunk{};
    const link::ReadResult read = link.read(chunk);
    gone = read.gone;
    const bool is_first = decoder.frame_counters().frames == 0;
    decoder.take(std::span(chunk).first(read.bytes), steady_s(), listener);
    const wire::FrameCounters& frames = decoder.frame_counters();
    if (is_first && frames.frames > 0) bad_before = bad_of(frames);
    if (listener.has_hello() && facts.ranges > 0 && elapsed_s > kLeast_s) break;
  }
  facts.listened_s = elapsed_s;
  facts.frames = decoder.frame_counters().frames;
  facts.bad = bad_of(decoder.frame_counters()) - bad_before;
}

bool has_bit_rate(const std::string& path) {
  return !link::is_can_path(path) && !link::is_network_path(path);
}

}  // namespace

LinkFacts probe_link(const daemon::NodeLink& node, bool listens) {
  LinkFacts facts;
  const std::string path = node.path.string();
  link::OpenedLink opened = link::open_link(path, node.baud);
  facts.error = opened.error;
  if (!opened.link || !listens) return facts;
  listen(*opened.link, node.baud, kListen_s, facts);
  if (facts.frames > 0 || facts.bad == 0 || !has_bit_rate(path)) return facts;
  for (const unsigned baud : kUsualRates) {
    opened.link.reset();
    if (baud == node.baud) continue;
    opened = link::open_link(path, baud);
    if (!opened.link) continue;
    LinkFacts tried;
    listen(*opened.link, baud, kTry_s, tried);
    if (tried.frames == 0) continue;
    facts.works_at = baud;
    break;
  }
  return facts;
}

}  // namespace groma::doctor
