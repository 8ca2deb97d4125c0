#include "host/daemon/web_server.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "test/host/daemon/tcp_client.hpp"

namespace groma::daemon {
namespace {

using test::TcpClient;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

class WebServerTest : public ::testing::Test {
 protected:
  WebServerTest() {
    WebServer::Opened opened = WebServer::open(loop_, {.address = "127.0.0.1", .port = 0});
    server_ = std::move(opened.server);
    if (!server_) throw std::runtime_error(opened.error.message);
    server_->serve("/page", "text/plain; charset=utf-8", [this] { return std::string_view(page_); });
  }

  // What the server sends until it has nothing more to do.
  std::string receive(TcpClient& client) {
    std::string text;
    for (std::size_t before = 1; before != text.size();) {
      before = text.size();
      loop_.poll();
      text += client.receive();
    }
    return text;
  }
  std::string answer_to(const std::string& request) {
    TcpClient client(server_->port());
    loop_.poll();
    EXPECT_TRUE(client.send(request));
    return receive(client);
  }

  EventLoop loop_;
  std::string page_ = "content\n";
  std::unique_ptr<WebServer> server_;
};

TEST_F(WebServerTest, ServesItsPages) {
  TcpClient client(server_->port());
  for (int i = 0; i < 3; ++i) {
    page_ = "content " + std::to_string(i) + "\n";
    ASSERT_TRUE(client.send("GET /page HTTP/1.1\r\nHost: x\r\n\r\n"));
    const std::string answer = receive(client);
    EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
    EXPECT_THAT(answer, HasSubstr("\r\nContent-Type: text/plain; charset=utf-8\r\n"));
    EXPECT_THAT(answer, HasSubstr("\r\nContent-Length: 10\r\n"));
    EXPECT_THAT(answer, ::testing::EndsWith("\r\n\r\n" + page_));
    EXPECT_FALSE(client.ended());
  }
  EXPECT_EQ(server_->counters().accepted, 1U);
  EXPECT_EQ(server_->counters().requests, 3U);
  EXPECT_THAT(answer_to("GET /page?a=b HTTP/1.1\r\nHost: x\r\n\r\n"), StartsWith("HTTP/1.1 200 OK\r\n"));
}

TEST_F(WebServerTest, AnswersHeadWithoutTheContent) {
  const std::string answer = answer_to("HEAD /page HTTP/1.1\r\nHost: x\r\n\r\n");
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
  EXPECT_THAT(answer, HasSubstr("\r\nContent-Length: 8\r\n"));
  EXPECT_THAT(answer, ::testing::EndsWith("\r\n\r\n"));
}

TEST_F(WebServerTest, RefusesWhatItDoesNotServe) {
  for (const std::string path :
       {"/", "/live", "/foxglove", "/page/", "/pag", "//page", "*", "/../page", "/%70age"}) {
    EXPECT_THAT(answer_to("GET " + path + " HTTP/1.1\r\nHost: x\r\n\r\n"), StartsWith("HTTP/1.1 404 "))
        << path;
  }
  const std::string post = answer_to("POST /page HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n");
  EXPECT_THAT(post, StartsWith("HTTP/1.1 405 "));
  EXPECT_THAT(post, HasSubstr("\r\nAllow: GET, HEAD\r\n"));
  for (const std::string& wrong :
       {std::string("hello\r\n\r\n"), std::string("GET /page\r\n\r\n"), std::string(100, '\0') + "\r\n\r\n",
        std::string("GET /page HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello"),
        "GET /page HTTP/1.1\r\nHost: " + std::string(WebServer::kMaxRequest, 'x') + "\r\n\r\n"}) {
    EXPECT_THAT(answer_to(wrong), StartsWith("HTTP/1.1 400 ")) << wrong.substr(0, 40);
  }
  EXPECT_THAT(answer_to("GET /page HTTP/1.1\r\nHost: x\r\n\r\n"), StartsWith("HTTP/1.1 200 "));
}

TEST_F(WebServerTest, EndsAConnectionAsTheClientAsks) {
  TcpClient client(server_->port());
  ASSERT_TRUE(client.send("GET /page HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"));
  EXPECT_THAT(receive(client), HasSubstr("content"));
  EXPECT_TRUE(client.ended());
}

// Clients that say nothing, or never read, keep no one else waiting, and are bounded in number.
TEST_F(WebServerTest, DoesNotWaitForSlowClients) {
  page_ = std::string(8'000'000, 'x');
  std::vector<std::unique_ptr<TcpClient>> slow;
  for (std::size_t i = 0; i < WebServer::kMaxClients - 1; ++i) {
    slow.push_back(std::make_unique<TcpClient>(server_->port(), 4096));
    if (i % 2 == 0) {
      ASSERT_TRUE(slow.back()->send("GET /page HTTP/1.1\r\nHost: x\r\n\r\n"));
    }
    loop_.poll();
  }
  page_ = "content\n";
  TcpClient quick(server_->port());
  ASSERT_TRUE(quick.send("GET /page HTTP/1.1\r\nHost: x\r\n\r\n"));
  EXPECT_THAT(receive(quick), HasSubstr("content"));
  TcpClient refused(server_->port());
  EXPECT_EQ(receive(refused), "");
  EXPECT_TRUE(refused.ended());
  EXPECT_EQ(server_->counters().refused, 1U);
  // One leaves, another one takes its place.
  slow.back()->close();
  loop_.poll();
  EXPECT_THAT(answer_to("GET /page HTTP/1.1\r\nHost: x\r\n\r\n"), HasSubstr("content"));
}

TEST_F(WebServerTest, MayBeDestroyedWithClients) {
  TcpClient client(server_->port());
  ASSERT_TRUE(client.send("GET /pa"));
  loop_.poll();
  server_.reset();
  loop_.poll();
  client.receive();
  EXPECT_TRUE(client.ended());
}

}  // namespace
}  // namespace groma::daemon
