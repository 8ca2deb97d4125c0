#include "host/web/access.hpp"

#include <arpa/inet.h>
#include <openssl/crypto.h>

#include <algorithm>

namespace groma::web {
namespace {

constexpr std::string_view kBearer = "Bearer ";

// The host of HOST[:PORT], without the brackets of an IPv6 address.
std::string host_of(std::string_view authority) {
  if (!authority.empty() && authority.front() == '[') {
    const std::size_t end = authority.find(']');
    return end == std::string_view::npos ? std::string() : std::string(authority.substr(1, end - 1));
  }
  return lower_case(authority.substr(0, authority.rfind(':')));
}

bool is_own_host(const AccessRules& rules, std::string_view authority) {
  const std::string host = host_of(authority);
  return host == "localhost" || is_numeric_address(host) ||
         std::find(rules.hosts.begin(), rules.hosts.end(), host) != rules.hosts.end();
}

bool is_own_origin(const AccessRules& rules, std::string_view origin, std::string_view host) {
  const std::string text = lower_case(origin);
  if (std::find(rules.origins.begin(), rules.origins.end(), text) != rules.origins.end()) return true;
  // A proxy with TLS in front of the server changes the scheme only.
  const std::string own = lower_case(host);
  return text == "http://" + own || text == "https://" + own;
}

bool is_token(const AccessRules& rules, std::string_view text) {
  return text.size() == rules.token.size() &&
         CRYPTO_memcmp(text.data(), rules.token.data(), text.size()) == 0;
}

// Whether one of the NAME=VALUE pairs between separators is the token under that name.
bool has_token(const AccessRules& rules, std::string_view pairs, char separator, std::string_view name) {
  while (!pairs.empty()) {
    const std::size_t end = std::min(pairs.find(separator), pairs.size());
    std::string_view pair = pairs.substr(0, end);
    pairs.remove_prefix(std::min(end + 1, pairs.size()));
    while (!pair.empty() && pair.front() == ' ') pair.remove_prefix(1);
    const std::size_t equals = pair.find('=');
    if (pair.substr(0, equals) == name && equals != std::string_view::npos &&
        is_token(rules, pair.substr(equals + 1))) {
      return true;
    }
  }
  return false;
}

}  // namespace

bool is_numeric_address(const std::string& text) {
  in6_addr ignored{};
  return ::inet_pton(AF_INET, text.c_str(), &ignored) == 1 ||
         ::inet_pton(AF_INET6, text.c_str(), &ignored) == 1;
}

std::string lower_case(std::string_view text) {
  std::string out(text);
  std::transform(out.begin(), out.end(), out.begin(),
                 [](char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; });
  return out;
}

bool has_token_in_query(const AccessRules& rules, std::string_view query) {
  return !rules.token.empty() && has_token(rules, query, '&', "token");
}

Access judge(const AccessRules& rules, const Sender& sender) {
  if (!is_own_host(rules, sender.host)) return Access::kWrongHost;
  if (sender.origin && !is_own_origin(rules, *sender.origin, sender.host)) return Access::kWrongOrigin;
  if (rules.token.empty() || has_token_in_query(rules, sender.query) ||
      has_token(rules, sender.cookie, ';', kTokenCookie)) {
    return Access::kGranted;
  }
  const bool is_bearer = sender.authorization.substr(0, kBearer.size()) == kBearer &&
                         is_token(rules, sender.authorization.substr(kBearer.size()));
  return is_bearer ? Access::kGranted : Access::kNoToken;
}

std::string_view explain(Access access) {
  switch (access) {
    case Access::kWrongHost:
      return "this name is none of gromad's: use its numeric address, or add the name to 'hosts' of the key "
             "'web'\n";
    case Access::kWrongOrigin:
      return "a page of another origin asks: add its origin to 'origins' of the key 'web' if you trust it\n";
    case Access::kNoToken:
      return "the token is missing or wrong: open /?token=TOKEN with the content of 'token_file', or send "
             "'Authorization: Bearer TOKEN'\n";
    default:
      return {};
  }
}

}  // namespace groma::web
