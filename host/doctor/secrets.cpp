// Removes secrets from a text.
#include <algorithm>
#include <array>
#include <cctype>
#include <string>
#include <string_view>

#include "host/doctor/bug_report.hpp"

namespace groma::doctor {
namespace {

constexpr std::string_view kRemoved = "[removed]";
constexpr std::size_t kHexDigits = 32;  // of a key of 128 bits
constexpr std::array<std::string_view, 6> kSecretWords{"key",      "token",      "secret",
                                                       "password", "passphrase", "credential"};

bool is_word(char c) {
  return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_' || c == '-';
}
bool is_hex(char c) {
  return std::isxdigit(static_cast<unsigned char>(c)) != 0;
}

std::string in_lower_case(std::string_view text) {
  std::string out(text);
  std::transform(out.begin(), out.end(), out.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return out;
}

bool is_secret_name(std::string_view name) {
  const std::string lower = in_lower_case(name);
  if (lower.ends_with("_file")) return false;
  return std::any_of(kSecretWords.begin(), kSecretWords.end(),
                     [&](std::string_view word) { return lower.find(word) != std::string::npos; });
}

std::size_t indentation(std::string_view line) {
  return std::min(line.find_first_not_of(" \t-#"), line.size());
}

// The end of the value that begins at `begin`; npos: it goes on behind this line.
std::size_t end_of_value(std::string_view line, std::size_t begin) {
  if (begin >= line.size() || line[begin] == '|' || line[begin] == '>') return std::string_view::npos;
  constexpr std::string_view kOpening = "\"'[{";
  constexpr std::string_view kClosing = "\"']}";
  if (const std::size_t pair = kOpening.find(line[begin]); pair != std::string_view::npos) {
    const std::size_t end = line.find(kClosing[pair], begin + 1);
    return end == std::string_view::npos ? end : end + 1;
  }
  // In the flow style of YAML, and in JSON; else the rest of the line.
  const bool is_in_flow = line.substr(0, begin).find('{') != std::string_view::npos;
  return is_in_flow ? std::min(line.find_first_of(",}", begin), line.size()) : line.size();
}

// Removes the values of secret names. Returns whether the last one goes on behind this line.
bool remove_named(std::string& line) {
  for (std::size_t at = 0; at < line.size();) {
    std::size_t end = at;
    while (end < line.size() && is_word(line[end])) ++end;
    if (end == at) {
      ++at;
      continue;
    }
    const bool is_secret = is_secret_name(std::string_view(line).substr(at, end - at));
    const std::size_t mark = line.find_first_not_of("\"' ", end);
    at = end;
    if (!is_secret || mark == std::string::npos || (line[mark] != ':' && line[mark] != '=')) continue;
    const std::size_t begin = std::min(line.find_first_not_of(" \t", mark + 1), line.size());
    const std::size_t behind = end_of_value(line, begin);
    line.replace(begin, std::min(behind, line.size()) - begin, kRemoved);
    if (behind == std::string::npos) return true;
    at = begin + kRemoved.size();
  }
  return false;
}

// The number of hexadecimal digits from there on.
std::size_t hex_run(std::string_view line, std::size_t at) {
  std::size_t end = at;
  while (end < line.size() && is_hex(line[end])) ++end;
  return end - at;
}

// Removes keys in hexadecimal digits: in one run, or in groups of 2, 4 or 8 with a separator in between.
void remove_hex(std::string& line) {
  if (line.find("sha256") != std::string::npos) return;
  for (std::size_t at = 0; at < line.size();) {
    const std::size_t group = hex_run(line, at);
    if (group == 0) {
      ++at;
      continue;
    }
    std::size_t end = at + group;
    std::size_t digits = group;
    const bool begins_word = at == 0 || std::isalnum(static_cast<unsigned char>(line[at - 1])) == 0;
    const bool may_go_on = begins_word && (group == 2 || group == 4 || group == 8);
    while (may_go_on && end < line.size() &&
           std::string_view(" :-").find(line[end]) != std::string_view::npos &&
           hex_run(line, end + 1) == group) {
      end += group + 1;
      digits += group;
    }
    if (digits < kHexDigits) {
      at += group;
      continue;
    }
    line.replace(at, end - at, kRemoved);
    at += kRemoved.size();
  }
}

void remove_user_in_url(std::string& line) {
  for (std::size_t at = line.find("://"); at != std::string::npos; at = line.find("://", at + 1)) {
    const std::size_t begin = at + 3;
    const std::size_t end = std::min(line.find_first_of("/ \t\"',}", begin), line.size());
    const std::size_t user = line.rfind('@', end);
    if (user == std::string::npos || user < begin) continue;
    line.replace(begin, user - begin, kRemoved);
  }
}

}  // namespace

std::string without_secrets(std::string_view text) {
  std::string out;
  bool in_pem = false;
  std::size_t block = std::string::npos;  // the indentation of a secret name whose value follows
  while (!text.empty()) {
    const std::size_t size = std::min(text.find('\n'), text.size());
    std::string line(text.substr(0, size));
    const bool ends = size < text.size();
    text.remove_prefix(ends ? size + 1 : size);
    const bool begins_pem = line.find("-----BEGIN") != std::string::npos;
    if (in_pem) {
      in_pem = line.find("-----END") == std::string::npos;
      continue;
    }
    const bool is_blank = line.find_first_not_of(" \t\r") == std::string::npos;
    if (block != std::string::npos && (is_blank || indentation(line) > block)) continue;
    block = std::string::npos;
    if (begins_pem) {
      in_pem = line.find("-----END") == std::string::npos;
      line = kRemoved;
    } else if (remove_named(line)) {
      block = indentation(line);
    }
    remove_hex(line);
    remove_user_in_url(line);
    out += line;
    if (ends) out += '\n';
  }
  return out;
}

}  // namespace groma::doctor
