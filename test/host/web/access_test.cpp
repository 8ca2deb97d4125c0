#include "host/web/access.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

namespace groma::web {
namespace {

Access access_of(const std::string& host, std::optional<std::string_view> origin = {},
                 const AccessRules& rules = {}) {
  return judge(rules, {.host = host, .origin = origin, .authorization = {}, .cookie = {}, .query = {}});
}

TEST(Access, IsForNumericAddressesAndLocalhost) {
  for (const char* host : {"127.0.0.1:4722", "127.0.0.1", "localhost:4722", "LocalHost", "[::1]:4722",
                           "[::1]", "192.168.1.7:4722"}) {
    EXPECT_EQ(access_of(host), Access::kGranted) << host;
  }
}

// DNS rebinding: a name of another domain that resolves to this computer.
TEST(Access, IsNotForOtherNames) {
  for (const char* host :
       {"", "evil.example", "evil.example:4722", "localhost.evil.example", "127.0.0.1.evil.example",
        "127.0.0.1.", "robot7", "[::1", "]", "[evil.example]:4722", ":4722", "127.0.0.1@evil"}) {
    EXPECT_EQ(access_of(host), Access::kWrongHost) << host;
  }
  const AccessRules rules{.hosts = {"robot7.example"}, .origins = {}, .token = {}};
  EXPECT_EQ(access_of("Robot7.example:443", {}, rules), Access::kGranted);
  EXPECT_EQ(access_of("robot8.example", {}, rules), Access::kWrongHost);
}

TEST(Access, IsForPagesOfTheServerItself) {
  EXPECT_EQ(access_of("127.0.0.1:4722", "http://127.0.0.1:4722"), Access::kGranted);
  EXPECT_EQ(access_of("127.0.0.1:4722", "https://127.0.0.1:4722"), Access::kGranted);
  for (const char* origin : {"", "null", "http://evil.example", "http://127.0.0.1", "http://127.0.0.1:4723",
                             "http://localhost:4722", "file://", "http://127.0.0.1:4722.evil.example"}) {
    EXPECT_EQ(access_of("127.0.0.1:4722", origin), Access::kWrongOrigin) << origin;
  }
  const AccessRules rules{.hosts = {}, .origins = {"https://viewer.example"}, .token = {}};
  EXPECT_EQ(access_of("127.0.0.1:4722", "https://Viewer.example", rules), Access::kGranted);
  EXPECT_EQ(access_of("127.0.0.1:4722", "http://viewer.example", rules), Access::kWrongOrigin);
}

TEST(Access, NeedsTheTokenWhereThereIsOne) {
  const AccessRules rules{.hosts = {}, .origins = {}, .token = "0123456789abcdef"};
  const auto with = [&](std::string_view authorization, std::string_view cookie, std::string_view query) {
    return judge(rules, {.host = "localhost",
                         .origin = {},
                         .authorization = authorization,
                         .cookie = cookie,
                         .query = query});
  };
  EXPECT_EQ(with("", "", ""), Access::kNoToken);
  EXPECT_EQ(with("Bearer 0123456789abcdef", "", ""), Access::kGranted);
  EXPECT_EQ(with("", "a=b; groma_token=0123456789abcdef", ""), Access::kGranted);
  EXPECT_EQ(with("", "", "x=1&token=0123456789abcdef"), Access::kGranted);
  for (const char* wrong : {"0123456789abcde", "0123456789abcdeF", "0123456789abcdef0", ""}) {
    const std::string token = wrong;
    EXPECT_EQ(with("Bearer " + token, "groma_token=" + token, "token=" + token), Access::kNoToken) << token;
  }
  EXPECT_EQ(with("0123456789abcdef", "xgroma_token=0123456789abcdef", "atoken=0123456789abcdef&token"),
            Access::kNoToken);
  EXPECT_TRUE(has_token_in_query(rules, "token=0123456789abcdef"));
  EXPECT_FALSE(has_token_in_query(rules, "token=0"));
  EXPECT_FALSE(has_token_in_query({}, "token="));
}

TEST(Access, SaysWhatToDo) {
  for (const Access access : {Access::kWrongHost, Access::kWrongOrigin, Access::kNoToken})
    EXPECT_FALSE(explain(access).empty());
  EXPECT_THAT(std::string(explain(Access::kNoToken)), ::testing::HasSubstr("token_file"));
}

}  // namespace
}  // namespace groma::web
