// The attacks of attack_campaign.cpp. Each one runs for some seconds against an Arena.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "test/host/daemon/attack_arena.hpp"

namespace groma::daemon::test {

struct Attack {
  std::string name;
  std::function<void(Arena& arena, double seconds)> act;
  // The pose latency is compared with the undisturbed.
  bool judged = false;
  // It only adds to what arrives: each odometry sample has a pose.
  bool harmless = false;
  // Also in the short form.
  bool quick = false;
};

[[nodiscard]] std::vector<Attack> attacks_on_the_pose_stream();
[[nodiscard]] std::vector<Attack> attacks_on_the_web_server();
[[nodiscard]] std::vector<Attack> attacks_on_the_robots_side();
[[nodiscard]] std::vector<Attack> attacks_on_the_tags_link();
[[nodiscard]] std::vector<Attack> attacks_on_the_process();

}  // namespace groma::daemon::test
