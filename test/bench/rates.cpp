// Ranges per second over preambles, tags and anchors, measured on simulated sites:
//   rates             the tables of docs/measurements.md, as Markdown
//   rates NAME VALUE ...   one site, by the usual schedule except for what is named: tags, anchors, preamble,
//                     backups, turn_round_us, gap_us, guard_us, arm_ahead (0, 1), key (0, 1), final (0, 1:
//                     METHOD_DS_FINAL), raw (0, 1), seconds, threads; emulated (0, 1) with instruction
//                     (units; 4992 is a cycle) and spi_overhead_us
// Ranges and late frames count from when all tags have ranged with all anchors, at the latest after 20 s.
// Exit code 1: something was late or lost, or a pair had not ranged by then; 2: a wrong name or value.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <map>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

groma_Preamble preamble_of(int symbols) {
  switch (symbols) {
    case 64:
      return groma_Preamble_PREAMBLE_64;
    case 128:
      return groma_Preamble_PREAMBLE_128;
    case 256:
      return groma_Preamble_PREAMBLE_256;
    default:
      throw std::invalid_argument("preamble: 64, 128 or 256");
  }
}

std::string text_of(const SiteRate::Slacks& slacks) {
  constexpr std::array kKinds{"beacon", "shared", "poll", "response", "final"};
  std::string text;
  for (std::size_t i = 0; i < slacks.size(); ++i) {
    if (slacks[i]) text += std::string(" ") + kKinds[i] + " " + std::to_string(*slacks[i]);
  }
  return text;
}

// How long the site took to join, or how much of it did.
std::string text_of_join(const SiteRate& rate, int tags, int anchors) {
  std::array<char, 80> text{};
  if (rate.joined_s) {
    std::snprintf(text.data(), text.size(), "joined after %.1f s", *rate.joined_s);
  } else {
    std::snprintf(text.data(), text.size(), "after %.0f s %zu of %d pairs of tag and anchor had ranged",
                  kPatience_s, rate.pairs, tags * anchors);
  }
  return text.data();
}

void print(const SiteRate& rate, const SiteSettings& settings) {
  std::printf(
      "%.0f ranges/s of %.0f by the schedule, %.0f by air time alone; late: %d transmits, %d receives; %d "
      "reports lost, %d recoveries; %s; least slack in us: tags%s, anchors%s",
      rate.ranges_per_s, rate.schedule_per_s, rate.bound_per_s, rate.late_transmits, rate.late_receives,
      rate.reports_lost, rate.recoveries, text_of_join(rate, settings.tags, settings.anchors).c_str(),
      text_of(rate.tags_slack_us).c_str(), text_of(rate.anchors_slack_us).c_str());
  if (rate.instructions_per_range > 0.0) {
    std::printf("; %.0f instructions a range; processors busy for %.1f %% (tags) and %.1f %% (anchors)",
                rate.instructions_per_range, 100.0 * rate.tags_load, 100.0 * rate.anchors_load);
  }
  std::puts("");
}

bool have_image() {
  return std::filesystem::exists(test::shipped_image(".hex"));
}

// The values given by name; each name has to be asked for.
class Arguments {
 public:
  explicit Arguments(std::map<std::string, double> given) : given_(std::move(given)) {}
  double value(const std::string& name, double fallback) {
    known_ += known_.empty() ? name : ", " + name;
    const auto found = given_.find(name);
    if (found == given_.end()) return fallback;
    const double value = found->second;
    given_.erase(found);
    return value;
  }
  template <typename T>
  T whole(const std::string& name, T fallback) {
    return static_cast<T>(value(name, static_cast<double>(fallback)));
  }
  bool flag(const std::string& name) { return value(name, 0.0) != 0.0; }
  // Throws std::invalid_argument if a name was not asked for.
  void expect_all_known() const {
    if (!given_.empty())
      throw std::invalid_argument("no name " + given_.begin()->first + "; names: " + known_);
  }

 private:
  std::map<std::string, double> given_;
  std::string known_;
};

int one(Arguments given) {
  SiteSettings settings = fast_site(given.whole("tags", 3), given.whole("anchors", 12),
                                    preamble_of(given.whole("preamble", 128)), given.whole("backups", 2));
  settings.turn_round_us = given.whole("turn_round_us", settings.turn_round_us);
  settings.response_gap_us = given.whole("gap_us", settings.response_gap_us);
  settings.guard_us = given.whole("guard_us", settings.guard_us);
  settings.arm_ahead = given.flag("arm_ahead");
  if (given.flag("key")) settings = with_key(settings);
  if (given.flag("final")) settings.method = groma_RangingMethod_METHOD_DS_FINAL;
  settings.raw_stamps = given.flag("raw");
  EmulatorOptions options;
  options.timing.instruction = given.whole("instruction", options.timing.instruction);
  options.spi_overhead =
      from_seconds(1e-6 * given.value("spi_overhead_us", 1e6 * to_seconds(options.spi_overhead)));
  if (given.flag("emulated")) settings = emulating(settings, options);
  const double seconds = given.value("seconds", 5.0);
  const auto threads = given.whole("threads", 1U);
  given.expect_all_known();
  const SiteRate rate = measure_rate(settings, seconds, threads);
  print(rate, settings);
  return rate.joined_s && rate.late_transmits == 0 && rate.late_receives == 0 && rate.reports_lost == 0 ? 0
                                                                                                        : 1;
}

