// Ranges per second over preambles, tags and anchors, measured on simulated sites:
//   rates             the tables of docs/results.md, as Markdown
//   rates NAME VALUE ...   one site; names: tags, anchors, preamble, backups, turn_round_us, gap_us,
//                     guard_us, seconds, emulated (0, 1), instruction (units, 6240 is 1.25 cycles), raw (0,
//                     1), key (0, 1), final (0, 1: METHOD_DS_FINAL), threads
#include <algorithm>
#include <array>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <map>
#include <stdexcept>
#include <string>
#include <thread>
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

void print(const SiteRate& rate) {
  std::printf(
      "%.0f ranges/s of %.0f by the schedule, %.0f by air time alone; late: %d transmits, %d receives; %d "
      "reports lost, %d recoveries\n",
      rate.ranges_per_s, rate.schedule_per_s, rate.bound_per_s, rate.late_transmits, rate.late_receives,
      rate.reports_lost, rate.recoveries);
}

bool have_image() {
  return std::filesystem::exists(test::shipped_image(".hex"));
}

int one(const std::map<std::string, double>& given) {
  const auto value = [&](const char* name, double fallback) {
    const auto found = given.find(name);
    return found == given.end() ? fallback : found->second;
  };
  SiteSettings settings =
      fast_site(static_cast<int>(value("tags", 3)), static_cast<int>(value("anchors", 12)),
                preamble_of(static_cast<int>(value("preamble", 128))), static_cast<int>(value("backups", 2)));
  settings.turn_round_us = static_cast<std::uint32_t>(value("turn_round_us", settings.turn_round_us));
  settings.response_gap_us = static_cast<std::uint32_t>(value("gap_us", settings.response_gap_us));
  settings.guard_us = static_cast<std::uint32_t>(value("guard_us", settings.guard_us));
  settings.raw_stamps = value("raw", 0) != 0;
  if (value("key", 0) != 0)
    settings.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  if (value("final", 0) != 0) settings.method = groma_RangingMethod_METHOD_DS_FINAL;
  if (value("emulated", 0) != 0) {
    EmulatorOptions options;
    options.timing.instruction =
        static_cast<SimTime>(value("instruction", static_cast<double>(options.timing.instruction)));
    settings = emulating(settings, options);
  }
  const SiteRate rate =
      measure_rate(settings, value("seconds", 5), 1.0, static_cast<unsigned>(value("threads", 1)));
  print(rate);
  return rate.late_transmits == 0 && rate.reports_lost == 0 ? 0 : 1;
}

constexpr double kSeconds = 1.0;

SiteRate rate_of(int preamble, int tags, int anchors, bool emulated) {
  SiteSettings settings = fast_site(tags, anchors, preamble_of(preamble));
  if (emulated) settings = emulating(settings);
  return measure_rate(settings, kSeconds, 1.0, std::max(1U, std::thread::hardware_concurrency()));
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
    std::map<std::string, double> given;
    for (int i = 1; i + 1 < argc; i += 2) given[argv[i]] = std::strtod(argv[i + 1], nullptr);
    return groma::sim::one(given);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "rates: %s\n", error.what());
    return 2;
  }
}
