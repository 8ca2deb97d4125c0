#include "host/daemon/web_settings.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <string>

#include "host/io/error.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using groma::test::TemporaryFolder;
using ::testing::HasSubstr;

class WebSettingsFile : public ::testing::Test {
 protected:
  WebSettings parse(const std::string& text) {
    io::InputFiles files;
    const auto yaml = io::YamlValue::parse(folder_ / "gromad.yaml", "web: " + text);
    const io::YamlValue web = yaml.at("web");
    for (const io::ConfigError& error : web_type().errors_of(web)) throw error;
    return parse_web(web, folder_.path(), files);
  }
  std::string error_of(const std::string& text) {
    try {
      static_cast<void>(parse(text));
    } catch (const io::Error& error) {
      return error.what();
    }
    return "no error";
  }
  std::string secret_error(const std::string& token, std::filesystem::perms permissions) {
    const std::filesystem::path path = folder_.write("token", token);
    std::filesystem::permissions(path, permissions);
    try {
      static_cast<void>(read_secrets(parse("{token_file: token}")));
    } catch (const io::Error& error) {
      return error.what();
    }
    return "no error";
  }

  TemporaryFolder folder_;
};

TEST_F(WebSettingsFile, HasDefaults) {
  const WebSettings web = parse("{}");
  EXPECT_EQ(web.endpoint.address, "127.0.0.1");
  EXPECT_EQ(web.endpoint.port, 4722);
  EXPECT_TRUE(web.hosts.empty());
  EXPECT_FALSE(web.token_file);
  EXPECT_FALSE(web.tls);
  const WebSecrets secrets = read_secrets(web);
  EXPECT_EQ(secrets.access.token, "");
  EXPECT_FALSE(secrets.tls);
}

TEST_F(WebSettingsFile, HasAllKeys) {
  folder_.write("walls.csv", "x0_m,y0_m,x1_m,y1_m\n0,1,2,3\n-1,0,0.5,4\n");
  const WebSettings web = parse(
      "{address: 0.0.0.0, port: 80, hosts: [Robot7.example], origins: ['https://Viewer.example:8080'], "
      "token_file: token, tls: {certificate: c.pem, key: k.pem}, walls: walls.csv, simulated: true}");
  EXPECT_EQ(web.endpoint.address, "0.0.0.0");
  EXPECT_EQ(web.endpoint.port, 80);
  EXPECT_EQ(web.hosts, std::vector<std::string>{"robot7.example"});
  EXPECT_EQ(web.origins, std::vector<std::string>{"https://viewer.example:8080"});
  EXPECT_EQ(web.token_file, folder_ / "token");
  ASSERT_TRUE(web.tls);
  EXPECT_EQ(web.tls->certificate, folder_ / "c.pem");
  EXPECT_EQ(web.tls->key, folder_ / "k.pem");
  ASSERT_EQ(web.walls.size(), 2U);
  EXPECT_EQ(web.walls[1].to_m, Eigen::Vector2d(0.5, 4.0));
  EXPECT_TRUE(web.is_simulated);
}

TEST_F(WebSettingsFile, ServesOtherComputersOnlyWithTokenAndTls) {
  for (const char* text : {"{address: 0.0.0.0}", "{address: 192.168.1.7, token_file: t}",
                           "{address: '::', tls: {certificate: c, key: k}}"}) {
    EXPECT_THAT(error_of(text),
                HasSubstr("web.address is reached from other computers; give 'token_file' and 'tls'"))
        << text;
  }
  EXPECT_EQ(error_of("{address: 127.0.0.2}"), "no error");
  EXPECT_EQ(error_of("{address: '::1'}"), "no error");
}

TEST_F(WebSettingsFile, RefusesWhatIsWrong) {
  EXPECT_THAT(error_of("{address: localhost}"), HasSubstr("web.address"));
  EXPECT_THAT(error_of("{prot: 80}"), HasSubstr("prot"));
  EXPECT_THAT(error_of("{hosts: ['http://robot7']}"), HasSubstr("is no name of a host"));
  EXPECT_THAT(error_of("{origins: [viewer.example]}"), HasSubstr("is no origin"));
  EXPECT_THAT(error_of("{origins: ['https://viewer.example/path']}"), HasSubstr("is no origin"));
  EXPECT_THAT(error_of("{tls: {certificate: c}}"), HasSubstr("key"));
  EXPECT_THAT(error_of("{walls: none.csv}"), HasSubstr("none.csv"));
  folder_.write("walls.csv", "x0_m,y0_m,x1_m,y1_m\n0,1,2\n");
  EXPECT_THAT(error_of("{walls: walls.csv}"), HasSubstr("walls.csv:2"));
}

TEST_F(WebSettingsFile, ReadsSecretsThatAreSecret) {
  constexpr auto kOwner = std::filesystem::perms::owner_read;
  EXPECT_EQ(secret_error("0123456789abcdef\n", kOwner), "no error");
  EXPECT_THAT(secret_error("0123456789abcdef\n", kOwner | std::filesystem::perms::group_read),
              HasSubstr("may be read or written by other users; run 'chmod 600'"));
  EXPECT_THAT(secret_error("0123456789abcde", kOwner), HasSubstr("holds no token of at least 16"));
  EXPECT_THAT(secret_error("0123456789 abcdef", kOwner), HasSubstr("holds no token"));
  EXPECT_THAT(secret_error("0123456789abcde\xc3\xa4", kOwner), HasSubstr("holds no token"));
  std::filesystem::remove(folder_ / "token");
  EXPECT_THROW(static_cast<void>(read_secrets(parse("{token_file: token}"))), io::DataError);
}

}  // namespace
}  // namespace groma::daemon
