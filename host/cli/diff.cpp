// groma diff: compares two calibrations of a site.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/calibration/comparison.hpp"
#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/report/comparison_report.hpp"

namespace groma::cli {

namespace {

struct DiffOptions {
  std::filesystem::path a;
  std::filesystem::path b;
  ReportFolder report;
  bool json = false;
};

void write_report(const DiffOptions& options, const calibration::Comparison& comparison,
                  const model::Calibration& a, const model::Calibration& b) {
  report::Page page("Two calibrations of a site", fmt::format("{} is the earlier one, {} the later.",
                                                              options.a.string(), options.b.string()));
  report::add_comparison(page, comparison, a, b);
  write_page(*options.report, std::move(page), {{"earlier", version_of(a)}, {"later", version_of(b)}});
}

std::string verdict_of(const model::Calibration& calibration, model::NodeId id) {
  return std::string(io::word(model::find_anchor(calibration, id)->verdict));
}

const char* change_word(const calibration::AnchorChange& change) {
  if (change.moved) return "moved";
  return change.differs ? "differs" : "same";
}

bool is_same(const calibration::Comparison& comparison) {
  return comparison.only_a.empty() && comparison.only_b.empty() &&
         std::none_of(comparison.anchors.begin(), comparison.anchors.end(),
                      [](const auto& change) { return change.differs; }) &&
         std::none_of(comparison.pairs.begin(), comparison.pairs.end(),
                      [](const auto& change) { return change.differs; });
}

std::string format_text(const calibration::Comparison& comparison, const model::Calibration& a,
                        const model::Calibration& b) {
  const Eigen::Vector4d& mean = comparison.frame.mean;
  const Eigen::Vector4d sigma = comparison.frame.covariance.diagonal().cwiseSqrt();
  std::string text = fmt::format(
      "common frame: shift {:.3f}, {:.3f}, {:.3f} m (sigma {:.3f}, {:.3f}, {:.3f}), turn {:.4f} rad "
      "({:.4f}); "
      "removed below\n\n",
      mean(0), mean(1), mean(2), sigma(0), sigma(1), sigma(2), mean(3), sigma(3));
  Table table({"anchor", "dx m", "dy m", "dz m", "distance m", "sigma xy m", "sigma z m", "chi2", "chance",
               "verdicts", ""});
  for (const calibration::AnchorChange& change : comparison.anchors) {
    const Eigen::Vector3d& d = change.displacement_m;
    const Eigen::Matrix3d& covariance = change.covariance_m2;
    const std::string before = verdict_of(a, change.id);
    const std::string after = verdict_of(b, change.id);
    table.add({fmt::format("{}", change.id), fmt::format("{:.3f}", d.x()), fmt::format("{:.3f}", d.y()),
               fmt::format("{:.3f}", d.z()), fmt::format("{:.3f}", d.norm()),
               fmt::format("{:.3f}", std::sqrt(std::max(covariance(0, 0), covariance(1, 1)))),
               fmt::format("{:.3f}", std::sqrt(covariance(2, 2))), fmt::format("{:.1f}", change.chi2),
               fmt::format("{:.2g}", change.chance),
               before == after ? before : fmt::format("{} -> {}", before, after), change_word(change)});
  }
  text += table.format(true);
  for (const auto& [ids, word] : {std::pair{&comparison.only_a, "missing"}, {&comparison.only_b, "new"}}) {
    for (const model::NodeId id : *ids) text += fmt::format("anchor {}: {}\n", id, word);
  }
  for (const calibration::PairChange& pair : comparison.pairs) {
    if (!pair.differs) continue;
    std::vector<std::string> terms;
    terms.reserve(std::size(model::kPairTerms));
    for (const model::PairTerm& term : model::kPairTerms)
      terms.push_back(fmt::format(fmt::runtime(term.text.change), pair.*term.value, pair.*term.sigma));
    text += fmt::format("tag {}, anchor {}: {}\n", pair.tag_id, pair.anchor_id, fmt::join(terms, ", "));
  }
  return text;
}

template <int kSize>
Json rows_of(const Eigen::Matrix<double, kSize, kSize>& matrix) {
  Json rows = Json::array();
  for (int i = 0; i < kSize; ++i) {
    Json row = Json::array();
    for (int j = 0; j < kSize; ++j) row.push_back(matrix(i, j));
    rows.push_back(std::move(row));
  }
  return rows;
}

Json to_json(const calibration::Comparison& comparison, const model::Calibration& a,
             const model::Calibration& b) {
  const Eigen::Vector4d& mean = comparison.frame.mean;
  Json json{{"same", is_same(comparison)},
            {"verdicts", {io::word(a.verdict), io::word(b.verdict)}},
            {"frame",
             {{"shift_m", {mean(0), mean(1), mean(2)}},
              {"yaw_rad", mean(3)},
              {"covariance", rows_of<4>(comparison.frame.covariance)}}},
            {"anchors", Json::array()},
            {"missing", comparison.only_a},
            {"new", comparison.only_b},
            {"pairs", Json::array()}};
  for (const calibration::AnchorChange& change : comparison.anchors) {
    const Eigen::Vector3d& d = change.displacement_m;
    json["anchors"].push_back({{"id", change.id},
                               {"displacement_m", {d.x(), d.y(), d.z()}},
                               {"distance_m", d.norm()},
                               {"covariance_m2", rows_of<3>(change.covariance_m2)},
                               {"chi2", change.chi2},
                               {"chance", change.chance},
                               {"change", change_word(change)},
                               {"verdicts", {verdict_of(a, change.id), verdict_of(b, change.id)}}});
  }
  for (const calibration::PairChange& pair : comparison.pairs) {
    json["pairs"].push_back(cli::to_json(pair, pair.anchor_id));
    json["pairs"].back()["differs"] = pair.differs;
  }
  return json;
}

int run(const DiffOptions& options) {
  prepare_report(options.report);
  const model::Calibration a = io::read_calibration(options.a);
  const model::Calibration b = io::read_calibration(options.b);
  if (a.frame != b.frame) {
    throw io::DataError({options.b}, fmt::format("is in the frame '{}', the other in '{}'", b.frame, a.frame),
                        "compare calibrations of one frame");
  }
  const calibration::Comparison comparison = calibration::compare(a, b);
  if (options.report) write_report(options, comparison, a, b);
  if (options.json) {
    say_json(to_json(comparison, a, b));
  } else {
    say(format_text(comparison, a, b));
    say(is_same(comparison) ? "the same within their errors\n" : "they differ\n");
  }
  return is_same(comparison) ? io::kGood : io::kDoneWithWarnings;
}

}  // namespace

void add_diff(CLI::App& app, Action& action) {
  const auto options = std::make_shared<DiffOptions>();
  CLI::App* command = app.add_subcommand(
      "diff",
      "Compare two calibrations of one site: the displacement of each anchor against the uncertainty of "
      "both. Ends with 0 if they are the same within their errors, with 3 if they differ.");
  command->add_option("A", options->a, "Calibration file, the earlier one")->required()->type_name("FILE");
  command->add_option("B", options->b, "Calibration file, the later one")->required()->type_name("FILE");
  add_report_option(*command, options->report);
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
