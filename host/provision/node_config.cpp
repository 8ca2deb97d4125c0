#include "host/provision/node_config.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cstddef>
#include <iterator>
#include <span>
#include <string_view>

#include "host/io/input_file.hpp"
#include "host/link/report_decoder.hpp"

namespace groma::provision {

namespace {

groma_Preamble preamble_of(unsigned symbols) {
  if (symbols == 64) return groma_Preamble_PREAMBLE_64;
  return symbols == 256 ? groma_Preamble_PREAMBLE_256 : groma_Preamble_PREAMBLE_128;
}

template <typename T, std::size_t N>
pb_size_t copy_ids(const std::vector<T>& ids, T (&out)[N]) {
  const std::size_t count = std::min(ids.size(), N);
  std::copy_n(ids.begin(), count, out);
  return static_cast<pb_size_t>(count);
}

class Comparison {
 public:
  template <typename T>
  void compare(std::string_view name, const T& is, const T& should_be) {
    if (is != should_be) add(name, fmt::format("{}", is), fmt::format("{}", should_be));
  }
  template <typename T>
  void compare_ids(std::string_view name, std::span<const T> is, std::span<const T> should_be) {
    if (!std::equal(is.begin(), is.end(), should_be.begin(), should_be.end())) {
      add(name, fmt::format("[{}]", fmt::join(is, ", ")), fmt::format("[{}]", fmt::join(should_be, ", ")));
    }
  }
  [[nodiscard]] const std::string& text() const { return text_; }

 private:
  void add(std::string_view name, const std::string& is, const std::string& should_be) {
    if (!text_.empty()) text_ += "; ";
    text_ += fmt::format("{}: {}, not {}", name, is, should_be);
  }

