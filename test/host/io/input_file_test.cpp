// Reading whole files, and paths that are not regular files.
#include "host/io/input_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <fstream>
#include <string>
#include <thread>

#include "host/io/error.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

using testing::HasSubstr;

std::string complaint(const std::filesystem::path& path) {
  try {
    static_cast<void>(read_file(path));
  } catch (const DataError& error) {
    return error.what();
  }
  return "none";
}

TEST(ReadFile, StopsAtABoundForAnEndlessFile) {
  EXPECT_THAT(complaint("/dev/zero"),
              HasSubstr("/dev/zero: is not a regular file, and is longer than 64 MiB; give"));
  EXPECT_EQ(read_file("/dev/null"), "");
}

TEST(ReadFile, DoesNotWaitForTheWriterOfAPipe) {
  const test::ScratchFolder folder;
  const std::filesystem::path fifo = folder / "fifo";
  ASSERT_EQ(::mkfifo(fifo.c_str(), 0600), 0);
  EXPECT_THAT(complaint(fifo), HasSubstr("is a pipe without a writer; give"));
}

TEST(ReadFile, ReadsAPipeToItsEnd) {
  const std::string text(300'000, 'x');
  std::array<int, 2> ends{};
  ASSERT_EQ(::pipe(ends.data()), 0);
  // Like a shell's <(...): the writer is slow and closes the pipe at the end.
  std::thread writer([&] {
    ::usleep(50'000);
    std::size_t sent = 0;
    while (sent < text.size()) {
      const ssize_t count = ::write(ends[1], text.data() + sent, text.size() - sent);
      if (count <= 0) break;
      sent += static_cast<std::size_t>(count);
    }
    ::close(ends[1]);
  });
  EXPECT_EQ(read_file("/dev/fd/" + std::to_string(ends[0])), text);
  writer.join();
  ::close(ends[0]);

  const test::ScratchFolder folder;
  const std::filesystem::path fifo = folder / "fifo";
  ASSERT_EQ(::mkfifo(fifo.c_str(), 0600), 0);
  // Opened for reading and writing, so that opening does not wait for the reader.
  std::fstream named(fifo);
  std::thread slow([&] {
    ::usleep(50'000);
    named << "schema: 1\n" << std::flush;
    named.close();
  });
  EXPECT_EQ(read_file(fifo), "schema: 1\n");
  slow.join();
}

}  // namespace
}  // namespace groma::io