constexpr double kSeconds = 1.0;

unsigned threads() {
  return std::max(1U, std::thread::hardware_concurrency());
}

SiteRate rate_of(int preamble, int tags, int anchors, bool emulated) {
  SiteSettings settings = fast_site(tags, anchors, preamble_of(preamble));
  if (emulated) settings = emulating(settings);
  return measure_rate(settings, kSeconds, threads());
}

void table_of_image() {
  struct Row {
    int preamble;
    int tags;
    int anchors;
  };
  std::puts(
      "| preamble | tags | anchors | measured /s | schedule /s | air time alone /s | late transmits | "
      "reports lost |\n|---|---|---|---|---|---|---|---|");
  for (const Row& row : {Row{128, 3, 12}, Row{128, 1, 12}, Row{128, 10, 12}, Row{128, 3, 4}, Row{128, 3, 16},
                         Row{128, 1, 4}, Row{128, 10, 16}, Row{64, 3, 12}, Row{256, 3, 12}}) {
    const SiteRate rate = rate_of(row.preamble, row.tags, row.anchors, true);
    std::printf("| %d | %d | %d | %.0f | %.0f | %.0f | %d | %d |\n", row.preamble, row.tags, row.anchors,
                rate.ranges_per_s, rate.schedule_per_s, rate.bound_per_s, rate.late_transmits,
                rate.reports_lost);
    std::fflush(stdout);
  }
}

// What is left if an instruction costs more than assumed, or less.
void table_of_processors() {
  std::puts(
      "| cycles an instruction | usual | with a key | arm-ahead | arm-ahead, with a key "
      "|\n|---|---|---|---|---|");
  const std::array sites{fast_site(), with_key(fast_site()), arming_ahead(fast_site()),
                         arming_ahead(with_key(fast_site()))};
  for (const double cycles : {1.25, 1.5, 2.0, 2.5, 3.0, 3.5}) {
    std::printf("| %.2f |", cycles);
    for (const SiteSettings& site : sites) {
      EmulatorOptions options;
      options.timing.instruction = std::llround(cycles * static_cast<double>(options.timing.cycle));
      const SiteRate rate = measure_rate(emulating(site, options), kSeconds, threads());
      std::printf(" %.0f, late %d and %d, %s |", rate.ranges_per_s, rate.late_transmits, rate.late_receives,
                  text_of_join(rate, site.tags, site.anchors).c_str());
      std::fflush(stdout);
    }
    std::puts("");
  }
}

void table_of_grid() {
  constexpr std::array<int, 4> kAnchors{4, 8, 12, 16};
  int late = 0;
  int lost = 0;
  std::fputs("| preamble | tags |", stdout);
  for (const int anchors : kAnchors) std::printf(" %d anchors |", anchors);
  std::puts("\n|---|---|---|---|---|---|");
  for (const int preamble : {64, 128, 256}) {
    for (int tags = 1; tags <= 10; ++tags) {
      std::printf("| %d | %d |", preamble, tags);
      for (const int anchors : kAnchors) {
        const SiteRate rate = rate_of(preamble, tags, anchors, false);
        late += rate.late_transmits;
        lost += rate.reports_lost;
        std::printf(" %.0f of %.0f, %.0f |", rate.ranges_per_s, rate.schedule_per_s, rate.bound_per_s);
        std::fflush(stdout);
      }
      std::puts("");
    }
  }
  std::printf("\nLate transmits in all of it: %d, reports lost: %d.\n", late, lost);
}

int tables() {
  if (have_image()) {
    std::puts("The shipped image in each node:\n");
    table_of_image();
    std::puts(
        "\nThe shipped image by the cost of an instruction, 3 tags, 12 anchors; late transmissions and "
        "listenings:\n");
    table_of_processors();
  } else {
    std::puts("No image: cmake --preset dwm1001 && cmake --build --preset dwm1001");
  }
  std::puts("\nNative nodes, measured of schedule, air time alone:\n");
  table_of_grid();
  return 0;
}

}  // namespace
}  // namespace groma::sim

int main(int argc, char** argv) {
  try {
    if (argc == 1) return groma::sim::tables();
    if (argc % 2 == 0) throw std::invalid_argument(std::string("no value for ") + argv[argc - 1]);
    std::map<std::string, double> given;
    for (int i = 1; i < argc; i += 2) {
      char* end = nullptr;
      given[argv[i]] = std::strtod(argv[i + 1], &end);
      if (end == argv[i + 1] || *end != '\0')
        throw std::invalid_argument(std::string(argv[i]) + ": not a number: " + argv[i + 1]);
    }
    return groma::sim::one(groma::sim::Arguments(std::move(given)));
  } catch (const std::exception& error) {
    std::fprintf(stderr, "rates: %s\n", error.what());
    return 2;
  }
}
