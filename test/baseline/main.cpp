// groma-baselines: the methods that a user would otherwise take, on the data sets and calibrations of groma.
#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>

#include "host/evaluation/evaluation.hpp"
#include "host/help/help.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/io/version.hpp"
#include "test/baseline/drive.hpp"
#include "test/baseline/graph.hpp"
#include "test/baseline/method.hpp"

namespace groma::baseline {

namespace {

using Json = nlohmann::ordered_json;
using Action = std::function<int()>;

void say(const std::string& text) {
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size() || std::fflush(stdout) != 0)
    throw io::DeviceError({"standard output"}, "cannot be written", "check its destination");
}
void complain(const std::string& text) {
  fmt::print(stderr, "groma-baselines: {}\n", text);
}

template <class Number>
std::vector<Number> parse_list(const std::string& option, const std::string& text, const char* wanted) {
  std::vector<Number> values;
  const char* begin = text.data();
  const char* const end = begin + text.size();
  for (;;) {
    Number value{};
    const auto [last, error] = std::from_chars(begin, end, value);
    bool good = error == std::errc() && (last == end || *last == ',');
    if constexpr (std::is_floating_point_v<Number>) good = good && std::isfinite(value);
    if (!good) throw CLI::ValidationError(option, fmt::format("'{}' is not {}", text, wanted));
    values.push_back(value);
    if (last == end) return values;
    begin = last + 1;
  }
}

// The drive, its calibration, and what refers to both.
struct Input {
  io::Dataset dataset;
  model::Calibration calibration;
  model::Surface surface;
  std::optional<Site> site;
  std::optional<Drive> drive;
};

class Warnings {
 public:
  void add(const std::string& text) {
    any_ = true;
    complain("warning: " + text);
  }
  [[nodiscard]] int exit_code() const { return any_ ? io::kDoneWithWarnings : io::kGood; }