  std::string text_;
};

// A repeated field of the schema: an array and the number of its valid elements.
template <typename T, std::size_t N>
std::span<const T> counted(const T (&values)[N], std::size_t count) {
  return std::span(values).first(std::min(count, N));
}

// As the schema defines network_key_hash.
std::uint32_t hash_of(const NetworkKey& key) {
  std::string bytes = "groma network key";
  bytes.append(key.begin(), key.end());
  constexpr std::size_t kDigits = 8;
  return static_cast<std::uint32_t>(std::stoul(io::sha256(bytes).substr(0, kDigits), nullptr, 16));
}

}  // namespace

std::vector<model::NodeId> first_backups(const SiteSettings& site, std::size_t count) {
  std::vector<model::NodeId> backups;
  for (const model::NodeId id : site.anchor_ids) {
    if (id != site.master_id && backups.size() < count) backups.push_back(id);
  }
  return backups;
}

groma_Config config_of(const SiteSettings& site, groma_Role role, model::NodeId id) {
  groma_Config config = groma_Config_init_zero;
  config.role = role;
  config.id = id;
  config.network_id = site.network_id;
  config.preamble = preamble_of(site.preamble_symbols);
  config.transmit_antenna_delay_dtu = site.transmit_antenna_delay_dtu;
  config.receive_antenna_delay_dtu = site.receive_antenna_delay_dtu;
  config.transmit_power = site.transmit_power;
  config.report_raw_stamps = site.report_raw_stamps;
  config.correct_temperature = site.correct_temperature;
  config.correct_power_bias = site.correct_power_bias;
  config.link = site.link;
  config.can_nominal_bit_per_s = site.can_nominal_bit_per_s;
  config.can_data_bit_per_s = site.can_data_bit_per_s;
  if (site.network_key) {
    config.network_key.size = static_cast<pb_size_t>(site.network_key->size());
    std::copy(site.network_key->begin(), site.network_key->end(), config.network_key.bytes);
    config.network_key_hash = hash_of(*site.network_key);
  }
  config.has_schedule = true;
  groma_Schedule& schedule = config.schedule;
  schedule.epoch = site.epoch;
  schedule.master_id = site.master_id;
  schedule.tag_ids_count = copy_ids(site.tag_ids, schedule.tag_ids);
  schedule.anchor_ids_count = copy_ids(site.anchor_ids, schedule.anchor_ids);
  schedule.backup_ids_count = copy_ids(site.backup_ids, schedule.backup_ids);
  schedule.tag_slots_count = copy_ids(site.tag_slots, schedule.tag_slots);
  schedule.slots = site.slots;
  schedule.responses = site.responses;
  schedule.method = site.method;
  schedule.turn_round_us = site.turn_round_us;
  schedule.response_gap_us = site.response_gap_us != 0
                                 ? site.response_gap_us
                                 : mac::usual_gap_us(site.arm_ahead, site.network_key.has_value());
  schedule.guard_us = site.guard_us;
  schedule.arm_ahead = site.arm_ahead;
  return config;
}

std::string differences(const groma_Config& is, const groma_Config& should_be) {
  using link::number_in;
  Comparison fields;
  fields.compare("role", number_in(is.role), number_in(should_be.role));
  fields.compare("id", is.id, should_be.id);
  fields.compare("network_id", is.network_id, should_be.network_id);
  fields.compare("preamble", number_in(is.preamble), number_in(should_be.preamble));
  fields.compare("transmit_antenna_delay_dtu", is.transmit_antenna_delay_dtu,
                 should_be.transmit_antenna_delay_dtu);
  fields.compare("receive_antenna_delay_dtu", is.receive_antenna_delay_dtu,
                 should_be.receive_antenna_delay_dtu);
  fields.compare("transmit_power", is.transmit_power, should_be.transmit_power);
  fields.compare("report_raw_stamps", is.report_raw_stamps, should_be.report_raw_stamps);
  fields.compare("correct_temperature", is.correct_temperature, should_be.correct_temperature);
  fields.compare("correct_power_bias", is.correct_power_bias, should_be.correct_power_bias);
  fields.compare("link", number_in(is.link), number_in(should_be.link));
  fields.compare("can_nominal_bit_per_s", is.can_nominal_bit_per_s, should_be.can_nominal_bit_per_s);
  fields.compare("can_data_bit_per_s", is.can_data_bit_per_s, should_be.can_data_bit_per_s);
  // The key itself is not read back.
  fields.compare("network_key_hash", is.network_key_hash, should_be.network_key_hash);
  fields.compare("has schedule", is.has_schedule, should_be.has_schedule);
  if (is.has_schedule && should_be.has_schedule) {
    const groma_Schedule& a = is.schedule;
    const groma_Schedule& b = should_be.schedule;
    fields.compare("schedule.epoch", a.epoch, b.epoch);
    fields.compare("schedule.master_id", a.master_id, b.master_id);
    fields.compare_ids("schedule.tag_ids", counted(a.tag_ids, a.tag_ids_count),
                       counted(b.tag_ids, b.tag_ids_count));
    fields.compare_ids("schedule.anchor_ids", counted(a.anchor_ids, a.anchor_ids_count),
                       counted(b.anchor_ids, b.anchor_ids_count));
    fields.compare_ids("schedule.backup_ids", counted(a.backup_ids, a.backup_ids_count),
                       counted(b.backup_ids, b.backup_ids_count));
    fields.compare_ids("schedule.tag_slots", counted(a.tag_slots, a.tag_slots_count),
                       counted(b.tag_slots, b.tag_slots_count));
    fields.compare("schedule.slots", a.slots, b.slots);
    fields.compare("schedule.responses", a.responses, b.responses);
    fields.compare("schedule.method", number_in(a.method), number_in(b.method));
    fields.compare("schedule.turn_round_us", a.turn_round_us, b.turn_round_us);
    fields.compare("schedule.response_gap_us", a.response_gap_us, b.response_gap_us);
    fields.compare("schedule.guard_us", a.guard_us, b.guard_us);
    fields.compare("schedule.arm_ahead", a.arm_ahead, b.arm_ahead);
  }
  return fields.text();
}

}  // namespace groma::provision
