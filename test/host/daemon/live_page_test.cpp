// The messages for browsers: what they say against the pose stream of the same daemon.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "test/host/daemon/daemon_loop_fixture.hpp"
#include "test/host/web/web_socket.hpp"

namespace groma::daemon {
namespace {

using nlohmann::json;
using web::test::WebSocketClient;

class LivePageTest : public DaemonLoop {
 protected:
  std::unique_ptr<WebSocketClient> open(const std::string& path, const std::string& headers = {},
                                        int receive_buffer = 0) {
    auto client = std::make_unique<WebSocketClient>(
        daemon_->web_port(), [this] { daemon_->poll(); }, receive_buffer);
    EXPECT_THAT(client->open(path, headers), StartsWith("HTTP/1.1 101 "));
    return client;
  }
  static std::vector<json> objects_of(const std::vector<std::string>& texts) {
    std::vector<json> out;
    out.reserve(texts.size());
    for (const std::string& text : texts) out.push_back(json::parse(text));
    return out;
  }
  static std::vector<json> objects_of(const std::string& stream) {
    std::vector<json> out;
    std::istringstream lines(stream);
    for (std::string line; std::getline(lines, line);) out.push_back(json::parse(line));
    return out;
  }
  static std::vector<json> of_class(const std::vector<json>& objects, const std::string& name) {
    std::vector<json> out;
    for (const json& object : objects) {
      if (object.at("class") == name) out.push_back(object);
    }
    return out;
  }
};

TEST_F(LivePageTest, SaysWhatThePoseStreamSays) {
  config_.web->walls = {{{0.0, 1.0}, {2.0, 3.0}}};
  start();
  TcpClient stream(daemon_->pose_port());
  const auto page = open("/live");
  std::vector<std::string> texts;
  std::string lines;
  run(20.0, [&](const auto&) {
    lines += stream.receive();
    while (const auto frame = page->next(0)) texts.push_back(frame->payload);
    page->poll();
  });
  for (const std::string& text : page->all()) texts.push_back(text);
  lines += stream.receive();
  const std::vector<json> seen = objects_of(texts);
  const std::vector<json> sent = objects_of(lines);
  ASSERT_GT(seen.size(), 100U);
  EXPECT_EQ(seen[0].at("class"), "VERSION");
  EXPECT_EQ(seen[1].at("class"), "SITE");
  EXPECT_EQ(seen[1].at("walls"), json::parse("[[0.0, 1.0, 2.0, 3.0]]"));
  EXPECT_EQ(seen[1].at("tags").size(), config_.tags.size());
  EXPECT_EQ(seen[1].at("nodes"), json::parse("[\"" + config_.nodes[0].path.string() + "\"]"));
  EXPECT_EQ(seen[1].at("simulated"), false);

  // Each POSE and STATUS is one of the stream's, in their order.
  for (const char* name : {"POSE", "STATUS"}) {
    const std::vector<json> of_page = of_class(seen, name);
    const std::vector<json> of_stream = of_class(sent, name);
    ASSERT_FALSE(of_page.empty());
    auto at = of_stream.begin();
    for (const json& object : of_page) {
      if (object.value("odometry", 1) == 0) continue;  // before the stream's client came
      at = std::find(at, of_stream.end(), object);
      ASSERT_NE(at, of_stream.end()) << object;
    }
  }
  // At most 20 a second, and all of them if there are fewer.
  const std::size_t poses = of_class(seen, "POSE").size();
  EXPECT_LE(poses, 20U * 20U + 2U);
  EXPECT_GT(poses, 150U);
  EXPECT_GE(of_class(seen, "STATUS").size(), of_class(sent, "STATUS").size());

  const std::vector<json> anchors = of_class(seen, "ANCHORS");
  ASSERT_FALSE(anchors.empty());
  ASSERT_EQ(anchors[0].at("anchors").size(), calibration_.anchors.size());
  for (std::size_t i = 0; i < calibration_.anchors.size(); ++i) {
    const json& anchor = anchors[0].at("anchors")[i];
    const model::AnchorCalibration& truth = calibration_.anchors[i];
    EXPECT_EQ(anchor.at("id"), truth.id);
    EXPECT_EQ(anchor.at("position_m")[1].get<double>(), truth.position_m.y());
    EXPECT_EQ(anchor.at("covariance_m2").size(), 9U);
    EXPECT_EQ(anchor.at("covariance_m2")[4].get<double>(), truth.covariance(1, 1));
  }
  EXPECT_FALSE(of_class(seen, "LOG").empty());
}

TEST_F(LivePageTest, GivesALaterClientTheHistory) {
  start();
  TcpClient stream(daemon_->pose_port());
  std::string lines;
  run(30.0, [&](const auto&) { lines += stream.receive(); });
  const auto page = open("/live");
  const std::vector<json> seen = objects_of(page->all());
  std::size_t begin = 0;
  while (begin < seen.size() && seen[begin].at("class") != "HISTORY") ++begin;
  ASSERT_LT(begin, seen.size());
  EXPECT_EQ(seen[begin].at("state"), "begin");
  std::size_t end = begin + 1;
  while (end < seen.size() && seen[end].at("class") != "HISTORY") ++end;
  ASSERT_LT(end, seen.size());
  EXPECT_EQ(seen[end].at("state"), "end");
  EXPECT_EQ(seen[begin].at("messages"), end - begin - 1);
  const std::vector<json> history(seen.begin() + static_cast<std::ptrdiff_t>(begin) + 1,
                                  seen.begin() + static_cast<std::ptrdiff_t>(end));
  // Four poses a second, a status each 2 s, from the beginning on; each change of the state.
  const std::vector<json> poses = of_class(history, "POSE");
  const std::vector<json> sent = of_class(objects_of(lines), "POSE");
  EXPECT_NEAR(static_cast<double>(poses.size()), 4.0 * 30.0, 15.0);
  EXPECT_NEAR(static_cast<double>(of_class(history, "STATUS").size()), 15.0, 2.0);
  const auto states = [](const std::vector<json>& of) {
    std::vector<std::string> out;
    for (const json& pose : of) {
      const std::string state = pose.at("state").get<std::string>() + pose.at("reason").dump();
      if (out.empty() || out.back() != state) out.push_back(state);
    }
    return out;
  };
  EXPECT_EQ(states(poses), states(sent));
}

// A client that does not read costs no pose.
TEST_F(LivePageTest, DoesNotWaitForASlowReader) {
  start();
  const auto slow = open("/live", "", 4096);
  TcpClient stream(daemon_->pose_port());
  std::string lines;
  run(20.0, [&](const auto&) { lines += stream.receive(); });
  EXPECT_GT(of_class(objects_of(lines), "POSE").size(), 500U);
}

TEST_F(LivePageTest, SpeaksTheProtocolOfFoxglove) {
  start();
  const auto viewer = open("/foxglove", "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n");
  const json info = json::parse(viewer->next()->payload);
  EXPECT_EQ(info.at("op"), "serverInfo");
  const json channels = json::parse(viewer->next()->payload);
  EXPECT_EQ(channels.at("op"), "advertise");
  std::map<std::string, unsigned> ids;
  for (const json& channel : channels.at("channels")) {
    ids[channel.at("topic")] = channel.at("id");
    EXPECT_EQ(channel.at("encoding"), "protobuf");
    EXPECT_EQ(channel.at("schemaEncoding"), "protobuf");
  }
  viewer->send(WebSocketClient::kText, json{{"op", "subscribe"},
                                            {"subscriptions",
                                             {{{"id", 7}, {"channelId", ids.at("/groma/pose")}},
                                              {{"id", 8}, {"channelId", ids.at("/groma/ranges")}},
                                              {{"id", 9}, {"channelId", ids.at("/groma/scene")}}}}}
                                           .dump());
  std::map<std::string, int> counts;
  const auto take = [&] {
    while (const auto frame = viewer->next(0)) {
      ASSERT_EQ(frame->opcode, WebSocketClient::kBinary);
      std::string key = std::to_string(frame->payload.at(0));
      if (frame->payload.at(0) == 1) {
        std::uint32_t id = 0;
        std::memcpy(&id, frame->payload.data() + 1, sizeof id);
        key += ":" + std::to_string(id);
      }
      ++counts[key];
    }
    viewer->poll();
  };
  run(10.0, [&](const auto&) { take(); });
  EXPECT_GT(counts["1:7"], 100);
  EXPECT_GT(counts["1:8"], 50);
  EXPECT_GE(counts["1:9"], 1);
  EXPECT_GT(counts["2"], 100);
  EXPECT_EQ(counts.size(), 4U);  // nothing that it has not subscribed to

  viewer->send(WebSocketClient::kText, R"({"op":"unsubscribe","subscriptionIds":[7]})");
  for (const char* wrong :
       {"", "{", "[]", "{}", R"({"op":"subscribe"})", R"({"op":"subscribe","subscriptions":[1]})",
        R"({"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]})",
        R"({"op":"subscribe","subscriptions":[{"id":1,"channelId":99}]})",
        R"({"op":"subscribe","subscriptions":[{"id":1e300,"channelId":0}]})",
        R"({"op":"unsubscribe","subscriptionIds":{}})", R"({"op":7})"}) {
    viewer->send(WebSocketClient::kText, wrong);
    viewer->poll();
  }
  take();
  counts.clear();
  run(12.0, [&](const auto&) { take(); });
  EXPECT_EQ(counts.count("1:7"), 0U);
  EXPECT_GT(counts["1:8"], 5);
}

}  // namespace
}  // namespace groma::daemon