 private:
  bool any_ = false;
};

void expect_ids(const char* option, const std::vector<model::NodeId>& chosen,
                const std::function<bool(model::NodeId)>& is_known) {
  for (const model::NodeId id : chosen) {
    if (!is_known(id))
      throw CLI::ValidationError(option, fmt::format("{} is neither in the run nor in the calibration", id));
  }
}

std::unique_ptr<Input> read_input(const std::filesystem::path& folder,
                                  const std::filesystem::path& calibration, const DriveOptions& options,
                                  std::optional<double> plane_z_m, bool with_truth, Warnings& warnings) {
  auto input = std::make_unique<Input>();
  io::ReadOptions read;
  read.surveyed_anchors = false;
  read.ground_truth = with_truth;
  input->dataset = io::read_dataset(folder, read);
  input->calibration = io::read_calibration(calibration);
  input->surface =
      plane_z_m ? model::Surface(model::Plane(*plane_z_m, Eigen::Vector3d::UnitZ())) : input->dataset.surface;
  input->site.emplace(input->dataset.tags, input->calibration);
  expect_ids("--tags", options.tags, [&](model::NodeId id) {
    return std::any_of(input->dataset.tags.begin(), input->dataset.tags.end(),
                       [id](const model::Tag& tag) { return tag.id == id; });
  });
  expect_ids("--anchors", options.anchors, [&](model::NodeId id) {
    return model::find_anchor(input->calibration, id) != nullptr ||
           std::any_of(input->dataset.ranges.begin(), input->dataset.ranges.end(),
                       [id](const model::RangeSample& range) { return range.anchor_id == id; });
  });
  input->drive = make_drive(input->dataset, input->surface, *input->site, input->calibration, options);
  if (!input->drive) {
    throw io::DataError({folder},
                        "there is no pose prior to start from, or no odometry after it, in the chosen time",
                        "choose another --from and --to");
  }
  if (const std::size_t dropped = input->dataset.dropped.total(); dropped > 0)
    warnings.add(fmt::format("{}: {} rows were dropped", folder.string(), dropped));
  if (const std::size_t unknown = input->drive->unknown_ranges; unknown > 0) {
    warnings.add(
        fmt::format("{} ranges are of anchors or pairs that {} lacks", unknown, calibration.string()));
  }
  if (input->calibration.verdict == model::Verdict::kUnusable)
    warnings.add(fmt::format("{}: its verdict is 'unusable'", calibration.string()));
  return input;
}

// Throws DataError if an estimate is not finite.
void expect_finite(const std::filesystem::path& folder, std::string_view method,
                   const std::vector<model::PlanarEstimate>& rows) {
  for (const model::PlanarEstimate& row : rows) {
    if (std::isfinite(row.x_m) && std::isfinite(row.y_m) && std::isfinite(row.yaw_rad) &&
        row.covariance.allFinite())
      continue;
    throw io::DataError({folder},
                        fmt::format("the estimate of {} is not finite from t_s = {} on", method, row.t_s),
                        "leave the method out, or end before it with --to");
  }
}

Json to_json(const Parameters& parameters, const MethodInfo& method) {
  Json json = Json::object();
  for (const Searched& searched : method.searched)
    json[std::string(searched.name)] = parameters.*searched.value;
  return json;
}

// ---- list

int list(bool json) {
  Json all = Json::array();
  for (const MethodInfo& method : methods()) {
    if (json) {
      all.push_back({{"method", method.name}, {"text", method.text}});
    } else {
      say(fmt::format("{:<20} {}\n", method.name, method.text));
    }
  }
  if (json) say(all.dump(2) + '\n');
  return io::kGood;
}

// ---- run

struct InputOptions {
  std::filesystem::path dataset;
  std::filesystem::path calibration;
  DriveOptions drive;
  std::optional<double> plane_z_m;
};

void add_number(CLI::App& command, const char* name, std::optional<double>& value, const char* help,
                const char* type) {
  command
      .add_option_function<std::string>(
          name,
          [&value, name](const std::string& text) {
            const auto values = parse_list<double>(name, text, "a number");
            if (values.size() != 1)
              throw CLI::ValidationError(name, fmt::format("'{}' is not a number", text));
            value = values.front();
          },
          help)
      ->type_name(type);
}
void add_times(CLI::App& command, DriveOptions& options) {
  add_number(command, "--from", options.from_s, "Use the run from this t_s of the files on, in seconds", "S");
  add_number(command, "--to", options.to_s, "Use the run up to this t_s of the files, in seconds", "S");
}

void add_input(CLI::App& command, InputOptions& options) {
  command
      .add_option("DATASET", options.dataset,
                  "Folder of the drive (dataset.yaml, ranges.csv, odometry.csv, ...)")
      ->required();
  command.add_option("--calibration", options.calibration, "Calibration file that groma calibrate wrote")
      ->type_name("FILE")
      ->required();
  add_times(command, options.drive);
  add_number(command, "--plane", options.plane_z_m,
             "Instead of the surface: a horizontal plane at this height, in metres", "Z");
  const auto add_ids = [&](const char* name, std::vector<model::NodeId>& ids, const char* help) {
    command
        .add_option_function<std::string>(
            name,
            [&ids, name](const std::string& text) {
              ids = parse_list<model::NodeId>(name, text, "a list of ids such as 1,2");
            },
            help)
        ->type_name("IDS");
  };
  add_ids("--tags", options.drive.tags, "Use only the ranges of these tags, such as 1,2");
  add_ids("--anchors", options.drive.anchors, "Use only the ranges to these anchors, such as 5,8,12,14");
}

std::unique_ptr<Input> read_input(const InputOptions& options, bool with_truth, Warnings& warnings) {
  if (options.drive.from_s && options.drive.to_s && !(*options.drive.from_s < *options.drive.to_s)) {
    throw CLI::ValidationError(
        "--to", fmt::format("{} is not after --from {}", *options.drive.to_s, *options.drive.from_s));
  }
  return read_input(options.dataset, options.calibration, options.drive, options.plane_z_m, with_truth,
                    warnings);
}

struct RunOptions {
  InputOptions input;
  std::vector<std::string> methods;
  std::filesystem::path output;
  bool tuned = false;
  std::uint64_t seed = 1;
  bool json = false;
};

std::string format_anchors(const Site& site, const std::vector<AnchorRow>& rows) {
  std::string text = "t_s,anchor_id,x_m,y_m,z_m\n";
  for (const AnchorRow& row : rows) {
    text += fmt::format("{},{},{},{},{}\n", row.t_s, site.anchors()[row.anchor].id, row.position_m.x(),
                        row.position_m.y(), row.position_m.z());
  }
  return text;
}

int run_methods(const RunOptions& options) {
  std::vector<const MethodInfo*> chosen;
  for (const std::string& name : options.methods) {
    const MethodInfo* method = find_method(name);
    if (method == nullptr)
      throw CLI::ValidationError("--methods",
                                 fmt::format("there is no method '{}'; see groma-baselines list", name));
    chosen.push_back(method);
  }
  io::make_folder(options.output);
  Warnings warnings;
  const std::unique_ptr<Input> input = read_input(options.input, false, warnings);
  const Drive& drive = *input->drive;
  for (const MethodInfo* method : chosen) {
    const Parameters& parameters = options.tuned ? method->tuned : method->plain;
    const std::unique_ptr<Method> made = method->make(drive, parameters, options.seed);
    const Outcome outcome = run(drive, *made);
    expect_finite(options.input.dataset, method->name, outcome.rows);
    const std::filesystem::path path = options.output / fmt::format("{}.csv", method->name);
    io::write_file(path, io::format_estimate(outcome.rows));
    Json json{{"method", method->name},
              {"tuned", options.tuned},
              {"estimate", path.string()},
              {"rows", outcome.rows.size()},
              {"ranges", outcome.ranges},
              {"ranges_rejected", outcome.rejected},
              {"ns_per_range", outcome.ns_per_range},
              {"ns_per_odometry", outcome.ns_per_odometry},
              {"ns_in_all_per_range", outcome.ns_in_all_per_range},
              {"parameters", to_json(parameters, *method)}};
    if (!outcome.anchors.empty()) {
      const std::filesystem::path anchors = options.output / fmt::format("{}.anchors.csv", method->name);
      io::write_file(anchors, format_anchors(*input->site, outcome.anchors));
      json["anchors"] = anchors.string();
    }
    say(json.dump() + '\n');
    if (!options.json)
      complain(fmt::format("{}: {} poses from {} ranges, {:.3g} us a range", method->name,
                           outcome.rows.size(), outcome.ranges, outcome.ns_in_all_per_range / 1000.0));
  }
  return warnings.exit_code();
}

void add_run(CLI::App& app, Action& action) {
  const auto options = std::make_shared<RunOptions>();
  CLI::App* command = app.add_subcommand(
      "run",
      "Run methods over a recorded drive, causally, from the first pose prior (sigma 0.1 m, 0.05 rad). "
      "Prints one JSON object a line for each method.");
  add_input(*command, options->input);
  command->add_option("--methods", options->methods, "Methods by their names, separated by commas")
      ->delimiter(',')
      ->type_name("NAMES")
      ->required();
  command->add_option("-o,--output", options->output, "Folder for METHOD.csv of each method")
      ->type_name("DIR")
      ->required();
  command->add_flag("--tuned", options->tuned, "The parameters that groma-baselines tune found");
  command->add_option("--seed", options->seed, "Seed of the particles' random numbers. Default: 1")
      ->type_name("N");
  command->add_flag("--json", options->json, "Nothing but the JSON lines, errors and warnings");
  command->callback([options, &action] { action = [options] { return run_methods(*options); }; });
}

// ---- reference

struct ReferenceOptions {
  InputOptions input;
  std::vector<double> instants_s;
  std::filesystem::path output;
  std::optional<double> kernel;
  bool tuned = false;
  bool json = false;
};

int run_reference(const ReferenceOptions& options) {
  io::expect_writable(options.output);
  Warnings warnings;
  const std::unique_ptr<Input> input = read_input(options.input, false, warnings);
  const MethodInfo& method = *find_method("ceres-batch");
  Parameters parameters = options.tuned ? method.tuned : method.plain;
  parameters.kernel = options.kernel.value_or(parameters.kernel);
  CeresBatch reference(*input->drive, parameters, options.instants_s);
  const Outcome outcome = run(*input->drive, reference);
  if (outcome.rows.empty()) {
    throw io::DataError({options.input.dataset}, "no instant is within the drive",
                        "choose other --instants, in seconds of the files");
  }
  expect_finite(options.input.dataset, method.name, outcome.rows);
  io::write_file(options.output, io::format_estimate(outcome.rows));
  const double solves = static_cast<double>(outcome.rows.size());
  const double solve_s = outcome.ns_in_all_per_range * static_cast<double>(outcome.ranges) / solves * 1e-9;
  if (options.json) {
    say(Json{{"method", method.name},
             {"tuned", options.tuned},
             {"parameters", to_json(parameters, method)},
             {"estimate", options.output.string()},
             {"rows", outcome.rows.size()},
             {"ranges", outcome.ranges},
             {"s_per_solve", solve_s}}
            .dump() +
        '\n');
  } else {
    say(fmt::format("{} poses, {:.2f} s each, written to {}\n", outcome.rows.size(), solve_s,
                    options.output.string()));
  }
  return warnings.exit_code();
}

void add_reference(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ReferenceOptions>();
  CLI::App* command = app.add_subcommand(
      "reference", "The causal reference: a factor graph over all data up to each instant, solved by Ceres.");
  add_input(*command, options->input);
  command
      ->add_option_function<std::string>(
          "--instants",
          [options](const std::string& text) {
            options->instants_s = parse_list<double>("--instants", text, "a list of seconds such as 10,20.5");
          },
          "Times of the files, in seconds, separated by commas; each counts as the odometry sample before it")
      ->type_name("S,S,...")
      ->required();
  command->add_option("-o,--output", options->output, "Table to write, one row for each instant")
      ->type_name("FILE")
      ->required();
  command->add_flag("--tuned", options->tuned, "With a robust kernel against NLOS, as ceres-batch is tuned");
  add_number(*command, "--kernel", options->kernel,
             "Scale of the robust kernel, in sigmas of a range; 0: none. Default: that of the method", "K");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run_reference(*options); }; });
}

