#include "host/daemon/calibration_writer.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <string>
#include <vector>

#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/model/calibration.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class CalibrationWriterTest : public ::testing::Test {
 protected:
  CalibrationWriterTest() { std::filesystem::create_symlink("/dev/full", path_); }

  // Starts an attempt and collects it.
  void attempt(double now_s) {
    writer_.service(now_s);
    const std::size_t before = log_.size();
    for (int i = 0; i < 5000 && log_.size() == before; ++i) {
      ::usleep(1000);
      writer_.service(now_s);
    }
  }
  void make_room() const { std::filesystem::remove(path_); }

  static model::Calibration calibration(model::NodeId anchor) {
    const std::vector<model::Anchor> anchors{{anchor, {1.0, 2.0, 3.0}}};
    const std::vector<model::Tag> tags{{1, {0.3, 0.2, 0.5}}};
    return model::surveyed_calibration(anchors, tags, model::RangePriors{}, 0.1);
  }

  groma::test::TemporaryFolder folder_;
  std::filesystem::path path_ = folder_ / "solved.yaml";
  std::vector<std::string> log_;
  CalibrationWriter writer_{path_, [this](std::string_view line) { log_.emplace_back(line); }};
};

TEST_F(CalibrationWriterTest, TriesAgainUntilTheDiskHasRoom) {
  writer_.put(calibration(1));
  attempt(5.0);
  EXPECT_THAT(log_,
              ElementsAre(AllOf(HasSubstr("No space left on device"), HasSubstr("calibration is used"))));
  make_room();
  writer_.service(5.0 + 0.9 * CalibrationWriter::kRetry_s);
  EXPECT_FALSE(std::filesystem::exists(path_));
  attempt(5.0 + CalibrationWriter::kRetry_s);
  ASSERT_EQ(log_.size(), 2U);
  EXPECT_THAT(log_.back(), HasSubstr("calibration written to "));
  EXPECT_EQ(io::read_calibration(path_).anchors.size(), 1U);
  writer_.finish();
  EXPECT_EQ(log_.size(), 2U);
}

TEST_F(CalibrationWriterTest, WritesTheNewestAtTheEndOrThrows) {
  writer_.put(calibration(1));
  attempt(5.0);
  EXPECT_THROW(writer_.finish(), io::DeviceError);
  writer_.put(calibration(2));
  make_room();
  writer_.finish();
  EXPECT_EQ(io::read_calibration(path_).anchors.at(0).id, 2);
}

}  // namespace
}  // namespace groma::daemon
