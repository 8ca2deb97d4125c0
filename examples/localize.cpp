// Runs the filter over a data set folder and compares its poses with the ground truth.
//   localize FOLDER      (`groma demo --report DIR` writes two: DIR/first_drive, DIR/second_drive)
#include <fstream>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include <groma/evaluation/evaluation.hpp>
#include <groma/filter/replay.hpp>
#include <groma/model/calibration.hpp>

// The numbers of a CSV file, without its first line.
std::vector<std::vector<double>> read(const std::string& path) {
  std::vector<std::vector<double>> rows;
  std::ifstream file(path);
  std::string line;
  std::getline(file, line);
  while (std::getline(file, line)) {
    std::istringstream fields(line);
    rows.emplace_back();
    for (std::string field; std::getline(fields, field, ',');)
      rows.back().push_back(field.empty() ? groma::model::kUnknown : std::stod(field));
  }
  return rows;
}

int main(int argc, char** argv) {
  namespace model = groma::model;
  namespace filter = groma::filter;
  if (argc != 2) return std::cerr << "usage: localize FOLDER\n", 2;
  const std::string folder = std::string(argv[1]) + "/";
  const auto id = [](double number) { return static_cast<model::NodeId>(number); };
  std::vector<model::Tag> tags;
  std::vector<model::Anchor> anchors;
  std::vector<model::RangeSample> ranges;
  std::vector<model::OdometrySample> odometry;
  std::vector<model::PoseSample> truth;
  for (const auto& r : read(folder + "tags.csv")) tags.push_back({id(r[0]), {r[1], r[2], r[3]}});
  for (const auto& r : read(folder + "anchors.csv")) anchors.push_back({id(r[0]), {r[1], r[2], r[3]}});
  for (const auto& r : read(folder + "ranges.csv")) ranges.push_back({r[0], id(r[1]), id(r[2]), r[3]});
  for (const auto& r : read(folder + "odometry.csv")) odometry.push_back({r[0], r[1], r[2], r[3]});
  for (const auto& r : read(folder + "groundtruth.csv")) truth.push_back({r[0], r[1], r[2], r[3], r[4]});

  // Surveyed anchors; the biases of each pair at their priors (m, 1 sigma). groma::calibration finds both.
  const model::RangePriors priors{.sigma_m = 0.1, .beta_m = {0.4, 0.5}, .gamma = {1.0, 0.005}};
  const model::Calibration calibration = model::surveyed_calibration(anchors, tags, priors, 0.02);
  const model::Surface ground;  // the plane z = 0
  const filter::ReplayOptions options{.start = *filter::start_from_prior(truth, truth.front().t_s, ground)};
  const filter::ReplayResult result = filter::replay(
      {.odometry = odometry, .ranges = ranges, .tags = tags, .surface = &ground, .calibration = &calibration},
      options);

  const auto score = groma::evaluation::evaluate(groma::evaluation::pose_errors(result.rows, truth));
  if (!score) return std::cerr << "no pose at any time of the ground truth\n", 1;
  std::cout << result.rows.size() << " poses, ATE mean " << score->ate_m.mean << " m, max "
            << score->ate_m.max << " m, mean NEES " << score->nees->mean << "\n";
}
