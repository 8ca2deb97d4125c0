// Messages over simulated shared slots: frames are lost, collide, are duplicated and reordered.
#include "firmware/core/node/air_link.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <memory>
#include <random>
#include <span>
#include <string>
#include <vector>

#include "test/support/frames.hpp"

namespace groma::node {
namespace {

using Bytes = std::vector<std::uint8_t>;
using Event = AirLink::Event;

class Slots {
 public:
  struct Node {
    std::uint16_t id = 0;
    double x = 0.0;  // hears senders within kReach
    bool relays = false;
    AirLink link;
    std::vector<Event> events;
    std::map<std::uint32_t, int> executed;  // by the command's first four bytes
    std::map<std::uint32_t, Bytes> commands;
    bool answers = true;
  };
  static constexpr double kReach = 1.0;

  explicit Slots(std::uint64_t seed) : random_(seed) {}

  Node& add(std::uint16_t id, double x, bool relays = false) {
    nodes_.push_back(std::make_unique<Node>());
    Node& node = *nodes_.back();
    node.id = id;
    node.x = x;
    node.relays = relays;
    node.link.start(id, relays, 7U * id + 1);
    if (relays) relays_.push_back(&node);
    return node;
  }

  // One superframe.
  void step() {
    ++number_;
    const std::size_t turn = number_ % (relays_.size() + 1);
    std::vector<Sent> sent;
    if (turn == 0) {
      for (const auto& node : nodes_) {
        if (const auto out = node->link.open_slot(number_))
          sent.push_back({node.get(), frame_of(*node, *out)});
      }
    } else if ((number_ / (relays_.size() + 1)) % 2 == 0) {  // else the beacon
      Node& relay = *relays_[turn - 1];
      if (const auto out = relay.link.own_turn(number_)) sent.push_back({&relay, frame_of(relay, *out)});
    }
    frames += sent.size();
    for (const auto& node : nodes_) hear(*node, sent);
    std::vector<Delayed> now;
    for (auto it = delayed_.begin(); it != delayed_.end();) {
      if (it->due > number_) {
        ++it;
        continue;
      }
      now.push_back(*it);
      it = delayed_.erase(it);
    }
    for (const Delayed& delayed : now) delayed.to->link.on_control(delayed.frame, number_, false);
    for (const auto& node : nodes_) handle_event(*node);
  }

