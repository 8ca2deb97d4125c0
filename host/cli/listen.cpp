// groma listen: shows a tag's ranges live.
#include <fmt/format.h>
#include <poll.h>

#include <array>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>

#include <CLI/CLI.hpp>

#include "groma.pb.h"
#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/stop_signal.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/exit_code.hpp"
#include "host/link/byte_link.hpp"
#include "host/link/report_decoder.hpp"
#include "host/model/types.hpp"

namespace groma::cli {

namespace {

struct ListenOptions {
  std::string link;
  unsigned baud = 1'000'000;
  double for_s = 5.0;
  bool rows = false;
  bool json = false;
};

// Mean and spread of one pair's ranges (Welford).
struct PairRanges {
  std::uint64_t count = 0;
  double mean_m = 0.0;
  double squares_m2 = 0.0;
  double power_dbm = 0.0;
  std::uint64_t los_known = 0;   // ranges with a line-of-sight hint
  std::uint64_t los_likely = 0;  // ranges whose hint says that LOS is likely

  void add(const model::RangeSample& range) {
    ++count;
    const double off_m = range.range_m - mean_m;
    mean_m += off_m / static_cast<double>(count);
    squares_m2 += off_m * (range.range_m - mean_m);
    power_dbm += (static_cast<double>(range.receive_power_dbm) - power_dbm) / static_cast<double>(count);
    los_known += range.line_of_sight != model::LineOfSight::kNotKnown ? 1 : 0;
    los_likely += range.line_of_sight == model::LineOfSight::kLikely ? 1 : 0;
  }
  // Share of the ranges with a hint for which LOS is likely; NaN if no range has a hint.
  [[nodiscard]] double los_share() const {
    return static_cast<double>(los_likely) / static_cast<double>(los_known);
  }
  [[nodiscard]] double std_m() const {
    return count > 1 ? std::sqrt(squares_m2 / static_cast<double>(count - 1)) : 0.0;
  }
};

std::string known(float value, int decimals) {
  return std::isfinite(value) ? fmt::format("{:.{}f}", value, decimals) : std::string();
}

class Listener : public link::NodeSink {
 public:
  explicit Listener(bool rows) : rows_(rows) {
    if (rows_) {
      say("t_s,tag_id,anchor_id,range_m,first_path_power_dbm,receive_power_dbm,clock_offset_ppm,noise,"
          "line_of_sight,corrections,network_time_dtu\n");
    }
  }
  void on_range(const model::RangeSample& range) override {
    pairs[{range.tag_id, range.anchor_id}].add(range);
    if (!rows_) return;
    const std::string network_time =
        range.network_time_dtu != 0 ? fmt::format("{}", range.network_time_dtu) : std::string();
    say(fmt::format("{:.6f},{},{},{:.4f},{},{},{},{},{},{},{}\n", range.t_s, range.tag_id, range.anchor_id,
                    range.range_m, known(range.first_path_power_dbm, 1), known(range.receive_power_dbm, 1),
                    known(range.clock_offset_ppm, 3), known(range.noise, 0),
                    static_cast<unsigned>(range.line_of_sight), range.corrections, network_time));
  }
  void on_network_status(const groma_NetworkStatus& received) override { status = received; }

  std::map<std::pair<model::NodeId, model::NodeId>, PairRanges> pairs;  // tag, anchor
  std::optional<groma_NetworkStatus> status;

