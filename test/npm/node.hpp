// The program node with the packages of test/npm.
#pragma once

#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <string>

#include "test/support/child_process.hpp"

namespace groma::test {

inline const std::filesystem::path kNpmFolder = std::filesystem::path(GROMA_SOURCE_DIR) / "test/npm";

// Empty if it or the packages are missing.
inline std::string node() {
  if (!std::filesystem::exists(kNpmFolder / "node_modules/@mcap/core")) return {};
  const ChildResult found = run_child({"/bin/sh", "-c", "command -v node"});
  return found.out.substr(0, found.out.find('\n'));
}

class NpmTest : public testing::Test {
 protected:
  void SetUp() override {
    if (!node().empty()) return;
    const char* const message = "no node, or no packages in test/npm: run scripts/setup test";
    if (std::getenv("GROMA_REQUIRE_NPM") != nullptr) FAIL() << message;
    GTEST_SKIP() << message;
  }
};

}  // namespace groma::test
