#include "host/reproduce/tables.hpp"

#include <array>

namespace groma::reproduce {

const std::vector<TableSpec>& tables() {
  static const std::vector<TableSpec> all{
      {"indoor",
       "The indoor trial",
       "Comparable: anchors, number of tags, rate, kinds of obstacles and of the drive. The paper gives "
       "maxima "
       "and the mean NEES only. Its drive calibrated itself; ours does too, and a second drive is beside it. "
       "Not comparable: the plan of the hall and the noise, which the paper does not give.",
       {{"same drive", "odometry", "odometry", &indoor::kOdometry},
        {"same drive", "original", "original: pure ranges", &indoor::kOriginal},
        {"same drive", "adapted", "adapted; ours: schmidt", &indoor::kAdapted},
        {"other drive", "odometry", "other drive: odometry", nullptr},
        {"other drive", "original", "other drive: original", nullptr},
        {"other drive", "adapted", "other drive: adapted; ours: schmidt", nullptr}}},
      {"table2",
       "Table II: the outdoor trial",
       "Comparable: when the robot is outside, that odometry is worse there, a floor that is slightly uneven "
       "under filters that take it for flat, the silent anchor 13, subsets of anchors and tags. The paper's "
       "filters have calibrations as wrong as its Table I says; ours have the calibration from the indoor "
       "drive. Not comparable: the paper's robot went where its plan, which is not in the text, shows.",
       {{"", "odometry", "odometry", &table2::kOdometry},
        {"", "original", "original: pure ranges", &table2::kOriginal},
        {"", "adapted", "adapted; ours: schmidt", &table2::kAdapted},
        {"", "joint", "ours: joint", nullptr},
        {"", "anchor-states", "anchor positions as states", &table2::kAnchorStates},
        {"", "anchors 5-8-12-14", "anchors 5, 8, 12, 14 only", &table2::kFourAnchors},
        {"", "tags 1-2", "tags 1 and 2 only", &table2::kTags12},
        {"", "tag 1", "tag 1 only", &table2::kTag1},
        {"", "tag 3", "tag 3 only", &table2::kTag3}}},
      {"table3",
       "Table III: the forklift",
       "Comparable: two tags one above the other, twelve anchors pre-calibrated within 0.05 m, constant "
       "biases "
       "from the run itself with gamma held at 1, near-flat ground taken for flat, several reversals, 270 s. "
       "Not comparable: the yard, lever arms, rate and what is wrong with the odometry, which the paper does "
       "not give.",
       {{"pre-calibrated", "odometry", "odometry", &table3::kOdometry},
        {"pre-calibrated", "original", "original: pure ranges", &table3::kOriginal},
        {"pre-calibrated", "adapted", "adapted; ours: schmidt", &table3::kAdapted},
        {"pre-calibrated", "joint", "ours: joint", nullptr},
        {"calibrated by another drive", "adapted", "ours: schmidt, calibrated by another drive", nullptr}}},
  };
  return all;
}

std::span<const Column> columns() {
  static constexpr std::array kColumns{
      Column{"ATE mean m", "ate_m", "mean", &PaperStatistic::mean, &PaperRow::ate_m, "{:.3f}"},
      Column{"ATE max m", "ate_m", "max", &PaperStatistic::max, &PaperRow::ate_m, "{:.3f}"},
      Column{"heading mean rad", "ate_rad", "mean", &PaperStatistic::mean, &PaperRow::ate_rad, "{:.3f}"},
      Column{"NEES mean", "nees", "mean", &PaperStatistic::mean, &PaperRow::nees, "{:.1f}"}};
  return kColumns;
}

double paper_value(const TableRow& row, const Column& column) {
  return row.paper == nullptr ? kNotGiven : row.paper->*column.row.*column.of_paper;
}

Json::json_pointer run_of(const TableRow& row, Who who) {
  Json::json_pointer at;
  if (!row.group.empty()) at /= row.group;
  return at / row.key / (who == Who::kOurs ? "ours" : "published");
}

}  // namespace groma::reproduce
