// Randomly corrupted files: each is read, or rejected with a message; nothing else happens.
#include <gtest/gtest.h>

#include <cstdint>
#include <string>
#include <vector>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "test/host/io/small_dataset.hpp"

namespace groma::io {
namespace {

// SplitMix64.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  std::size_t below(std::size_t bound) {
    state_ += 0x9e3779b97f4a7c15U;
    std::uint64_t z = state_;
    z = (z ^ (z >> 30U)) * 0xbf58476d1ce4e5b9U;
    z = (z ^ (z >> 27U)) * 0x94d049bb133111ebU;
    return static_cast<std::size_t>((z ^ (z >> 31U)) % bound);
  }

 private:
  std::uint64_t state_;
};

// One to four edits: insert a byte or a word, erase or replace a piece, duplicate a piece, or truncate the
// text.
std::string corrupted(std::string text, Random& random) {
  static const std::vector<std::string> kWords{"nan",
                                               "-inf",
                                               "1e400",
                                               "1e-400",
                                               "99999999999999999999",
                                               "-",
                                               ",",
                                               ",,,",
                                               "\n",
                                               "\r",
                                               "#",
                                               ": ",
                                               "- ",
                                               "{",
                                               "}",
                                               "[",
                                               "]",
                                               "\"",
                                               "&a ",
                                               "*a",
                                               "!!binary ",
                                               "~",
                                               "<<: ",
                                               "\t",
                                               "%",
                                               "|\n",
                                               "? ",
                                               "---\n",
                                               "...\n",
                                               "65536",
                                               "-1",
                                               std::string("\0", 1),
                                               "\xff",
                                               "\xef\xbb\xbf"};
  const std::size_t edits = 1 + random.below(4);
  for (std::size_t i = 0; i < edits; ++i) {
    const std::size_t at = random.below(text.size() + 1);
    const std::size_t length = random.below(8);
    switch (random.below(6)) {
      case 0:
        text.insert(at, 1, static_cast<char>(random.below(256)));
        break;
      case 1:
        text.insert(at, kWords[random.below(kWords.size())]);
        break;
      case 2:
        text.erase(at, length);
        break;
      case 3:
        text.replace(at, length, kWords[random.below(kWords.size())]);
        break;
      case 4:
        text.insert(at, text.substr(random.below(text.size() + 1), random.below(40)));
        break;
      default:
        if (random.below(4) == 0) text.resize(at);
    }
  }
  return text;
}

TEST(MutationTest, DataSets) {
  const test::ScratchFolder folder;
  test::write_small_dataset(folder);
  Random random(1);
  std::size_t read = 0;
  std::size_t rejected = 0;
  for (const std::string file : {"dataset.yaml", "tags.csv", "anchors.csv", "ranges.csv", "odometry.csv",
                                 "groundtruth.csv", "pose_prior.csv", "surface.csv"}) {
    const std::string text = test::read_text(folder / file);
    for (int i = 0; i < 250; ++i) {
      folder.write(file, corrupted(text, random));
      try {
        const Dataset data = read_dataset(folder.path());
        for (const model::RangeSample& range : data.ranges) EXPECT_LE(range.range_m, kMaxRange_m);
        for (std::size_t k = 1; k < data.odometry.size(); ++k) {
          EXPECT_LT(data.odometry[k - 1].t_s, data.odometry[k].t_s);
        }
        ++read;
      } catch (const Error& error) {
        EXPECT_NE(std::string(error.what()).find(folder.path().string()), std::string::npos) << error.what();
        ++rejected;
      }
    }
    folder.write(file, text);
  }
  // Both have to happen, otherwise the mutations test nothing.
  EXPECT_GT(read, 100U);
  EXPECT_GT(rejected, 1000U);
}

TEST(MutationTest, Calibrations) {
  model::Calibration calibration;
  for (const model::NodeId id : {model::NodeId{4}, model::NodeId{5}}) {
    model::AnchorCalibration anchor;
    anchor.id = id;
    anchor.position_m = {1.5, -2.25, 3.0};
    anchor.pairs = {{1, 0.25, 0.5, 1.0, 0.125}, {2, -0.25, 0.5, 1.0, 0.125}};
    anchor.covariance = Eigen::VectorXd{{0.04, 0.04, 0.09, 0.25, 0.25, 0.015625, 0.015625}}.asDiagonal();
    calibration.anchors.push_back(anchor);
  }
  const std::string text = format_calibration(calibration);
  Random random(2);
  std::size_t read = 0;
  std::size_t rejected = 0;
  for (int i = 0; i < 3000; ++i) {
    try {
      const model::Calibration result = parse_calibration("c.yaml", corrupted(text, random));
      for (const model::AnchorCalibration& anchor : result.anchors)
        EXPECT_TRUE(anchor.covariance.array().isFinite().all());
      ++read;
    } catch (const ConfigError& error) {
      EXPECT_EQ(std::string(error.what()).find("c.yaml:"), 0U) << error.what();
      ++rejected;
    }
  }
  EXPECT_GT(read, 100U);
  EXPECT_GT(rejected, 1000U);
}

}  // namespace
}  // namespace groma::io
