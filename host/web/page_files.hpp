// The files of the live page (host/web/page), as the build packs them.
#pragma once

#include <span>
#include <string_view>

namespace groma::web {

struct PageFile {
  std::string_view path;  // as in its address: "/", "/assets/page.js"
  std::string_view content_type;
  std::string_view bytes;  // compressed by gzip
};

// Empty if the page was not built: npm's packages were not installed (scripts/setup page).
[[nodiscard]] std::span<const PageFile> page_files();

// What "/" is if the page was not built.
inline constexpr std::string_view kNoPage =
    "<!DOCTYPE html><html lang=\"en\"><title>gromad</title><p>This gromad was built without its live page. "
    "Run "
    "<code>scripts/setup page</code>, build again and restart it. <a href=\"/metrics\">/metrics</a> has the "
    "counters; <code>/live</code> and <code>/foxglove</code> are WebSockets.</p></html>\n";

}  // namespace groma::web
