// Ranges a second over preambles, tags and anchors, measured on simulated sites:
//   rates             the tables of docs/results.md, as Markdown
//   rates NAME VALUE ...   one site; names: tags, anchors, preamble, turn_round_us, gap_us, guard_us,
//   seconds,
//                     emulated (0, 1), instruction (units, 6240 is 1.25 cycles), raw (0, 1), key (0, 1),
//                     final (0, 1: METHOD_DS_FINAL), threads
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <map>
#include <string>
#include <thread>

#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/emulator/site_rate.hpp"

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

// The shortest that the image keeps with room to spare: see docs/explanation/image.md.
SiteSettings fastest(int preamble, int tags, int anchors) {
  SiteSettings settings;
  settings.tags = tags;
  settings.anchors = anchors;
  settings.preamble = preamble_of(preamble);
  settings.method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  settings.turn_round_us = 300;
  settings.response_gap_us = 155;
  settings.guard_us = 20;
  settings.raw_stamps = false;
  return settings;
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
  SiteSettings settings = fastest(static_cast<int>(value("preamble", 128)),
                                  static_cast<int>(value("tags", 3)), static_cast<int>(value("anchors", 12)));
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

// The links would be the limit: one Mbaud carries the reports of some 1,600 ranges/s a tag.
void table(const char* title, bool emulated, double seconds, const std::vector<int>& tags,
           const std::vector<int>& anchors, const std::vector<int>& preambles) {
  std::printf(
      "\n%s\n\n| preamble | tags | anchors | measured /s | schedule /s | air time alone /s | measured of "
      "that | "
      "late transmits |\n|---|---|---|---|---|---|---|---|\n",
      title);
  const unsigned threads = std::max(1U, std::thread::hardware_concurrency());
  for (const int preamble : preambles)
    for (const int tag : tags)
      for (const int anchor : anchors) {
        SiteSettings settings = fastest(preamble, tag, anchor);
        if (emulated) settings = emulating(settings);
        const SiteRate rate = measure_rate(settings, seconds, 1.0, threads);
        std::printf("| %d | %d | %d | %.0f | %.0f | %.0f | %.0f %% | %d |\n", preamble, tag, anchor,
                    rate.ranges_per_s, rate.schedule_per_s, rate.bound_per_s,
                    100.0 * rate.ranges_per_s / rate.bound_per_s, rate.late_transmits);
        std::fflush(stdout);
      }
}

int tables() {
  const SiteSettings settings = fastest(128, 1, 1);
  std::printf("Turn-round %u us, %u us between RESPONSEs, guard %u us, 20 ppm clocks.\n",
              settings.turn_round_us, settings.response_gap_us, settings.guard_us);
  if (have_image()) {
    table("The shipped image in each node:", true, 3.0, {1, 3, 10}, {4, 12}, {64, 128, 256});
  } else {
    std::printf("\nNo image: cmake --preset dwm1001 && cmake --build --preset dwm1001\n");
  }
  table("Native nodes:", false, 3.0, {1, 2, 3, 5, 10}, {4, 8, 12, 16}, {64, 128, 256});
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
