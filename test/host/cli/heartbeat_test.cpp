// The line that shows on a terminal that a command still runs.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <cstring>
#include <string>

#include "host/io/descriptor.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma {
namespace {

using testing::HasSubstr;
using testing::Not;

// `groma listen` at a link over which nothing comes runs for as long as it is asked to.
class Heartbeat : public testing::Test {
 protected:
  Heartbeat() : listener_(::socket(AF_UNIX, SOCK_STREAM, 0)) {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, path_.c_str(), sizeof address.sun_path - 1);
    // NOLINTNEXTLINE(cppcoreguidelines-pro-type-reinterpret-cast)
    const auto* const generic = reinterpret_cast<const sockaddr*>(&address);
    EXPECT_EQ(::bind(listener_.get(), generic, sizeof address), 0);
    EXPECT_EQ(::listen(listener_.get(), 4), 0);
  }
  [[nodiscard]] std::string command(const std::string& for_s) const {
    return std::string(GROMA_EXECUTABLE) + " listen " + path_ + " --for " + for_s;
  }

  test::ScratchFolder folder_;
  std::string path_ = folder_ / "node";
  io::Descriptor listener_;
};

TEST_F(Heartbeat, IsShownOnATerminalFrom2sOnAndCleared) {
  const std::string text = test::run_child({"/usr/bin/script", "-qec", command("2.8"), "/dev/null"}).out;
  EXPECT_THAT(text, HasSubstr("\r\x1b[Kgroma listen, "));
  EXPECT_THAT(text, Not(HasSubstr("groma listen, 1 s")));
  EXPECT_THAT(text, HasSubstr("\r\x1b[Kgroma: " + path_ + ": no byte received"));
}

TEST_F(Heartbeat, IsNotShownElsewhere) {
  const test::ChildResult result = test::run_child({"/bin/sh", "-c", "exec " + command("2.8")});
  EXPECT_EQ(result.exit_code, 69);
  EXPECT_THAT(result.err, Not(HasSubstr("\r")));
  EXPECT_THAT(result.err, HasSubstr("no byte received"));
}

// The function of scripts/demo and scripts/setup.
TEST(Scripts, ShowOnATerminalThatACommandRunsAndKeepItsExitCode) {
  const test::ScratchFolder folder;
  const std::string script = folder / "run.sh";
  folder.write("run.sh", "set -eu\n. " GROMA_SOURCE_DIR
                         "/scripts/heartbeat\n"
                         "build() { echo '[3/12] Compiling'; sleep 2.5; return 7; }\n"
                         "with_heartbeat building \"$(mktemp -p \"$1\")\" build || echo \"ended with $?\"\n");
  const std::string command = "/bin/bash " + script + ' ' + folder.path().string();
  const std::string text = test::run_child({"/usr/bin/script", "-qec", command, "/dev/null"}).out;
  EXPECT_THAT(text, HasSubstr("\r\x1b[Kbuilding [3/12], "));
  EXPECT_THAT(text, HasSubstr("\r\x1b[Kended with 7"));
  const test::ChildResult elsewhere = test::run_child({"/bin/bash", script, folder.path()});
  EXPECT_EQ(elsewhere.out, "ended with 7\n");
  EXPECT_EQ(elsewhere.err, "");
}

}  // namespace
}  // namespace groma