// ---- tune

struct TuneOptions {
  std::string method;
  DriveOptions drive;
  std::vector<std::string> runs;
  std::size_t draws = 40;
  std::uint64_t seed = 1;
};

struct Score {
  double ate_m = 0.0;  // mean over the runs of the mean ATE
  double nees = 0.0;
};

// A draw that fails in any run is infinitely bad.
Score score(const MethodInfo& method, const Parameters& parameters,
            const std::vector<std::unique_ptr<Input>>& inputs) {
  Score sum;
  for (const auto& input : inputs) {
    const std::unique_ptr<Method> made = method.make(*input->drive, parameters, 1);
    const Outcome outcome = run(*input->drive, *made);
    const auto evaluation =
        evaluation::evaluate(evaluation::pose_errors(outcome.rows, input->dataset.ground_truth));
    const double infinity = std::numeric_limits<double>::infinity();
    const bool good = evaluation && std::isfinite(evaluation->ate_m.mean);
    sum.ate_m += (good ? evaluation->ate_m.mean : infinity) / static_cast<double>(inputs.size());
    sum.nees +=
        (good && evaluation->nees ? evaluation->nees->mean : infinity) / static_cast<double>(inputs.size());
  }
  return sum;
}

int tune(const TuneOptions& options) {
  const MethodInfo* method = find_method(options.method);
  if (method == nullptr)
    throw CLI::ValidationError(
        "METHOD", fmt::format("there is no method '{}'; see groma-baselines list", options.method));
  Warnings warnings;
  std::vector<std::unique_ptr<Input>> inputs;
  for (const std::string& text : options.runs) {
    const std::size_t at = text.find('=');
    if (at == std::string::npos)
      throw CLI::ValidationError("--runs", fmt::format("'{}' is not DATASET=CALIBRATION", text));
    inputs.push_back(
        read_input(text.substr(0, at), text.substr(at + 1), options.drive, std::nullopt, true, warnings));
    if (inputs.back()->dataset.ground_truth.empty())
      throw io::DataError({text.substr(0, at)}, "there is no groundtruth.csv", "tune on runs that have one");
  }
  Random random(options.seed);
  Parameters best = method->plain;
  Score best_score = score(*method, best, inputs);
  const auto print = [&](const Parameters& parameters, const Score& of, const std::string& draw) {
    Json json{
        {"draw", draw}, {"parameters", to_json(parameters, *method)}, {"ate_m", of.ate_m}, {"nees", of.nees}};
    say(json.dump() + '\n');
  };
  print(best, best_score, "plain");
  for (std::size_t draw = 1; draw <= options.draws; ++draw) {
    Parameters parameters = method->plain;
    for (const Searched& searched : method->searched) {
      parameters.*searched.value =
          searched.least * std::pow(searched.most / searched.least, random.uniform());
    }
    const Score of = score(*method, parameters, inputs);
    print(parameters, of, std::to_string(draw));
    if (of.ate_m < best_score.ate_m) {
      best = parameters;
      best_score = of;
    }
  }
  print(best, best_score, "best");
  return warnings.exit_code();
}

