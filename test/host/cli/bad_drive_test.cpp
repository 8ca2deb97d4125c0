// groma calibrate on unsuitable drives: it gives a verdict and advice, never a wrong result with small
// covariance.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <string>
#include <tuple>
#include <vector>

#include <Eigen/Cholesky>
#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset_writer.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma {
namespace {

using nlohmann::json;
using test::SimulatedSite;

void never_moves(SimulatedSite& site) {
  site = with_path(site, test::standing_pose);
}
void one_straight_line(SimulatedSite& site) {
  site = with_path(site, test::straight_pose);
}
void one_straight_line_of_one_tag(SimulatedSite& site) {
  one_straight_line(site);
  site.tags.resize(1);
  std::erase_if(site.ranges, [](const auto& range) { return range.tag_id != 1; });
}
void one_tag(SimulatedSite& site) {
  site.tags.resize(1);
  std::erase_if(site.ranges, [](const auto& range) { return range.tag_id != 1; });
}
void poses_without_ranges(SimulatedSite& site) {
  site.ranges.clear();
}
void ranges_without_poses(SimulatedSite& site) {
  site.poses.clear();
}
void poses_of_another_time(SimulatedSite& site) {
  for (model::PoseSample& pose : site.poses) pose.t_s += 1e5;
}
void ids_swapped_half_way(SimulatedSite& site) {
  for (model::RangeSample& range : site.ranges) {
    if (range.t_s < 120.0) continue;
    if (range.anchor_id == 5) {
      range.anchor_id = 11;
    } else if (range.anchor_id == 11) {
      range.anchor_id = 5;
    }
  }
}
void ids_swapped_for_a_third(SimulatedSite& site) {
  for (model::RangeSample& range : site.ranges) {
    if (range.t_s < 80.0 || range.t_s > 160.0) continue;
    if (range.anchor_id == 5) {
      range.anchor_id = 11;
    } else if (range.anchor_id == 11) {
      range.anchor_id = 5;
    }
  }
}
void two_under_one_id(SimulatedSite& site) {
  for (model::RangeSample& range : site.ranges) {
    if (range.anchor_id == 11) range.anchor_id = 5;
  }
}
void two_neighbours_under_one_id(SimulatedSite& site) {
  for (model::RangeSample& range : site.ranges) {
    if (range.anchor_id == 13) range.anchor_id = 12;
  }
}
void tags_swapped(SimulatedSite& site) {
  std::swap(site.tags[0].lever_arm_m, site.tags[2].lever_arm_m);
}
void nothing_but_garbage(SimulatedSite& site) {
  test::Random random(6);
  for (model::RangeSample& range : site.ranges) range.range_m = random.uniform(0.1, 40.0);
}
void all_the_same(SimulatedSite& site) {
  for (model::RangeSample& range : site.ranges) range.range_m = 5.0;
}
void a_clock_ten_seconds_off(SimulatedSite& site) {
  for (model::RangeSample& range : site.ranges) range.t_s += 10.0;
}

struct BadDrive {
  const char* name;
  void (*corrupt)(SimulatedSite& site);
  std::vector<int> exit_codes;
  // Ids that belong to more than one place.
  std::vector<model::NodeId> ambiguous{};
};

std::ostream& operator<<(std::ostream& out, const BadDrive& drive) {
  return out << drive.name;
}

// And the seed of its site.
class BadDriveTest : public testing::TestWithParam<std::tuple<BadDrive, std::uint64_t>> {};

TEST_P(BadDriveTest, GivesAVerdictAndAdviceAndNoOverconfidentResult) {
  const auto& [bad, seed] = GetParam();
  SimulatedSite site = test::simulate_site({}, seed);
  bad.corrupt(site);
  io::Dataset dataset;
  dataset.name = bad.name;
  dataset.origin = "simulated";
  dataset.range_priors = site.drive().priors;
  dataset.surface = site.floor;
  dataset.tags = site.tags;
  dataset.ranges = site.ranges;
  const test::ScratchFolder folder;
  io::write_dataset(folder / "drive", dataset);
  std::string poses = "t_s,x_m,y_m,z_m,yaw_rad\n";
  for (const model::PoseSample& pose : site.poses) {
    poses += std::to_string(pose.t_s) + ',' + std::to_string(pose.x_m) + ',' + std::to_string(pose.y_m) +
             ',' + std::to_string(pose.z_m) + ',' + std::to_string(pose.yaw_rad) + '\n';
  }
  folder.write("drive/pose_prior.csv", poses);

  const test::ChildResult result =
      test::run_child({GROMA_EXECUTABLE, "calibrate", folder / "drive", "-o", folder / "out.yaml", "--json"});
  EXPECT_THAT(bad.exit_codes, testing::Contains(result.exit_code)) << result.err;
  EXPECT_EQ(result.err.empty(), result.exit_code == 0) << "a failure has a message";
  ASSERT_FALSE(result.out.empty());
  const json output = json::parse(result.out);
  const std::string verdict = output.at("verdict");
  EXPECT_EQ(result.exit_code, verdict == "unusable" ? 65 : verdict == "warnings" ? 3 : 0);
  for (const json& anchor : output.at("anchors")) {
    const std::string word = anchor.at("verdict");
    EXPECT_EQ(word == "ok", anchor.at("advice").get<std::string>().empty());
    const model::NodeId id = anchor.at("id");
    if (word != "ok" && word != "weak-z") continue;
    EXPECT_THAT(bad.ambiguous, testing::Not(testing::Contains(id)));
    const Eigen::Vector3d truth_m = site.anchors[id - 4U].position_m;
    Eigen::Vector3d error_m;
    Eigen::Matrix3d covariance;
    for (int i = 0; i < 3; ++i) {
      error_m(i) = anchor.at("position_m")[static_cast<std::size_t>(i)].get<double>() - truth_m(i);
      for (int j = 0; j < 3; ++j) {
        covariance(i, j) =
            anchor.at("covariance_m2")[static_cast<std::size_t>(i)][static_cast<std::size_t>(j)]
                .get<double>();
      }
    }
    // 99.99 % quantile, for some 500 anchors; three degrees of freedom, or two if the height is not
    // trusted.
    if (word == "weak-z") {
      error_m.z() = 0.0;
      covariance.row(2).setZero();
      covariance.col(2).setZero();
      covariance(2, 2) = 1.0;
    }
    EXPECT_LT(error_m.dot(covariance.ldlt().solve(error_m)), word == "ok" ? 21.1 : 18.4)
        << "anchor " << id << " is " << word << " but off by " << error_m.transpose();
  }
}

INSTANTIATE_TEST_SUITE_P(
    Drives, BadDriveTest,
    testing::Combine(
        testing::Values(BadDrive{"never_moves", never_moves, {65}},
                        BadDrive{"one_straight_line", one_straight_line, {3, 65}},
                        BadDrive{"one_straight_line_of_one_tag", one_straight_line_of_one_tag, {65}},
                        BadDrive{"one_tag", one_tag, {3}},
                        BadDrive{"poses_without_ranges", poses_without_ranges, {65}},
                        BadDrive{"ranges_without_poses", ranges_without_poses, {65}},
                        BadDrive{"poses_of_another_time", poses_of_another_time, {65}},
                        BadDrive{"ids_swapped_half_way", ids_swapped_half_way, {3}, {5, 11}},
                        BadDrive{"ids_swapped_for_a_third", ids_swapped_for_a_third, {3}, {5, 11}},
                        BadDrive{"two_under_one_id", two_under_one_id, {3, 65}, {5}},
                        BadDrive{"two_neighbours_under_one_id", two_neighbours_under_one_id, {3}, {12}},
                        BadDrive{"tags_swapped", tags_swapped, {3, 65}},
                        BadDrive{"nothing_but_garbage", nothing_but_garbage, {65}},
                        BadDrive{"all_the_same", all_the_same, {65}},
                        BadDrive{"a_clock_ten_seconds_off", a_clock_ten_seconds_off, {3, 65}}),
        testing::Values(1U, 2U, 3U)),
    [](const auto& drive) {
      return std::string(std::get<0>(drive.param).name) + '_' + std::to_string(std::get<1>(drive.param));
    });

}  // namespace
}  // namespace groma
