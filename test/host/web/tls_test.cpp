// The same server over TLS, with a client of OpenSSL and a certificate of the test's own.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <openssl/x509.h>

#include <atomic>
#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <boost/asio/io_context.hpp>

#include "host/web/server.hpp"
#include "test/host/web/listener.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::web {
namespace {

using ::testing::EndsWith;
using ::testing::HasSubstr;
using ::testing::StartsWith;

template <typename Object, void (*kFree)(Object*)>
struct Freed {
  void operator()(Object* object) const { kFree(object); }
};
using Key = std::unique_ptr<EVP_PKEY, Freed<EVP_PKEY, EVP_PKEY_free>>;
using Certificate = std::unique_ptr<X509, Freed<X509, X509_free>>;
using Context = std::unique_ptr<SSL_CTX, Freed<SSL_CTX, SSL_CTX_free>>;
using Session = std::unique_ptr<SSL, Freed<SSL, SSL_free>>;

std::string text_of(BIO* bio) {
  char* data = nullptr;
  const long size = BIO_get_mem_data(bio, &data);
  std::string out(data, static_cast<std::size_t>(size));
  BIO_free(bio);
  return out;
}

TlsTexts self_signed(EVP_PKEY* made = EVP_EC_gen("P-256")) {
  const Key key(made);
  const Certificate certificate(X509_new());
  ASN1_INTEGER_set(X509_get_serialNumber(certificate.get()), 1);
  X509_gmtime_adj(X509_getm_notBefore(certificate.get()), 0);
  X509_gmtime_adj(X509_getm_notAfter(certificate.get()), 3600);
  X509_set_pubkey(certificate.get(), key.get());
  X509_sign(certificate.get(), key.get(), EVP_sha256());
  BIO* const certificate_bio = BIO_new(BIO_s_mem());
  PEM_write_bio_X509(certificate_bio, certificate.get());
  BIO* const key_bio = BIO_new(BIO_s_mem());
  PEM_write_bio_PrivateKey(key_bio, key.get(), nullptr, nullptr, 0, nullptr, nullptr);
  return {text_of(certificate_bio), text_of(key_bio)};
}

// What a client that trusts any certificate receives for the request; empty: no handshake.
std::string ask(std::uint16_t port, const std::string& request, int version) {
  const groma::test::TcpClient tcp(port);
  const Context context(SSL_CTX_new(TLS_client_method()));
  SSL_CTX_set_security_level(context.get(), 0);  // else OpenSSL itself refuses old versions
  SSL_CTX_set_min_proto_version(context.get(), version);
  SSL_CTX_set_max_proto_version(context.get(), version);
  const Session session(SSL_new(context.get()));
  SSL_set_fd(session.get(), tcp.fd());
  std::string out;
  if (SSL_connect(session.get()) == 1) {
    SSL_write(session.get(), request.data(), static_cast<int>(request.size()));
    char buffer[16384];
    for (int n = 0; (n = SSL_read(session.get(), buffer, sizeof buffer)) > 0;)
      out.append(buffer, static_cast<std::size_t>(n));
  }
  ERR_clear_error();
  return out;
}

class TlsTest : public ::testing::Test {
 protected:
  TlsTest() {
    server_.serve("/", Server::Page{"text/html", [this] { return std::string_view(page_); }});
    serving_ = std::thread([this] {
      while (!ends_) {
        for (io::Descriptor client; (client = listener_.accept()).valid();) server_.add(std::move(client));
        context_.restart();
        context_.poll();
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
      }
    });
  }
  ~TlsTest() override { stop(); }
  void stop() {
    ends_ = true;
    if (serving_.joinable()) serving_.join();
  }

  std::string page_ = std::string(300'000, 'x');
  boost::asio::io_context context_;
  test::Listener listener_;
  Server server_{context_, AccessRules{.hosts = {}, .origins = {}, .token = "0123456789abcdef"},
                 self_signed()};
  std::atomic<bool> ends_ = false;
  std::thread serving_;
};

TEST_F(TlsTest, ServesPages) {
  const std::string request =
      "GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nAuthorization: Bearer "
      "0123456789abcdef\r\n\r\n";
  for (const int version : {TLS1_2_VERSION, TLS1_3_VERSION}) {
    const std::string answer = ask(listener_.port(), request, version);
    EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
    EXPECT_THAT(answer, EndsWith("\r\n\r\n" + page_));
  }
  EXPECT_EQ(ask(listener_.port(), request, TLS1_1_VERSION), "");
}

TEST_F(TlsTest, GivesACookieThatIsForTlsOnly) {
  const std::string answer =
      ask(listener_.port(),
          "GET /?token=0123456789abcdef HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n",
          TLS1_3_VERSION);
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 303 "));
  EXPECT_THAT(answer, HasSubstr("; HttpOnly; SameSite=Lax; Secure\r\n"));
}

TEST_F(TlsTest, AnswersNothingInPlainText) {
  groma::test::TcpClient client(listener_.port());
  client.send("GET / HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer 0123456789abcdef\r\n\r\n");
  std::string answer;
  for (int i = 0; i < 50 && !client.ended(); ++i) answer += client.await(std::chrono::milliseconds(20));
  EXPECT_TRUE(client.ended());
  EXPECT_THAT(answer, ::testing::Not(HasSubstr("HTTP/1.1 2")));
}

// A few handshakes at once, then 20 a second: a flood of them delays no pose for long.
TEST_F(TlsTest, SpreadsHandshakes) {
  const auto begin = std::chrono::steady_clock::now();
  constexpr int kClients = 18;
  std::vector<std::thread> clients;
  clients.reserve(kClients);
  std::atomic<int> served = 0;
  for (int i = 0; i < kClients; ++i) {
    clients.emplace_back([&] {
      if (!ask(listener_.port(), "GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n",
               TLS1_3_VERSION)
               .empty()) {
        ++served;
      }
    });
  }
  for (std::thread& client : clients) client.join();
  EXPECT_EQ(served, kClients);
  EXPECT_GT(std::chrono::steady_clock::now() - begin, std::chrono::milliseconds(400));
}

TEST(Tls, NeedsACertificateWithItsKey) {
  boost::asio::io_context context;
  TlsTexts texts = self_signed();
  EXPECT_NO_THROW(Server(context, {}, texts));
  EXPECT_EQ(fault_of(texts), "");
  // Another key, one of another kind, and none.
  constexpr unsigned kBits = 2048;
  for (const std::string& other :
       {self_signed().key_pem, self_signed(EVP_RSA_gen(kBits)).key_pem, std::string()}) {
    texts.key_pem = other;
    EXPECT_THROW(Server(context, {}, texts), std::runtime_error);
    EXPECT_NE(fault_of(texts), "");
  }
  EXPECT_NE(fault_of({"nothing", self_signed().key_pem}), "");
}

}  // namespace
}  // namespace groma::web