void add_tune(CLI::App& app, Action& action) {
  const auto options = std::make_shared<TuneOptions>();
  CLI::App* command = app.add_subcommand(
      "tune",
      "Search a method's parameters on runs with ground truth. Each draw is uniform on a logarithmic "
      "scale; the best has the least mean over the runs of the mean position error (ATE). Prints the "
      "figures of each draw, one JSON object a line; the last is the best.");
  command->add_option("METHOD", options->method, "Its name")->required();
  command->add_option("--runs", options->runs, "Drives with their calibration files")
      ->type_name("DATASET=CALIBRATION")
      ->required();
  add_times(*command, options->drive);
  command->add_option("--draws", options->draws, "Number of draws besides the plain parameters. Default: 40")
      ->type_name("N");
  command->add_option("--seed", options->seed, "Seed of the draws. Default: 1")->type_name("N");
  command->callback([options, &action] { action = [options] { return tune(*options); }; });
}

int run_program(int argc, char** argv) {
  CLI::App app(
      "Baselines: the source paper's filters, trilateration, an iterated EKF, a particle filter and factor "
      "graphs, on the data sets and calibrations of groma.",
      "groma-baselines");
  help::prepare(
      app, 1,
      "Exit codes: 0 good, 2 usage, 3 done with warnings, 65 bad data or a result that is not usable,\n"
      "69 device or service unavailable, 77 permission, 78 bad configuration.");
  app.set_version_flag("--version", fmt::format("groma-baselines {}", io::program_version()));
  app.require_subcommand(1);
  Action action;
  bool list_json = false;
  CLI::App* listing = app.add_subcommand("list", "List the methods, with a line each.");
  listing->add_flag("--json", list_json, "Print one JSON array");
  listing->callback([&] { action = [&list_json] { return list(list_json); }; });
  add_run(app, action);
  add_reference(app, action);
  add_tune(app, action);
  if (const std::optional<int> code = help::parse(app, argc, argv)) return *code;
  return action();
}

}  // namespace

}  // namespace groma::baseline

int main(int argc, char** argv) {
  std::signal(SIGPIPE, SIG_IGN);  // a closed pipe makes the write fail
  return groma::help::guarded([&] { return groma::baseline::run_program(argc, argv); },
                              [](std::string_view text) { groma::baseline::complain(std::string(text)); });
}