 private:
  bool rows_;
};

int exit_code_of(link::LinkFault fault) {
  return fault == link::LinkFault::kPermission ? io::kNoPermission : io::kUnavailable;
}

Json to_json(const Listener& listener, const link::ReportDecoder& decoder, double for_s) {
  Json pairs = Json::array();
  for (const auto& [ids, pair] : listener.pairs) {
    pairs.push_back(
        {{"tag", ids.first},
         {"anchor", ids.second},
         {"ranges", pair.count},
         {"mean_m", pair.mean_m},
         {"std_m", pair.std_m()},
         {"receive_power_dbm", std::isfinite(pair.power_dbm) ? Json(pair.power_dbm) : Json(nullptr)},
         {"sight", std::isfinite(pair.los_share()) ? Json(pair.los_share()) : Json(nullptr)}});
  }
  const auto& status = listener.status;
  const bool has_temperature = status && status->has_temperature_cdegc;
  const bool has_supply = status && status->has_supply_mv;
  return {{"for_s", for_s},
          {"sync", listener.status ? Json(link::sync_word(listener.status->state)) : Json(nullptr)},
          {"master", listener.status ? Json(listener.status->master_id) : Json(nullptr)},
          {"slot", status && status->has_slot ? Json(status->slot) : Json(nullptr)},
          {"candidates", status ? Json(status->candidates) : Json(nullptr)},
          {"answering", status ? Json(status->answering) : Json(nullptr)},
          {"temperature_c", has_temperature ? Json(status->temperature_cdegc / 100.0) : Json(nullptr)},
          {"supply_v", has_supply ? Json(status->supply_mv / 1000.0) : Json(nullptr)},
          {"ranges", decoder.counters().ranges},
          {"ranges_failed", decoder.counters().ranges_not_ok},
          {"frames_lost", decoder.counters().frames_lost},
          {"pairs", pairs}};
}

// The tag's status as one line; empty if no status was received.
std::string status_line(const Listener& listener) {
  if (!listener.status) return {};
  const groma_NetworkStatus& status = *listener.status;
  std::string line = status.has_slot ? fmt::format("slot {}", status.slot) : "no slot";
  line += fmt::format(", {} of {} anchors answer", status.answering, status.candidates);
  if (status.has_temperature_cdegc)
    line += fmt::format(", chip at {:.1f} °C", status.temperature_cdegc / 100.0);
  if (status.has_supply_mv) line += fmt::format(", {:.2f} V", status.supply_mv / 1000.0);
  return line + "\n";
}

// Prints why there was no range and what to do; returns the exit code.
int complain_of_no_ranges(const ListenOptions& options, const Listener& listener, std::uint64_t bytes) {
  if (bytes == 0) {
    complain(fmt::format("{}: no byte received; run 'groma identify {}' for the reason", options.link,
                         options.link));
    return io::kUnavailable;
  }
  if (!listener.status) {
    complain(fmt::format(
        "{}: no range received, and no status; check that it is a configured node ('groma identify {}')",
        options.link, options.link));
    return io::kDoneWithWarnings;
  }
  if (listener.status->state == groma_SyncState_SYNC_SEARCHING) {
    complain(fmt::format(
        "{}: no range received, because the node hears no beacon; check that the master is configured with "
        "the same plan, has power, and is in reach",
        options.link));
    return io::kDoneWithWarnings;
  }
  complain(fmt::format(
      "{}: synchronized to master {}, but no range received; is it a tag, and are there anchors in reach?",
      options.link, listener.status->master_id));
  return io::kDoneWithWarnings;
}

int run(const ListenOptions& options) {
  using Clock = std::chrono::steady_clock;
  const link::OpenedLink opened = link::open_link(options.link, options.baud);
  if (!opened.link) {
    complain(opened.error.message);
    return exit_code_of(opened.error.fault);
  }
  const volatile std::sig_atomic_t& stop = stop_on_signals();
  Listener listener(options.rows && !options.json);
  link::ReportDecoder decoder(options.baud);
  std::uint64_t bytes = 0;
  bool gone = false;
  const Clock::time_point begin = Clock::now();
  double elapsed_s = 0.0;
  while (stop == 0 && !gone && elapsed_s < options.for_s) {
    pollfd entry{opened.link->poll_fd(), POLLIN, 0};
    (void)::poll(&entry, 1, 20);
    std::array<std::uint8_t, 4096> chunk{};
    const link::ReadResult read = opened.link->read(chunk);
    const double now_s =
        std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
    decoder.take(std::span(chunk).first(read.bytes), now_s, listener);
    bytes += read.bytes;
    gone = read.gone;
    elapsed_s = std::chrono::duration<double>(Clock::now() - begin).count();
  }
  if (options.json) {
    say_json(to_json(listener, decoder, elapsed_s));
  } else if (!options.rows) {
    Table table({"tag", "anchor", "ranges", "per s", "mean m", "std m", "power dBm", "LOS"});
    for (const auto& [ids, pair] : listener.pairs) {
      table.add({fmt::format("{}", ids.first), fmt::format("{}", ids.second), fmt::format("{}", pair.count),
                 fmt::format("{:.0f}", static_cast<double>(pair.count) / elapsed_s),
                 fmt::format("{:.3f}", pair.mean_m), fmt::format("{:.3f}", pair.std_m()),
                 known(static_cast<float>(pair.power_dbm), 1),
                 std::isfinite(pair.los_share()) ? fmt::format("{:.0f} %", 100.0 * pair.los_share()) : "-"});
    }
    if (!listener.pairs.empty()) say(table.format() + status_line(listener));
  }
  if (gone) {
    complain(fmt::format("{}: the port went away; plug it in again", options.link));
    return io::kUnavailable;
  }
  return listener.pairs.empty() ? complain_of_no_ranges(options, listener, bytes) : io::kGood;
}

}  // namespace

void add_listen(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ListenOptions>();
  CLI::App* command = app.add_subcommand("listen", "Show the ranges that a tag measures, by anchor.");
  command->add_option("PORT", options->link, "Its port, such as /dev/ttyACM0 or can:can0/3")
      ->required()
      ->type_name("PORT");
  command->add_option("--baud", options->baud, "Bits per second of a serial port")
      ->capture_default_str()
      ->type_name("N");
  command->add_option("--for", options->for_s, "Duration in seconds")
      ->check(CLI::Range(0.1, 86'400.0))
      ->capture_default_str()
      ->type_name("S");
  command->add_flag("--rows", options->rows, "Print each range live, in the format of ranges.csv");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
