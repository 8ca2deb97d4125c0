// Who may use the web server. Any page in a browser may send requests to this computer: what it may not do is
// choose their Host and Origin, or know the token.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace groma::web {

struct AccessRules {
  // Names of this computer that Host may have, beside numeric addresses and localhost. A name of another
  // domain may resolve to this computer (DNS rebinding).
  std::vector<std::string> hosts;
  // Origins beside that of the server's own pages, such as https://viewer.example.
  std::vector<std::string> origins;
  std::string token;  // empty: none is needed
};

// What a request says of its sender; empty: it does not.
struct Sender {
  std::string_view host;
  std::optional<std::string_view> origin;
  std::string_view authorization;  // "Bearer TOKEN"
  std::string_view cookie;
  std::string_view query;  // without "?"
};

enum class Access { kGranted, kWrongHost, kWrongOrigin, kNoToken };

// Without DNS: of the texts alone. The token may be in Authorization, the cookie or the query; it is compared
// in a time that does not depend on it.
[[nodiscard]] Access judge(const AccessRules& rules, const Sender& sender);

// Why access is not granted, and what to do, as the body of an answer.
[[nodiscard]] std::string_view explain(Access access);

// Whether the query has the token, so that the browser is given a cookie instead.
[[nodiscard]] bool has_token_in_query(const AccessRules& rules, std::string_view query);

// Whether the text is an IPv4 or IPv6 address.
[[nodiscard]] bool is_numeric_address(const std::string& text);
// ASCII letters in lower case, as names of hosts are compared.
[[nodiscard]] std::string lower_case(std::string_view text);

// The name of the cookie that holds the token.
inline constexpr std::string_view kTokenCookie = "groma_token";

}  // namespace groma::web
