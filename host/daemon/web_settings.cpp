#include "host/daemon/web_settings.hpp"

#include <sys/stat.h>

#include <algorithm>
#include <string_view>
#include <utility>

#include "host/daemon/config_values.hpp"
#include "host/io/csv.hpp"
#include "host/io/error.hpp"

namespace groma::daemon {
namespace {

using io::YamlType;
using io::YamlValue;

constexpr std::size_t kMinToken = 16;  // characters: 64 bits as hexadecimal digits
constexpr std::size_t kMaxWalls = 2000;

bool is_loopback(const std::string& address) {
  return address.starts_with("127.") || address == "::1";
}

std::vector<std::string> parse_names(const YamlValue& yaml) {
  std::vector<std::string> out;
  for (const YamlValue& each : yaml.list()) out.push_back(web::lower_case(each.text()));
  return out;
}

void parse_hosts(const YamlValue& yaml, WebSettings& out) {
  out.hosts = parse_names(yaml);
  for (const YamlValue& each : yaml.list()) {
    if (each.text().empty() || each.text().find_first_of("/:") != std::string::npos)
      each.fail("is no name of a host", "write it without scheme and port, as robot7.example");
  }
}

void parse_origins(const YamlValue& yaml, WebSettings& out) {
  out.origins = parse_names(yaml);
  for (const YamlValue& each : yaml.list()) {
    const std::string text = each.text();
    const std::size_t scheme = text.find("://");
    if (scheme == std::string::npos || scheme == 0 || text.find('/', scheme + 3) != std::string::npos)
      each.fail("is no origin",
                "write scheme, host and port as the browser sends them, as https://viewer.example");
  }
}

std::vector<WebSettings::Wall> read_walls(const std::filesystem::path& path, io::InputFiles& files) {
  const std::string text = files.read(path);
  io::CsvReader csv(path, text, {{"x0_m"}, {"y0_m"}, {"x1_m"}, {"y1_m"}});
  std::vector<WebSettings::Wall> walls;
  while (csv.next()) {
    if (walls.size() == kMaxWalls)
      throw io::DataError(csv.row_place(), "has more walls than a browser can draw", "give at most 2,000");
    walls.push_back({{csv.number(0), csv.number(1)}, {csv.number(2), csv.number(3)}});
  }
  return walls;
}

std::string read_secret(const std::filesystem::path& path) {
  struct stat status {};
  constexpr unsigned kOthers = S_IRWXG | S_IRWXO;
  if (::stat(path.c_str(), &status) == 0 && S_ISREG(status.st_mode) && (status.st_mode & kOthers) != 0) {
    throw io::PermissionError({path}, "may be read or written by other users",
                              "run 'chmod 600' on it, as the user that gromad runs as");
  }
  return io::read_file(path);
}

std::string read_token(const std::filesystem::path& path) {
  std::string token = read_secret(path);
  while (!token.empty() && (token.back() == '\n' || token.back() == '\r')) token.pop_back();
  const bool is_plain = std::all_of(token.begin(), token.end(), [](char c) {
    return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '-' || c == '_';
  });
  if (token.size() < kMinToken || !is_plain) {
    throw io::ConfigError({path}, "holds no token of at least 16 letters, digits, '-' and '_'",
                          "make one: openssl rand -hex 16 > FILE");
  }
  return token;
}

}  // namespace

YamlType web_type() {
  std::vector<io::YamlKey> keys = endpoint_keys();
  keys.push_back({"hosts", YamlType::list(YamlType::text()),
                  "Names of this computer in addresses of the page, beside its numeric ones.", false});
  keys.push_back({"origins", YamlType::list(YamlType::text()),
                  "Origins of other pages that may read, such as https://viewer.example.", false});
  keys.push_back({"token_file", YamlType::text(), "File with the token that clients have to know.", false});
  keys.push_back(
      {"tls",
       YamlType::map({{"certificate", YamlType::text(), "PEM file: the certificate and its chain."},
                      {"key", YamlType::text(), "PEM file: the private key."}}),
       "TLS in place of plain HTTP.", false});
  keys.push_back({"walls", YamlType::text(), "CSV file with the walls of the page's map.", false});
  keys.push_back(
      {"simulated", YamlType::boolean(), "Whether the page says that the site is simulated.", false});
  return YamlType::map(std::move(keys));
}

WebSettings parse_web(const YamlValue& yaml, const std::filesystem::path& folder, io::InputFiles& files) {
  WebSettings out;
  parse_endpoint(yaml, out.endpoint);
  if (const auto hosts = yaml.find("hosts")) parse_hosts(*hosts, out);
  if (const auto origins = yaml.find("origins")) parse_origins(*origins, out);
  if (const auto token = yaml.find("token_file")) out.token_file = parse_path(*token, folder);
  if (const auto tls = yaml.find("tls"))
    out.tls =
        WebSettings::Tls{parse_path(tls->at("certificate"), folder), parse_path(tls->at("key"), folder)};
  if (const auto walls = yaml.find("walls")) out.walls = read_walls(parse_path(*walls, folder), files);
  if (const auto simulated = yaml.find("simulated")) out.is_simulated = simulated->text() == "true";
  if (!is_loopback(out.endpoint.address) && !(out.token_file && out.tls)) {
    yaml.at("address").fail("is reached from other computers",
                            "give 'token_file' and 'tls' too, or keep 127.0.0.1 and let a proxy with TLS and "
                            "a password serve others");
  }
  return out;
}

WebSecrets read_secrets(const WebSettings& settings) {
  WebSecrets out{.access = {.hosts = settings.hosts, .origins = settings.origins, .token = {}}, .tls = {}};
  if (settings.token_file) out.access.token = read_token(*settings.token_file);
  if (settings.tls) {
    out.tls = web::TlsTexts{io::read_file(settings.tls->certificate), read_secret(settings.tls->key)};
    if (const std::string fault = web::fault_of(*out.tls); !fault.empty()) {
      throw io::ConfigError({settings.tls->certificate}, "cannot serve TLS with its key: " + fault,
                            "give the certificate and its own key as PEM files, the key without a password");
    }
  }
  return out;
}

}  // namespace groma::daemon
