#include "host/daemon/log_output.hpp"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <optional>
#include <stdexcept>
#include <string>

#include "host/io/descriptor.hpp"

namespace groma::daemon {
namespace {

using ::testing::StartsWith;
using Clock = std::chrono::steady_clock;

class LogOutputTest : public ::testing::Test {
 protected:
  static constexpr std::size_t kPipeSize = 4096;

  LogOutputTest() {
    std::array<int, 2> ends{};
    if (::pipe2(ends.data(), O_CLOEXEC) != 0) throw std::runtime_error("pipe2");
    reader_ = io::Descriptor(ends[0]);
    writer_ = io::Descriptor(ends[1]);
    ::fcntl(writer_.get(), F_SETPIPE_SZ, static_cast<int>(kPipeSize));
    output_.emplace(writer_.get());
  }
  // Waits for at least one byte.
  std::string read() const {
    std::array<char, kPipeSize> buffer{};
    const ssize_t n = ::read(reader_.get(), buffer.data(), buffer.size());
    return {buffer.data(), static_cast<std::size_t>(std::max<ssize_t>(n, 0))};
  }

  io::Descriptor reader_;
  io::Descriptor writer_;
  std::optional<LogOutput> output_;
};

TEST_F(LogOutputTest, WritesEachLineAtOnce) {
  output_->write("one");
  EXPECT_EQ(read(), "gromad: one\n");
  output_->write("two");
  EXPECT_EQ(read(), "gromad: two\n");
}

TEST_F(LogOutputTest, WritesWhatWaitsBeforeItEnds) {
  output_->write("one");
  output_->write("two");
  output_.reset();
  writer_.close();
  std::string text;
  for (std::string part = read(); !part.empty(); part = read()) text += part;
  EXPECT_EQ(text, "gromad: one\ngromad: two\n");
}

// The sum of all that it reports.
std::ptrdiff_t missing_lines(const std::string& text) {
  std::ptrdiff_t sum = 0;
  for (std::size_t at = 0; (at = text.find(" lines are missing here", at)) != std::string::npos; ++at)
    sum += std::stoi(text.substr(text.rfind(' ', at - 1)));
  return sum;
}

TEST_F(LogOutputTest, DoesNotWaitForAFullPipe) {
  // More than the pipe, the line that is being written and those that may wait.
  constexpr std::ptrdiff_t kLines = 2000;
  const std::string line(100, 'x');
  for (int i = 0; i < kLines; ++i) output_->write(line);  // ends, although nothing is read
  std::string text;
  const auto lines = [&] { return std::count(text.begin(), text.end(), 'x') / 100; };
  while (lines() + missing_lines(text) < kLines) text += read();
  EXPECT_THAT(text, StartsWith("gromad: " + line + "\n"));
  EXPECT_GT(missing_lines(text), 0);
  EXPECT_EQ(lines() + missing_lines(text), kLines);
  // It goes on as before.
  while (text.back() != '\n') text += read();
  output_->write("last");
  EXPECT_EQ(read(), "gromad: last\n");
}

TEST_F(LogOutputTest, EndsAlthoughNobodyReads) {
  output_->write(std::string(3 * kPipeSize - 1, 'x'));
  const auto begin = Clock::now();
  output_.reset();
  EXPECT_GE(Clock::now() - begin, LogOutput::kPatience);
  // Lets its thread end.
  for (std::size_t bytes = 0; bytes < 3 * kPipeSize;) bytes += read().size();
}

}  // namespace
}  // namespace groma::daemon
