#include "host/web/server.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <chrono>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <boost/asio/io_context.hpp>

#include "test/host/web/listener.hpp"
#include "test/host/web/web_socket.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::web {
namespace {

using groma::test::TcpClient;
using test::Listener;
using test::WebSocketClient;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

constexpr std::size_t kLargePage = 8'000'000;

// A service that notes what happens, and sends what a test gives it.
class Service : public SocketService {
 public:
  void on_open(Socket& socket) override { open.push_back(&socket); }
  void on_close(Socket& socket) override {
    std::erase(open, &socket);
    ++closed;
  }
  bool on_text(Socket& /*socket*/, std::string_view text) override {
    texts.emplace_back(text);
    return text != "nonsense";
  }
  void on_drained(Socket& socket) override {
    if (on_drain) on_drain(socket);
  }

  std::vector<Socket*> open;
  std::vector<std::string> texts;
  int closed = 0;
  std::function<void(Socket&)> on_drain;
};

Socket::Message text(std::string content) {
  return std::make_shared<const std::string>(std::move(content));
}

class WebServerTest : public ::testing::Test {
 protected:
  WebServerTest() { start({}); }

  void start(const AccessRules& rules, const std::optional<TlsTexts>& tls = {}) {
    server_ = std::make_unique<Server>(context_, rules, tls);
    server_->serve("/page",
                   Server::Page{"text/plain; charset=utf-8", [this] { return std::string_view(page_); }});
    server_->serve("/", Server::Page{"text/html", [] { return "page"; }});
    server_->serve("/live", {.service = &service_, .subprotocols = {"one", "two"}});
    server_->serve("/strict", {.service = &service_, .subprotocols = {"one"}, .needs_subprotocol = true});
  }
  void serve() {
    for (io::Descriptor client; (client = listener_.accept()).valid();) server_->add(std::move(client));
    context_.restart();
    context_.poll();
  }
  [[nodiscard]] std::uint16_t port() const { return listener_.port(); }

  // What the server sends until it has nothing more to do.
  std::string receive(TcpClient& client) {
    std::string text;
    for (std::size_t before = 1; before != text.size();) {
      before = text.size();
      serve();
      text += client.receive();
    }
    return text;
  }
  std::string answer_to(const std::string& request) {
    TcpClient client(port());
    serve();
    EXPECT_TRUE(client.send(request));
    return receive(client);
  }
  [[nodiscard]] std::unique_ptr<WebSocketClient> client(int receive_buffer = 0) {
    return std::make_unique<WebSocketClient>(
        port(), [this] { serve(); }, receive_buffer);
  }

