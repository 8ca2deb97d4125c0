#include "host/daemon/log_writer.hpp"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include "host/io/input_file.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using groma::test::TemporaryFolder;
using ::testing::HasSubstr;

io::Descriptor open_to_append(const std::filesystem::path& path) {
  return io::Descriptor(::open(path.c_str(), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644));
}

TEST(LogWriter, WritesEachFileInTheOrderOfItsBytes) {
  const TemporaryFolder folder;
  int files = 0;
  const auto open = [&] { return open_to_append(folder / std::to_string(++files)); };
  {
    LogWriter writer("ring", open, "begin");
    for (int i = 0; i < 100; ++i) {
      std::string bytes = "," + std::to_string(i);
      writer.write(bytes, i % 40 == 39);
      EXPECT_TRUE(bytes.empty());
    }
    EXPECT_FALSE(writer.take_failure());
  }
  ASSERT_EQ(files, 3);
  EXPECT_TRUE(io::read_file(folder / "1").starts_with("begin,0,1,2,"));
  EXPECT_TRUE(io::read_file(folder / "1").ends_with(",38"));
  EXPECT_TRUE(io::read_file(folder / "2").starts_with(",39,"));
  EXPECT_EQ(io::read_file(folder / "3").substr(0, 3), ",79");
}

TEST(LogWriter, EndsOnceTheDiskIsFullAndSaysSo) {
  const TemporaryFolder folder;
  bool is_first = true;
  const auto open = [&] {
    return open_to_append(std::exchange(is_first, false) ? folder / "1" : "/dev/full");
  };
  LogWriter writer("ring", open, "begin");
  std::string bytes = "more";
  writer.write(bytes, true);
  std::optional<std::string> failure;
  while (!(failure = writer.take_failure())) std::this_thread::yield();
  EXPECT_THAT(*failure,
              HasSubstr("ring: cannot be written (No space left on device); the recording has ended"));
  bytes = "still more";
  writer.write(bytes);
  EXPECT_TRUE(bytes.empty());
  EXPECT_FALSE(writer.take_failure());
  EXPECT_EQ(io::read_file(folder / "1"), "begin");
}

TEST(LogWriter, WritesNothingWhereTheDiskIsFullAtTheStart) {
  const auto full = [] { return open_to_append("/dev/full"); };
  LogWriter writer("log", full, "begin");
  EXPECT_THAT(writer.take_failure().value_or(""),
              HasSubstr("log: cannot be written (No space left on device); nothing is recorded"));
  std::string bytes = "more";
  writer.write(bytes);
  EXPECT_TRUE(bytes.empty());
  EXPECT_FALSE(writer.take_failure());
}

}  // namespace
}  // namespace groma::daemon