  // True: answered with answer_to(command) and {1, 2, 3}. False: reported as lost.
  bool ask(Node& from, std::uint16_t target, std::uint32_t request, const Bytes& command) {
    // Retries while the link is busy, as a host does.
    for (int i = 0; i < 1'000 && from.link.ask(target, request, command) == AirLink::Asked::kBusy; ++i)
      step();
    from.events.clear();
    for (int i = 0; i < 100'000; ++i) {
      step();
      if (!from.events.empty()) break;
    }
    EXPECT_EQ(from.events.size(), 1U);
    if (from.events.empty() || from.events[0] == Event::kNoAnswer) return false;
    EXPECT_EQ(from.events[0], Event::kAnswer);
    EXPECT_EQ(from.link.request_id(), request);
    auto answer = from.link.message();
    const auto first = AirLink::next_message(answer);
    const auto second = AirLink::next_message(answer);
    EXPECT_TRUE(first && std::ranges::equal(*first, answer_to(command)));
    EXPECT_TRUE(second && std::ranges::equal(*second, Bytes{1, 2, 3}));
    EXPECT_FALSE(AirLink::next_message(answer));
    return true;
  }

  static Bytes answer_to(const Bytes& command) {
    Bytes answer(command.rbegin(), command.rend());
    if (answer.size() > AirLink::kMaxMessageBytes - 7) answer.resize(AirLink::kMaxMessageBytes - 7);
    return answer;
  }

  double loss = 0.0;
  double duplicated = 0.0;
  int max_delay = 0;  // superframes
  std::size_t frames = 0;
  std::size_t collisions = 0;

 private:
  struct Sent {
    Node* from;
    mac::Frame frame;
  };
  struct Delayed {
    std::uint32_t due;
    Node* to;
    mac::Frame frame;
  };

  static mac::Frame frame_of(const Node& node, const mac::ControlChannel::Outgoing& out) {
    return {.destination = out.destination, .source = node.id, .body = out.body};
  }
  double uniform() { return static_cast<double>(random_() >> 11) * 0x1p-53; }

  void hear(Node& node, const std::vector<Sent>& sent) {
    const Sent* heard = nullptr;
    for (const Sent& s : sent) {
      if (s.from == &node) return;
      if (std::abs(s.from->x - node.x) > kReach) continue;
      if (heard != nullptr) {
        ++collisions;
        return;
      }
      heard = &s;
    }
    if (heard == nullptr || uniform() < loss) return;
    const int copies = uniform() < duplicated ? 2 : 1;
    for (int i = 0; i < copies; ++i) {
      const auto delay = static_cast<std::uint32_t>(uniform() * (max_delay + 1));
      // Serialized and parsed, as on the air.
      const mac::ParseResult parsed = mac::parse(mac::serialize(heard->frame).bytes());
      ASSERT_TRUE(parsed.frame);
      delayed_.push_back({number_ + delay, &node, *parsed.frame});
    }
  }

  void handle_event(Node& node) {
    const Event event = node.link.take_event();
    if (event == Event::kNone) return;
    if (event != Event::kCommand) {
      node.events.push_back(event);
      return;
    }
    const auto message = node.link.message();
    const Bytes command(message.begin(), message.end());
    std::uint32_t key = 0;
    for (std::size_t i = 0; i < 4 && i < command.size(); ++i) key |= std::uint32_t{command[i]} << (8 * i);
    ++node.executed[key];
    node.commands[key] = command;
    if (!node.answers) return;
    node.link.begin_answer();
    for (const Bytes& bytes : {answer_to(command), Bytes{1, 2, 3}}) {
      const auto room = node.link.room();
      ASSERT_GE(room.size(), bytes.size());
      std::copy(bytes.begin(), bytes.end(), room.begin());
      node.link.append(bytes.size());
    }
    node.link.send_answer();
  }

  std::mt19937_64 random_;
  std::uint32_t number_ = 0;
  std::vector<std::unique_ptr<Node>> nodes_;
  std::vector<Node*> relays_;
  std::vector<Delayed> delayed_;
};

Bytes command_of(std::uint32_t key, std::size_t size, std::mt19937_64& random) {
  Bytes bytes(size);
  for (auto& byte : bytes) byte = static_cast<std::uint8_t>(random());
  for (std::size_t i = 0; i < 4; ++i) bytes[i] = static_cast<std::uint8_t>(key >> (8 * i));
  return bytes;
}

struct Case {
  const char* name;
  double loss;
  double duplicated;
  int max_delay;
  int hops;      // 1: within reach
  int max_lost;  // of 200
};
std::ostream& operator<<(std::ostream& out, const Case& c) {
  return out << c.name;
}

class AirLinkTest : public ::testing::TestWithParam<Case> {};

TEST_P(AirLinkTest, EachMessageArrivesOnceOrIsReportedLost) {
  const Case& c = GetParam();
  Slots slots(11);
  slots.loss = c.loss;
  slots.duplicated = c.duplicated;
  slots.max_delay = c.max_delay;
  Slots::Node& wired = slots.add(1, 0.0);
  for (int i = 1; i < c.hops; ++i) {
    slots.add(static_cast<std::uint16_t>(100 + i), 0.9 * i, true);
    if (i == 1) slots.add(200, 0.85, true);  // two relays with the same neighbours
  }
  Slots::Node& far = slots.add(2, 0.9 * c.hops);
  std::mt19937_64 random(5);
  int lost = 0;
  for (std::uint32_t i = 1; i <= 200; ++i) {
    const std::size_t size = static_cast<std::size_t>(4 + random() % (AirLink::kMaxMessageBytes - 3));
    const Bytes command = command_of(i, size, random);
    const bool answered = slots.ask(wired, 2, i, command);
    lost += answered ? 0 : 1;
    EXPECT_LE(far.executed[i], 1) << "command " << i;
    if (answered) {
      EXPECT_EQ(far.executed[i], 1) << "command " << i;
    }
    if (far.executed[i] != 0) {
      EXPECT_EQ(far.commands[i], command);
    }
  }
  EXPECT_LE(lost, c.max_lost);
  EXPECT_LE(far.executed.size(), 200U);  // no command that was never sent
  RecordProperty("frames", static_cast<int>(slots.frames));
  std::printf("[ %s ] %.1f frames a command and answer, %d of 200 reported lost, %zu collisions\n", c.name,
              static_cast<double>(slots.frames) / 200.0, lost, slots.collisions);
}

INSTANTIATE_TEST_SUITE_P(Air, AirLinkTest,
                         ::testing::Values(Case{"Clean", 0.0, 0.0, 0, 1, 0},
                                           Case{"TwoPercent", 0.02, 0.0, 0, 1, 0},
                                           Case{"ThirtyPercent", 0.3, 0.0, 0, 1, 0},
                                           Case{"DuplicatedAndDelayed", 0.3, 0.3, 12, 1, 0},
                                           Case{"TwoHops", 0.0, 0.0, 0, 2, 0},
                                           Case{"TwoHopsThirtyPercent", 0.3, 0.1, 6, 2, 2},
                                           Case{"FourHopsThirtyPercent", 0.3, 0.0, 0, 4, 4}),
                         ::testing::PrintToStringParamName());

TEST(AirLink, WithinReachNobodyRelays) {
  Slots slots(1);
  Slots::Node& wired = slots.add(1, 0.0);
  for (std::uint16_t id = 100; id < 107; ++id) slots.add(id, 0.5, true);
  slots.add(2, 0.9);
  std::mt19937_64 random(5);
  ASSERT_TRUE(slots.ask(wired, 2, 1, command_of(1, 48, random)));
  EXPECT_LE(slots.frames, 5U);  // one command frame, two answer frames, and acknowledgements
}

TEST(AirLink, AnAbsentNodeIsReported) {
  Slots slots(1);
  Slots::Node& wired = slots.add(1, 0.0);
  slots.add(100, 0.5, true);
  std::mt19937_64 random(5);
  EXPECT_FALSE(slots.ask(wired, 2, 1, command_of(1, 300, random)));
  EXPECT_LE(slots.frames, 100U);
}

TEST(AirLink, ARepeatedRequestIsAnsweredButNotExecutedAgain) {
  Slots slots(3);
  slots.loss = 0.2;
  Slots::Node& wired = slots.add(1, 0.0);
  Slots::Node& far = slots.add(2, 0.9);
  Slots::Node& other = slots.add(3, -0.9);
  std::mt19937_64 random(5);
  const Bytes command = command_of(17, 100, random);
  ASSERT_TRUE(slots.ask(wired, 2, 17, command));
  ASSERT_TRUE(slots.ask(wired, 2, 17, command));  // from the stored answer
  EXPECT_EQ(far.executed[17], 1);
  // The wired node may have served a command meanwhile and lost the answer.
  ASSERT_TRUE(slots.ask(other, 1, 5, command_of(5, 200, random)));
  ASSERT_TRUE(slots.ask(wired, 2, 17, command));
  EXPECT_EQ(far.executed[17], 1);
}

TEST(AirLink, ASlowNodeIsWaitedFor) {
  Slots slots(3);
  slots.loss = 0.3;
  Slots::Node& wired = slots.add(1, 0.0);
  Slots::Node& far = slots.add(2, 0.9);
  Slots::Node& other = slots.add(3, 0.5);
  far.answers = false;
  std::mt19937_64 random(5);
  ASSERT_EQ(wired.link.ask(2, 1, command_of(1, 100, random)), AirLink::Asked::kUnderWay);
  for (int i = 0; i < 3'000; ++i) slots.step();
  EXPECT_TRUE(wired.events.empty());
  EXPECT_EQ(far.executed[1], 1);
  EXPECT_FALSE(slots.ask(other, 2, 9, command_of(9, 100, random)));  // it serves one command at a time
  far.link.begin_answer();
  far.link.append(0);
  far.link.send_answer();
  for (int i = 0; i < 200 && wired.events.empty(); ++i) slots.step();
  ASSERT_EQ(wired.events.size(), 1U);
  EXPECT_EQ(wired.events[0], Event::kAnswer);
}

TEST(AirLink, OneCommandAtATime) {
  AirLink link;
  link.start(1, false, 9);
  const Bytes command(10, 3);
  EXPECT_EQ(link.ask(2, 1, command), AirLink::Asked::kUnderWay);
  EXPECT_EQ(link.ask(2, 1, command), AirLink::Asked::kUnderWay);
  EXPECT_EQ(link.ask(2, 2, command), AirLink::Asked::kBusy);
  EXPECT_EQ(link.ask(3, 1, command), AirLink::Asked::kBusy);
  const Bytes long_one(AirLink::kMaxMessageBytes + 1, 3);
  EXPECT_EQ(link.ask(3, 1, long_one), AirLink::Asked::kTooLong);
}

TEST(AirLink, WithoutOpenSlotsItGivesUp) {
  AirLink link;
  link.start(1, false, 9);
  ASSERT_EQ(link.ask(2, 1, Bytes(10, 3)), AirLink::Asked::kUnderWay);
  int seconds = 0;
  while (link.asking() && seconds < 20) {
    link.on_second();
    ++seconds;
  }
  EXPECT_EQ(link.take_event(), Event::kNoAnswer);
  EXPECT_GE(seconds, 3);
  EXPECT_LE(seconds, 10);
}

TEST(AirLink, GarbageIsNoCommand) {
  AirLink link;
  link.start(2, true, 9);
  std::mt19937_64 random(3);
  // Fragments of lengths and numbers that contradict each other never make a message.
  for (int i = 0; i < 20'000; ++i) {
    mac::Data data{.origin = static_cast<std::uint16_t>(1 + random() % 3),
                   .target = static_cast<std::uint16_t>(random() % 4),
                   .message = static_cast<std::uint8_t>(random()),
                   .fragment = static_cast<std::uint8_t>(random() % 255),
                   .fragments = 255,
                   .acknowledgement = random() % 3 == 0,
                   .to_host = random() % 2 == 0,
                   .asks = random() % 2 == 0,
                   .hops_left = static_cast<std::uint8_t>(random() % 4),
                   .round = static_cast<std::uint8_t>(random() % 8),
                   .size = static_cast<std::uint8_t>(random() % 49)};
    link.on_control({.source = data.origin, .body = data}, 1, false);
    EXPECT_EQ(link.take_event(), Event::kNone);
    if (i % 3 == 0) (void)link.open_slot(1);
    if (i % 5 == 0) (void)link.own_turn(1);
  }
}

}  // namespace
}  // namespace groma::node
