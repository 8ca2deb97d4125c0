#include "host/reproduce/runner.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <exception>
#include <mutex>
#include <thread>
#include <utility>

#include "host/io/input_file.hpp"
#include "host/io/output_file.hpp"
#include "host/io/version.hpp"
#include "host/reproduce/recorded.hpp"
#include "host/reproduce/sensitivity.hpp"
#include "host/reproduce/study.hpp"

namespace groma::reproduce {

namespace {

// What is computed at once: the results of one part for one seed, of one or several experiments.
struct Task {
  std::string phase;
  std::uint64_t seed = 0;
  std::string part;
  std::vector<std::string> experiments;
  std::function<Json(const Settings&)> run;  // by experiment
};

std::filesystem::path file_of(const Plan& plan, const std::string& experiment, const std::string& part,
                              std::uint64_t seed) {
  std::string name = part.empty() ? experiment : fmt::format("{}-{}", experiment, part);
  std::replace_if(
      name.begin(), name.end(), [](char c) { return c == ' ' || c == ',' || c == '/'; }, '_');
  return plan.folder / "runs" / fmt::format("{}-{}.json", name, seed);
}

// A result of this build, which may be null.
std::optional<Json> stored(const std::filesystem::path& file, bool has_baselines) {
  if (!std::filesystem::exists(file)) return std::nullopt;
  const Json json = Json::parse(io::read_file(file), nullptr, false);
  if (!json.is_object() || json.value("groma", "") != io::build_name() ||
      json.value("baselines", false) != has_baselines)
    return std::nullopt;
  return json.value("result", Json(nullptr));
}

bool contains(const std::vector<std::string>& all, std::string_view name) {
  return std::find(all.begin(), all.end(), name) != all.end();
}

std::vector<std::string> intersection(const std::vector<std::string>& wanted,
                                      std::initializer_list<const char*> of) {
  std::vector<std::string> out;
  for (const char* name : of) {
    if (contains(wanted, name)) out.emplace_back(name);
  }
  return out;
}

void add_simulated(const Plan& plan, std::vector<Task>& tasks) {
  const auto warehouse = intersection(plan.wanted, {"table1", "indoor", "table2", "anchor-states"});
  const auto add_warehouse = [&](const std::string& phase, std::uint64_t seed, const std::string& part) {
    if (warehouse.empty()) return;
    tasks.push_back({phase, seed, part, warehouse, [warehouse](const Settings& settings) {
                       return run_warehouse(settings, {warehouse.begin(), warehouse.end()});
                     }});
  };
  // The longest task first.
  if (plan.has_firmware) add_warehouse("warehouse with firmware", 1, kFirmware);
  for (std::uint64_t seed = 1; seed <= plan.seeds; ++seed) {
    add_warehouse("warehouse", seed, "");
    if (contains(plan.wanted, "table3")) {
      tasks.push_back({"forklift", seed, "", {"table3"}, [](const Settings& settings) {
                         return Json{{"table3", run_forklift(settings)}};
                       }});
    }
    if (contains(plan.wanted, "baselines")) {
      tasks.push_back({"baselines", seed, "", {"baselines"}, [](const Settings& settings) {
                         return Json{{"baselines", run_baselines(settings)}};
                       }});
    }
  }
}

void add_sensitivity(const Plan& plan, std::vector<Task>& tasks) {
  if (!contains(plan.wanted, "sensitivity")) return;
  constexpr std::size_t kMostSeeds = 10;
  for (const Factor& factor : factors()) {
    for (std::uint64_t seed = 1; seed <= std::min(plan.seeds, kMostSeeds); ++seed) {
      tasks.push_back({fmt::format("sensitivity to {}", factor.name),
                       seed,
                       factor.name,
                       {"sensitivity"},
                       [&factor](const Settings& settings) {
                         return Json{{"sensitivity", run_factor(factor, settings.seed)}};
                       }});
    }
  }
}

void add_recorded(const Plan& plan, std::vector<Task>& tasks) {
  if (!contains(plan.wanted, "recorded") || !plan.recorded) return;
  for (const RecordedRun& run : recorded_runs(*plan.recorded)) {
    tasks.push_back(
        {run.name, 1, run.name, {"recorded"}, [run, data = *plan.recorded](const Settings& settings) {
           return Json{{"recorded", run_recorded(run, data, settings)}};
         }});
  }
}

// A share of all tasks in each of several threads.
class Workers {
 public:
  Workers(const Plan& plan, std::vector<Task> tasks, const Baselines& baselines)
      : plan_(plan), tasks_(std::move(tasks)), baselines_(baselines) {}

