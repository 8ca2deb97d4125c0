// A site whose anchors have no cable: their commands go through the tag's serial line.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "test/sim/site_bench.hpp"

namespace groma::sim {

// Spacing of a tag at the origin and anchors in a row. Only neighbours hear each other.
inline constexpr double kApart_m = 80.0;

class Reach {
 public:
  struct Answer {
    groma_Reply reply = groma_Reply_init_zero;
    std::vector<groma_NodeToHost> rest;
    double took_s = 0.0;
    int pending = 0;
  };

  struct Options {
    int anchors = 3;
    bool in_a_row = false;
    double loss = 0.0;
    bool keyed = false;
    // Changes the site's settings, for example what runs the nodes.
    std::function<SiteSettings(SiteSettings)> change = [](SiteSettings site) { return site; };
  };

  explicit Reach(const Options& options) : bench(options.change(settings(options))) {
    const int anchors = options.anchors;
    if (options.in_a_row) {
      for (int i = 0; i < anchors; ++i) bench.space.put(nth_anchor(i), {kApart_m * (i + 1), 0.0, 2.0});
      bench.space.put(nth_tag(0), {0.0, 0.0, 2.0});
    }
    run(2.0);
  }

  static SiteSettings settings(const Options& options) {
    SiteSettings site;
    const int anchors = options.anchors;
    site.anchors = anchors;
    site.medium.loss_probability = options.loss;
    site.spread_ppm = 10.0;
    if (options.keyed)
      site.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
    site.configure = [anchors](groma_Config& config) {
      // The key's hash: a configuration written over the air has it in place of the key.
      if (config.network_key.size != 0) config.network_key_hash = 0xC0DE'0001;
      // All but the last one relay.
      for (int i = 1; i + 1 < anchors && i <= 4; ++i)
        config.schedule.backup_ids[config.schedule.backup_ids_count++] = nth_anchor(i);
      config.schedule.responses = 3;
    };
    return site;
  }

  void run(double duration_s) {
    now_s_ += duration_s;
    bench.run_until(now_s_);
  }
  // Cuts the node's power for 0.2 s. `node`: its index in the network.
  void cut_power(std::size_t node) {
    bench.network.set_power(node, false);
    run(0.2);
    bench.network.set_power(node, true);
  }
  [[nodiscard]] Listener& wired() { return bench.listeners[0]; }

  // Sends the command and waits for its final reply, at most `most_s`.
  std::optional<Answer> ask(std::uint16_t target, groma_HostToNode command, double most_s = 60.0) {
    command.target_id = target;
    command.request_id = ++request_;
    wired().relayed.clear();
    wired().replies.clear();
    if (!bench.network.send(0, frame_of(command))) ADD_FAILURE() << "the line is full";
    Answer answer;
    const double begin_s = now_s_;
    while (now_s_ < begin_s + most_s) {
      run(0.02);
      answer.pending = static_cast<int>(std::ranges::count_if(wired().replies, [](const groma_Reply& reply) {
        return reply.result == groma_Result_RESULT_PENDING;
      }));
      for (const groma_Reply& reply : wired().replies) {
        if (reply.request_id != request_ || reply.result == groma_Result_RESULT_PENDING) continue;
        answer.reply = reply;
        answer.took_s = now_s_ - begin_s;
        return answer;
      }
      for (const groma_NodeToHost& message : wired().relayed) {
        if (message.which_body != groma_NodeToHost_reply_tag) continue;
        if (message.body.reply.request_id != request_) continue;
        EXPECT_EQ(message.source_id, target);
        answer.reply = message.body.reply;
        run(0.05);
        answer.rest = wired().relayed;
        answer.took_s = now_s_ - begin_s;
        return answer;
      }
    }
    return std::nullopt;
  }

  std::optional<Answer> ask(std::uint16_t target, pb_size_t which, double most_s = 60.0) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.which_body = which;
    return ask(target, command, most_s);
  }

  std::optional<groma_Hello> hello(std::uint16_t target) {
    const auto answer = ask(target, groma_HostToNode_get_hello_tag);
    if (!answer) return std::nullopt;
    for (const groma_NodeToHost& message : answer->rest) {
      if (message.which_body == groma_NodeToHost_hello_tag) return message.body.hello;
    }
    return std::nullopt;
  }

  // As it goes over the air: without its key.
  [[nodiscard]] groma_Config anchor_config(std::uint16_t id) const {
    groma_Config config = bench.config_of(id, groma_Role_ROLE_ANCHOR);
    config.network_key = {};
    return config;
  }
  groma_Reply write(std::uint16_t target, const groma_Config& config) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.which_body = groma_HostToNode_write_config_tag;
    command.body.write_config = config;
    const auto answer = ask(target, command);
    return answer ? answer->reply : groma_Reply groma_Reply_init_zero;
  }
  groma_Result apply(std::uint16_t target, std::uint16_t trial_s) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.which_body = groma_HostToNode_apply_config_tag;
    command.trial_s = trial_s;
    const auto answer = ask(target, command);
    return answer ? answer->reply.result : groma_Result_RESULT_STORAGE;
  }

  // Summed over all nodes that have a serial line.
  [[nodiscard]] std::uint32_t frames_not_genuine() const {
    std::uint32_t count = 0;
    for (const Listener& listener : bench.listeners)
      count += listener.counters.forged_frames + listener.counters.unsecured_frames;
    return count;
  }

  SiteBench bench;

 private:
  double now_s_ = 0.0;
  std::uint32_t request_ = 7000;
};

}  // namespace groma::sim
