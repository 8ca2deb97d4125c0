// The files of the live page (host/web/page), as the build packs them.
#pragma once

#include <span>
#include <string_view>

namespace groma::web {

struct PageFile {
  std::string_view path;          // as in its address: "/", "/assets/page.js"
  std::string_view content_type;
  std::string_view bytes;         // compressed by gzip
};

// Empty if the page was not built: npm's packages were not installed (scripts/setup page).
[[nodiscard]] std::span<const PageFile> page_files();

}  // namespace groma::web