  [[nodiscard]] Results run() {
    const unsigned count = std::max(1U, std::thread::hardware_concurrency());
    {
      std::vector<std::jthread> threads;
      for (unsigned i = 0; i < count; ++i) threads.emplace_back([this] { work(); });
    }
    if (failure_) std::rethrow_exception(failure_);
    return std::move(results_);
  }

 private:
  void work() {
    for (;;) {
      const std::size_t next = next_++;
      if (next >= tasks_.size()) return;
      try {
        do_task(tasks_[next]);
      } catch (...) {
        const std::scoped_lock lock(mutex_);
        if (!failure_) failure_ = std::current_exception();
        next_ = tasks_.size();
        return;
      }
    }
  }

  [[nodiscard]] std::optional<Json> stored_results(const Task& task) const {
    Json out = Json::object();
    for (const std::string& experiment : task.experiments) {
      std::optional<Json> result =
          stored(file_of(plan_, experiment, task.part, task.seed), baselines_.is_there());
      if (!result) return std::nullopt;
      out[experiment] = std::move(*result);
    }
    return out;
  }

  [[nodiscard]] Json compute(const Task& task) const {
    const std::filesystem::path scratch =
        plan_.folder / "scratch" / file_of(plan_, task.experiments[0], task.part, task.seed).stem();
    io::make_folder(scratch);
    Json out = task.run({.seed = task.seed,
                         .scratch = scratch,
                         .baselines = baselines_,
                         .has_curves = task.seed == 1,
                         .is_emulated = task.part == kFirmware});
    std::filesystem::remove_all(scratch);
    for (const std::string& experiment : task.experiments) {
      io::write_file(file_of(plan_, experiment, task.part, task.seed),
                     Json{{"groma", io::build_name()},
                          {"baselines", baselines_.is_there()},
                          {"result", out.value(experiment, Json(nullptr))}}
                         .dump());
    }
    return out;
  }

  void do_task(const Task& task) {
    const std::optional<Json> known = stored_results(task);
    const Json found = known ? *known : compute(task);
    const std::scoped_lock lock(mutex_);
    for (const std::string& experiment : task.experiments)
      results_[experiment][task.part][task.seed] = found.value(experiment, Json(nullptr));
    ++done_;
    if (plan_.progress)
      plan_.progress(task.phase, static_cast<double>(done_) / static_cast<double>(tasks_.size()));
  }

  const Plan& plan_;
  std::vector<Task> tasks_;
  const Baselines& baselines_;
  std::atomic<std::size_t> next_ = 0;
  std::mutex mutex_;
  Results results_;
  std::size_t done_ = 0;
  std::exception_ptr failure_;
};

}  // namespace

const std::vector<std::string>& experiments() {
  static const std::vector<std::string> all{"table1", "indoor",      "table2",    "anchor-states", "effort",
                                            "table3", "sensitivity", "baselines", "recorded"};
  return all;
}

Outcome run(const Plan& plan) {
  const Baselines baselines;
  std::vector<Task> tasks;
  add_simulated(plan, tasks);
  add_sensitivity(plan, tasks);
  add_recorded(plan, tasks);
  io::make_folder(plan.folder / "runs");
  Outcome out{.results = Workers(plan, std::move(tasks), baselines).run(),
              .has_baselines = baselines.is_there()};
  std::filesystem::remove_all(plan.folder / "scratch");
  return out;
}

}  // namespace groma::reproduce