  boost::asio::io_context context_;
  Listener listener_;
  std::string page_ = "content\n";
  Service service_;
  std::unique_ptr<Server> server_;
};

TEST_F(WebServerTest, ServesItsPages) {
  TcpClient client(port());
  for (int i = 0; i < 3; ++i) {
    page_ = "content " + std::to_string(i) + "\n";
    ASSERT_TRUE(client.send("GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n"));
    const std::string answer = receive(client);
    EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
    EXPECT_THAT(answer, HasSubstr("\r\nContent-Type: text/plain; charset=utf-8\r\n"));
    EXPECT_THAT(answer, HasSubstr("\r\nContent-Length: 10\r\n"));
    EXPECT_THAT(answer, ::testing::EndsWith("\r\n\r\n" + page_));
    EXPECT_FALSE(client.ended());
  }
  EXPECT_EQ(server_->counters().accepted, 1U);
  EXPECT_EQ(server_->counters().requests, 3U);
  EXPECT_THAT(answer_to("GET /page?a=b HTTP/1.1\r\nHost: localhost\r\n\r\n"),
              StartsWith("HTTP/1.1 200 OK\r\n"));
}

TEST_F(WebServerTest, AnswersHeadWithoutTheContent) {
  const std::string answer = answer_to("HEAD /page HTTP/1.1\r\nHost: localhost\r\n\r\n");
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
  EXPECT_THAT(answer, HasSubstr("\r\nContent-Length: 8\r\n"));
  EXPECT_THAT(answer, ::testing::EndsWith("\r\n\r\n"));
}

TEST_F(WebServerTest, RefusesWhatItDoesNotServe) {
  for (const std::string path :
       {"/other", "/foxglove", "/page/", "/pag", "//page", "*", "/../page", "/%70age"}) {
    EXPECT_THAT(answer_to("GET " + path + " HTTP/1.1\r\nHost: localhost\r\n\r\n"),
                StartsWith("HTTP/1.1 404 "))
        << path;
  }
  const std::string post = answer_to("POST /page HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n");
  EXPECT_THAT(post, StartsWith("HTTP/1.1 405 "));
  EXPECT_THAT(post, HasSubstr("\r\nAllow: GET, HEAD\r\n"));
  for (const std::string& wrong :
       {std::string("hello\r\n\r\n"), std::string("GET /page\r\n\r\n"), std::string(100, '\0') + "\r\n\r\n",
        std::string("GET /page HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello"),
        "GET /page HTTP/1.1\r\nHost: " + std::string(Server::kMaxRequest, 'x') + "\r\n\r\n"}) {
    EXPECT_THAT(answer_to(wrong), StartsWith("HTTP/1.1 400 ")) << wrong.substr(0, 40);
  }
  EXPECT_THAT(answer_to("GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n"), StartsWith("HTTP/1.1 200 "));
}

TEST_F(WebServerTest, EndsAConnectionAsTheClientAsks) {
  TcpClient client(port());
  ASSERT_TRUE(client.send("GET /page HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"));
  EXPECT_THAT(receive(client), HasSubstr("content"));
  EXPECT_TRUE(client.ended());
}

// Clients that say nothing lose their places to new ones; those that never read an answer do not.
TEST_F(WebServerTest, DoesNotWaitForSlowClients) {
  page_ = std::string(kLargePage, 'x');
  std::vector<std::unique_ptr<TcpClient>> slow;
  for (std::size_t i = 0; i < Server::kMaxClients; ++i) {
    slow.push_back(std::make_unique<TcpClient>(port(), 4096));
    if (i % 2 == 0) {
      ASSERT_TRUE(slow.back()->send("GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n"));
    }
    serve();
  }
  page_ = "content\n";
  TcpClient quick(port());
  ASSERT_TRUE(quick.send("GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n"));
  EXPECT_THAT(receive(quick), HasSubstr("content"));
  slow[1]->receive();
  EXPECT_TRUE(slow[1]->ended());  // the silent one that came first
  slow[3]->receive();
  EXPECT_FALSE(slow[3]->ended());
  EXPECT_LE(server_->clients(), Server::kMaxClients);

  // All places are busy: a new one is refused.
  page_ = std::string(kLargePage, 'x');
  for (std::size_t i = 0; i < Server::kMaxClients; ++i) {
    slow.push_back(std::make_unique<TcpClient>(port(), 4096));
    ASSERT_TRUE(slow.back()->send("GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n"));
    serve();
  }
  TcpClient refused(port());
  EXPECT_EQ(receive(refused), "");
  EXPECT_TRUE(refused.ended());
  EXPECT_GE(server_->counters().refused, 1U);
}

TEST_F(WebServerTest, RefusesOtherNamesAndOrigins) {
  EXPECT_THAT(answer_to("GET /page HTTP/1.1\r\nHost: evil.example\r\n\r\n"), StartsWith("HTTP/1.1 403 "));
  EXPECT_THAT(answer_to("GET /page HTTP/1.0\r\n\r\n"), StartsWith("HTTP/1.1 403 "));
  const std::string other =
      answer_to("GET /page HTTP/1.1\r\nHost: localhost\r\nOrigin: http://evil.example\r\n\r\n");
  EXPECT_THAT(other, StartsWith("HTTP/1.1 403 "));
  EXPECT_THAT(other, Not(HasSubstr("content")));
  EXPECT_THAT(client()->open("/live", "Origin: http://evil.example\r\n"), StartsWith("HTTP/1.1 403 "));
  EXPECT_THAT(client()->open("/live", "", "evil.example"), StartsWith("HTTP/1.1 403 "));
  EXPECT_TRUE(service_.open.empty());
  EXPECT_EQ(server_->counters().forbidden, 5U);
}

TEST_F(WebServerTest, ExchangesATokenForACookie) {
  const std::string token = "0123456789abcdef";
  start({.hosts = {}, .origins = {}, .token = token});
  EXPECT_THAT(answer_to("GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n"), StartsWith("HTTP/1.1 401 "));
  EXPECT_THAT(client()->open("/live"), StartsWith("HTTP/1.1 401 "));
  const std::string answer = answer_to("GET /?token=" + token + " HTTP/1.1\r\nHost: localhost\r\n\r\n");
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 303 "));
  EXPECT_THAT(answer, HasSubstr("\r\nLocation: /\r\n"));
  EXPECT_THAT(answer, HasSubstr("\r\nSet-Cookie: groma_token=" + token +
                                "; Path=/; Max-Age=31536000; HttpOnly; SameSite=Lax\r\n"));
  EXPECT_THAT(answer_to("GET / HTTP/1.1\r\nHost: localhost\r\nCookie: groma_token=" + token + "\r\n\r\n"),
              StartsWith("HTTP/1.1 200 "));
  EXPECT_THAT(client()->open("/live", "Cookie: groma_token=" + token + "\r\n"), StartsWith("HTTP/1.1 101 "));
  EXPECT_THAT(client()->open("/live?token=" + token), StartsWith("HTTP/1.1 101 "));
}

TEST_F(WebServerTest, OpensWebSockets) {
  const auto socket = client();
  const std::string answer = socket->open("/live", "Sec-WebSocket-Protocol: three, two, one\r\n");
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 101 "));
  EXPECT_THAT(answer, HasSubstr("Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n"));  // RFC 6455, 1.3
  EXPECT_THAT(answer, HasSubstr("Sec-WebSocket-Protocol: two\r\n"));
  ASSERT_EQ(service_.open.size(), 1U);
  service_.open[0]->send(text("hello"), Socket::Kind::kText);
  service_.open[0]->send(text(std::string(70'000, 'x')), Socket::Kind::kBinary);
  const auto first = socket->next();
  ASSERT_TRUE(first);
  EXPECT_EQ(first->opcode, WebSocketClient::kText);
  EXPECT_EQ(first->payload, "hello");
  const auto second = socket->next();
  ASSERT_TRUE(second);
  EXPECT_EQ(second->opcode, WebSocketClient::kBinary);
  EXPECT_EQ(second->payload.size(), 70'000U);
  socket->send(WebSocketClient::kText, "question");
  socket->send(WebSocketClient::kText, "nonsense");
  socket->send(WebSocketClient::kBinary, "binary");
  socket->send(WebSocketClient::kPing, "alive?");
  const auto pong = socket->next();
  ASSERT_TRUE(pong);
  EXPECT_EQ(pong->opcode, WebSocketClient::kPong);
  EXPECT_EQ(service_.texts, (std::vector<std::string>{"question", "nonsense"}));
  EXPECT_EQ(server_->counters().ignored, 2U);
  socket->send(WebSocketClient::kClose, std::string("\x03\xe8", 2));
  EXPECT_EQ(socket->next()->opcode, WebSocketClient::kClose);
  socket->close();
  for (int i = 0; i < 10; ++i) serve();
  EXPECT_TRUE(service_.open.empty());
  EXPECT_EQ(service_.closed, 1);
  EXPECT_EQ(server_->sockets(), 0U);
}

TEST_F(WebServerTest, RefusesWebSocketsThatItCannotServe) {
  EXPECT_THAT(client()->open("/page"), StartsWith("HTTP/1.1 200 "));  // a page to whoever asks
  EXPECT_THAT(client()->open("/strict"), StartsWith("HTTP/1.1 400 "));
  EXPECT_THAT(client()->open("/strict", "Sec-WebSocket-Protocol: two\r\n"), StartsWith("HTTP/1.1 400 "));
  EXPECT_THAT(client()->open("/strict", "Sec-WebSocket-Protocol: two, one\r\n"), StartsWith("HTTP/1.1 101 "));
  EXPECT_THAT(client()->open("/live"), StartsWith("HTTP/1.1 101 "));
  EXPECT_THAT(answer_to("GET /live HTTP/1.1\r\nHost: localhost\r\n\r\n"), StartsWith("HTTP/1.1 426 "));
  std::vector<std::unique_ptr<WebSocketClient>> all;
  while (server_->sockets() < Server::kMaxSockets) {
    all.push_back(client());
    ASSERT_THAT(all.back()->open("/live"), StartsWith("HTTP/1.1 101 "));
  }
  EXPECT_THAT(client()->open("/live"), StartsWith("HTTP/1.1 503 "));
}

// A frame of 1 GiB that is announced ends the connection before anything of it is kept.
TEST_F(WebServerTest, EndsAConnectionWithAFrameThatIsTooLong) {
  for (const std::uint64_t announced : {std::uint64_t{Server::kMaxMessage + 1}, std::uint64_t{1} << 30U,
                                        std::uint64_t{1} << 62U, ~std::uint64_t{0}}) {
    const auto socket = client();
    ASSERT_THAT(socket->open("/live"), StartsWith("HTTP/1.1 101 "));
    socket->send(WebSocketClient::kText, std::string(2000, 'x'), announced);
    for (int i = 0; i < 20; ++i) socket->poll();
    EXPECT_TRUE(service_.open.empty()) << announced;
    EXPECT_TRUE(service_.texts.empty());
  }
}

TEST_F(WebServerTest, LeavesOutMessagesOfASlowReader) {
  const auto socket = client(4096);
  ASSERT_THAT(socket->open("/live"), StartsWith("HTTP/1.1 101 "));
  Socket& to = *service_.open.at(0);
  const Socket::Message message = text(std::string(10'000, 'x'));
  int sent = 0;
  for (int i = 0; i < 1000; ++i) {
    sent += to.send(message, Socket::Kind::kText) ? 1 : 0;
    context_.restart();
    context_.poll();
  }
  EXPECT_LT(sent, 300);
  EXPECT_LE(to.waiting_bytes(), Socket::kMaxWaiting);
  EXPECT_EQ(server_->counters().left_out, 1000U - static_cast<unsigned>(sent));
  // It reads again: all that was not left out arrives, and the service is notified once.
  int drained = 0;
  service_.on_drain = [&](Socket& /*socket*/) { ++drained; };
  int received = 0;
  while (socket->next(500)) ++received;
  EXPECT_EQ(received, sent);
  EXPECT_EQ(drained, 1);
}

// It ends its sending side and does not read: what waits for it ends with it.
TEST_F(WebServerTest, EndsAHalfClosedWebSocket) {
  const auto socket = client(4096);
  ASSERT_THAT(socket->open("/live"), StartsWith("HTTP/1.1 101 "));
  for (int i = 0; i < 50; ++i) service_.open.at(0)->send(text(std::string(10'000, 'x')), Socket::Kind::kText);
  serve();
  socket->end_sending();
  for (int i = 0; i < 50 && server_->sockets() > 0; ++i) {
    serve();
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  EXPECT_EQ(server_->sockets(), 0U);
  EXPECT_EQ(service_.closed, 1);
}

TEST_F(WebServerTest, RefusesACertificateThatIsNone) {
  EXPECT_THROW(start({}, TlsTexts{"nothing", "nothing"}), std::runtime_error);
  EXPECT_THROW(start({}, TlsTexts{"", ""}), std::runtime_error);
}

TEST_F(WebServerTest, MayBeDestroyedWithClients) {
  TcpClient http(port());
  ASSERT_TRUE(http.send("GET /pa"));
  const auto socket = client();
  ASSERT_THAT(socket->open("/live"), StartsWith("HTTP/1.1 101 "));
  service_.open.at(0)->send(text("last words"), Socket::Kind::kText);
  server_.reset();
  EXPECT_EQ(service_.closed, 1);
  context_.restart();
  context_.poll();
  http.receive();
  EXPECT_TRUE(http.ended());
}

}  // namespace
}  // namespace groma::web
