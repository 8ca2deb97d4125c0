#include "host/io/output_file.hpp"

#include <gtest/gtest.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <filesystem>
#include <string>

#include "host/io/error.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

using test::read_text;

class OutputFileTest : public testing::Test {
 protected:
  [[nodiscard]] std::size_t files() const {
    return static_cast<std::size_t>(std::distance(std::filesystem::directory_iterator(folder_.path()), {}));
  }
  test::ScratchFolder folder_;
};

TEST_F(OutputFileTest, WritesAndReplaces) {
  write_file(folder_ / "a.csv", "one");
  EXPECT_EQ(read_text(folder_ / "a.csv"), "one");
  const std::string long_text(1'000'000, 'x');
  write_file(folder_ / "a.csv", long_text);
  EXPECT_EQ(read_text(folder_ / "a.csv"), long_text);
  EXPECT_EQ(files(), 1U) << "no temporary file is left";
}

TEST_F(OutputFileTest, TheModeFollowsTheUmask) {
  const mode_t mask = ::umask(027);
  write_file(folder_ / "a.csv", "one");
  ::umask(mask);
  EXPECT_EQ(std::filesystem::status(folder_ / "a.csv").permissions(),
            static_cast<std::filesystem::perms>(0640));
}

TEST_F(OutputFileTest, AReaderOfTheOldFileKeepsIt) {
  write_file(folder_ / "a.csv", "old content");
  std::ifstream reader(folder_ / "a.csv");
  write_file(folder_ / "a.csv", "new");
  std::string seen;
  std::getline(reader, seen);
  EXPECT_EQ(seen, "old content");
}

TEST_F(OutputFileTest, ALinkStaysALink) {
  folder_.write("deep/target.csv", "old");
  std::filesystem::create_symlink(folder_ / "deep/target.csv", folder_ / "link.csv");
  write_file(folder_ / "link.csv", "new");
  EXPECT_TRUE(std::filesystem::is_symlink(folder_ / "link.csv"));
  EXPECT_EQ(read_text(folder_ / "deep/target.csv"), "new");
}

TEST_F(OutputFileTest, AnInvalidPath) {
  EXPECT_THROW(write_file(folder_ / "none/a.csv", "x"), PathError);
  EXPECT_THROW(expect_writable(folder_ / "none/a.csv"), PathError);
  EXPECT_THROW(write_file(folder_.path(), "x"), PathError);
  folder_.write("file", "");
  EXPECT_THROW(write_file(folder_ / "file/a.csv", "x"), PathError);
  EXPECT_THROW(write_file("", "x"), PathError);
  EXPECT_EQ(files(), 1U);
}

TEST_F(OutputFileTest, AFolderWithoutWritePermission) {
  if (::geteuid() == 0) {
    // Root may write everywhere except to the kernel's own folders.
    EXPECT_THROW(write_file("/sys/kernel/a.csv", "x"), PermissionError);
    return;
  }
  std::filesystem::permissions(folder_.path(),
                               std::filesystem::perms::owner_read | std::filesystem::perms::owner_exec);
  EXPECT_THROW(expect_writable(folder_ / "a.csv"), PermissionError);
  EXPECT_THROW(write_file(folder_ / "a.csv", "x"), PermissionError);
  std::filesystem::permissions(folder_.path(), std::filesystem::perms::owner_all);
}

TEST_F(OutputFileTest, AFullDevice) {
  EXPECT_THROW(write_file("/dev/full", "x"), DeviceError);
}

TEST_F(OutputFileTest, AFullDiskKeepsTheOldFile) {
  write_file(folder_ / "a.csv", "old");
  std::signal(SIGXFSZ, SIG_IGN);
  rlimit before{};
  ASSERT_EQ(::getrlimit(RLIMIT_FSIZE, &before), 0);
  rlimit small = before;
  small.rlim_cur = 1000;
  ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &small), 0);
  EXPECT_THROW(write_file(folder_ / "a.csv", std::string(5000, 'x')), DeviceError);
  EXPECT_THROW(write_file(folder_ / "b.csv", std::string(5000, 'x')), DeviceError);
  ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &before), 0);
  EXPECT_EQ(read_text(folder_ / "a.csv"), "old");
  EXPECT_EQ(files(), 1U) << "neither a partial nor a temporary file";
}

TEST_F(OutputFileTest, RemovesWhatAKilledProcessHasLeft) {
  const pid_t child = ::fork();
  if (child == 0) ::_exit(0);
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  const auto old = [&](const std::string& name) {
    folder_.write(name, "x");
    std::filesystem::last_write_time(folder_ / name,
                                     std::filesystem::file_time_type::clock::now() - std::chrono::hours(1));
  };
  const std::string ended = std::to_string(child);
  old(".groma-" + ended + "-0.tmp");
  folder_.write(".groma-" + ended + "-1.tmp", "x");
  old(".groma-" + std::to_string(::getpid()) + "-0.tmp");
  old(".groma-" + ended + "-2.yaml");
  old(".groma-.tmp");
  old("calibration.yaml");
  remove_remains(folder_ / "calibration.yaml");
  EXPECT_FALSE(std::filesystem::exists(folder_ / (".groma-" + ended + "-0.tmp")));
  EXPECT_EQ(files(), 5U);
  remove_remains(folder_ / "no" / "folder.yaml");
}

TEST_F(OutputFileTest, AFolderIsCreatedWithItsParents) {
  make_folder(folder_ / "a/b");
  make_folder(folder_ / "a/b");
  EXPECT_TRUE(std::filesystem::is_directory(folder_ / "a/b"));
  folder_.write("file", "");
  EXPECT_THROW(make_folder(folder_ / "file"), PathError);
  EXPECT_THROW(make_folder(folder_ / "file/b"), PathError);
}

}  // namespace
}  // namespace groma::io
