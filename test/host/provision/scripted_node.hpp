// A node on a real pseudo-terminal that answers as a test says.
#pragma once

#include <pb_decode.h>
#include <poll.h>

#include <array>
#include <atomic>
#include <chrono>
#include <functional>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include "firmware/core/node/messages.hpp"
#include "groma.pb.h"
#include "host/simulation/pty_port.hpp"
#include "proto/frame_codec.hpp"
#include "test/host/link/node_frames.hpp"

namespace groma::provision::test {

inline groma_NodeToHost reply_of(const groma_HostToNode& command,
                                 groma_Result result = groma_Result_RESULT_OK, const std::string& text = "") {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_reply_tag;
  message.body.reply.request_id = command.request_id;
  message.body.reply.result = result;
  node::copy_text(message.body.reply.text, text.c_str());
  return message;
}

inline groma_NodeToHost hello_of(const groma_Hello& hello) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_hello_tag;
  message.body.hello = hello;
  return message;
}

class ScriptedNode {
 public:
  using Answer = std::function<std::vector<groma_NodeToHost>(const groma_HostToNode&)>;

  // Answers each command; `chatter` is sent every 5 ms.
  explicit ScriptedNode(Answer answer, std::vector<std::uint8_t> chatter = {})
      : answer_(std::move(answer)), chatter_(std::move(chatter)), thread_([this] { run(); }) {}
  ~ScriptedNode() {
    stop_ = true;
    thread_.join();
  }
  ScriptedNode(const ScriptedNode&) = delete;
  ScriptedNode& operator=(const ScriptedNode&) = delete;

  [[nodiscard]] const std::string& path() const { return port_.path(); }
  [[nodiscard]] int commands() const { return commands_; }

 private:
  void run() {
    wire::FrameDecoder decoder;
    std::array<std::uint8_t, 512> chunk{};
    while (!stop_) {
      const std::size_t size = port_.read(chunk);
      for (const std::uint8_t byte : std::span(chunk).first(size)) {
        if (!decoder.push(byte)) continue;
        const auto payload = decoder.payload();
        pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
        groma_HostToNode command = groma_HostToNode_init_zero;
        if (!pb_decode(&stream, groma_HostToNode_fields, &command)) continue;
        ++commands_;
        for (const groma_NodeToHost& message : answer_(command))
          (void)port_.write(link::test::frame_of(message));
      }
      if (!chatter_.empty()) (void)port_.write(chatter_);
      std::this_thread::sleep_for(std::chrono::milliseconds(size > 0 ? 0 : 5));
    }
  }

  simulation::PtyPort port_;
  Answer answer_;
  std::vector<std::uint8_t> chatter_;
  std::atomic<bool> stop_ = false;
  std::atomic<int> commands_ = 0;
  std::thread thread_;
};

}  // namespace groma::provision::test
