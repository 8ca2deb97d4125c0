// groma demo --emulated as a child process.
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "test/host/simulation/demo_bounds.hpp"
#include "test/support/child_process.hpp"
#include "test/support/shipped_image.hpp"

namespace groma::simulation {
namespace {

TEST(EmulatedDemoCommand, KeepsTheBoundsOfTheNativeOne) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  const test::ChildResult demo = test::run_child({GROMA_EXECUTABLE, "demo", "--emulated", "--image",
                                                  test::shipped_image(".hex"), "--seed", "1", "--json"});
  ASSERT_EQ(demo.exit_code, 0) << demo.err;
  expect_demo_bounds(nlohmann::json::parse(demo.out));
}

}  // namespace
}  // namespace groma::simulation
