#include "host/provision/node_client.hpp"

#include <pb_encode.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <random>
#include <span>
#include <utility>

#include "proto/frame_codec.hpp"

namespace groma::provision {

namespace {

using Clock = std::chrono::steady_clock;

double since(Clock::time_point begin) {
  return std::chrono::duration<double>(Clock::now() - begin).count();
}

}  // namespace

NodeClient::NodeClient(std::unique_ptr<link::ByteLink> link)
    : link_(std::move(link)), request_id_(std::random_device{}()) {
  std::array<std::uint8_t, 4096> old{};
  // As much as a system buffers at most: a node that never stops sending must not hold us here.
  for (int i = 0; i < 64; ++i) {
    const link::ReadResult result = link_->read(old);
    gone_ = result.gone;
    if (result.bytes == 0 || gone_) break;
  }
}

void NodeClient::on_reply(const groma_Reply& reply) {
  if (reply.request_id == request_id_) reply_ = reply;
}

std::optional<groma_Reply> NodeClient::ask(groma_HostToNode command, const Patience& patience) {
  reply_.reset();
  command.request_id = ++request_id_;
  for (int i = 0; i < patience.tries && !gone_; ++i) {
    if (!send(command)) continue;
    if (wait(patience.answer_s, [this] { return reply_.has_value(); })) return reply_;
  }
  return std::nullopt;
}

std::optional<groma_Hello> NodeClient::ask_hello(const HelloTest& wanted, const Patience& patience) {
  hello_.reset();
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_get_hello_tag;
  command.request_id = ++request_id_;
  for (int i = 0; i < patience.tries && !gone_; ++i) {
    if (!send(command)) continue;
    if (wait(patience.answer_s, [&] { return hello_ && wanted(*hello_); })) return hello_;
  }
  return std::nullopt;
}

std::optional<groma_Hello> NodeClient::ask_hello(const Patience& patience) {
  return ask_hello([](const groma_Hello& /*any*/) { return true; }, patience);
}

bool NodeClient::send(const groma_HostToNode& command) {
  std::array<std::uint8_t, groma_HostToNode_size> payload{};
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  if (!pb_encode(&stream, groma_HostToNode_fields, &command)) return false;
  std::array<std::uint8_t, wire::max_encoded_size(groma_HostToNode_size)> frame{};
  const std::size_t size = wire::encode_frame(std::span(payload).first(stream.bytes_written), frame);
  std::span<const std::uint8_t> left = std::span(frame).first(size);
  constexpr double kMost_s = 1.0;
  return wait(kMost_s, [&] {
    left = left.subspan(std::min(link_->write(left), left.size()));
    return left.empty();
  });
}

bool NodeClient::wait(double most_s, const std::function<bool()>& done) {
  constexpr double kStep_s = 0.02;  // how long a full line is left alone
  const Clock::time_point begin = Clock::now();
  while (!done()) {
    const double left_s = most_s - since(begin);
    if (gone_ || left_s <= 0.0) return false;
    pollfd entry{link_->poll_fd(), POLLIN, 0};
    (void)::poll(&entry, 1, static_cast<int>(std::ceil(std::min(left_s, kStep_s) * 1e3)));
    read();
  }
  return true;
}

void NodeClient::read() {
  std::array<std::uint8_t, 4096> chunk{};
  const link::ReadResult result = link_->read(chunk);
  bytes_ += result.bytes;
  decoder_.take(std::span(chunk).first(result.bytes),
                std::chrono::duration<double>(Clock::now().time_since_epoch()).count(), *this);
  gone_ = result.gone;
}

std::string NodeClient::silence() const {
  if (gone_) return "the port went away; plug it in again and repeat the command";
  if (bytes_ == 0) {
    return "no answer, not a byte; check that the node has power and is flashed ('groma flash'), that its TX "
           "and "
           "RX are crossed over, and the bit rate";
  }
  const wire::FrameCounters& frames = decoder_.frame_counters();
  if (frames.frames == 0 && frames.version_errors > 0) {
    return "no answer, and frames of another version; flash the image of this release ('groma flash')";
  }
  if (frames.frames == 0) {
    return "no answer, and bytes that are no frames; check the bit rate (link.baud of the plan), and that "
           "this "
           "port is a node's";
  }
  return "reports come, but no answer; check the line to the node's RX, and that no other program reads this "
         "port";
}

}  // namespace groma::provision
