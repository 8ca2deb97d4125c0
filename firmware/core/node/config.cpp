#include "firmware/core/node/config.hpp"

#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>

#include "firmware/core/mac/wire_enum.hpp"
#include "firmware/core/mcp2518fd/bit_timing.hpp"
#include "proto/crc32.hpp"

namespace groma::node {
namespace {

constexpr std::uint32_t kLargest16 = 0xFFFF;

dw1000::Preamble preamble_of(groma_Preamble preamble) noexcept {
  switch (preamble) {
    case groma_Preamble_PREAMBLE_64:
      return dw1000::Preamble::k64;
    case groma_Preamble_PREAMBLE_256:
      return dw1000::Preamble::k256;
    default:
      return dw1000::Preamble::k128;
  }
}

bool lists_own_id(const groma_Config& config) noexcept {
  const groma_Schedule& schedule = config.schedule;
  const bool tag = config.role == groma_Role_ROLE_TAG;
  const auto* ids = tag ? schedule.tag_ids : schedule.anchor_ids;
  const auto* end = ids + (tag ? schedule.tag_ids_count : schedule.anchor_ids_count);
  return std::find(ids, end, config.id) != end;
}

std::optional<std::uint16_t> delay_of(std::uint32_t delay_dtu) noexcept {
  if (delay_dtu == 0) return std::nullopt;
  return static_cast<std::uint16_t>(delay_dtu);
}

}  // namespace

const char* fault_of(const groma_Config& config) noexcept {
  const std::uint32_t role = mac::number_of(config.role);
  if (role != groma_Role_ROLE_ANCHOR && role != groma_Role_ROLE_TAG) return "role: ANCHOR or TAG";
  if (config.network_id >= kLargest16) return "network_id: 0 to 65534";
  if (!config.has_schedule) return "schedule: missing";
  if (const auto fault = mac::check(config.schedule); fault != mac::ScheduleFault::kNone) {
    return mac::describe(fault);
  }
  if (!lists_own_id(config)) return "id: among the schedule's ids of its role";
  if (mac::number_of(config.preamble) > _groma_Preamble_MAX) return "preamble: 64, 128 or 256";
  if (config.transmit_antenna_delay_dtu > kLargest16) return "transmit_antenna_delay_dtu: 0 to 65535";
  if (config.receive_antenna_delay_dtu > kLargest16) return "receive_antenna_delay_dtu: 0 to 65535";
  if (mac::number_of(config.link) > _groma_Link_MAX) return "link: UART, CAN or CAN_FD";
  if (config.can_nominal_bit_per_s != 0 && !mcp2518fd::nominal_timing(config.can_nominal_bit_per_s)) {
    return "can_nominal_bit_per_s: such as 1000000, 500000, 250000, 125000";
  }
  if (config.can_data_bit_per_s != 0 && !mcp2518fd::data_timing(config.can_data_bit_per_s)) {
    return "can_data_bit_per_s: such as 1000000, 2000000, 4000000, 5000000";
  }
  return "";
}

std::size_t encode_config(const groma_Config& config, std::span<std::uint8_t> out) noexcept {
  pb_ostream_t stream = pb_ostream_from_buffer(out.data(), out.size());
  return pb_encode(&stream, groma_Config_fields, &config) ? stream.bytes_written : 0;
}

std::optional<groma_Config> decode_config(std::span<const std::uint8_t> bytes) noexcept {
  groma_Config config = groma_Config_init_zero;
  pb_istream_t stream = pb_istream_from_buffer(bytes.data(), bytes.size());
  if (!pb_decode(&stream, groma_Config_fields, &config)) return std::nullopt;
  return config;
}

dw1000::RadioSettings radio_settings(const groma_Config& config) noexcept {
  return {
      .preamble = preamble_of(config.preamble),
      .transmit_power = config.transmit_power == 0 ? dw1000::kDefaultTransmitPower : config.transmit_power,
      .transmit_antenna_delay_dtu = delay_of(config.transmit_antenna_delay_dtu),
      .receive_antenna_delay_dtu = delay_of(config.receive_antenna_delay_dtu)};
}

mac::Site site_of(const groma_Config& config, ranging::Ticks transmit_antenna_delay) noexcept {
  return {.id = static_cast<std::uint16_t>(config.id),
          .network_id = static_cast<std::uint16_t>(config.network_id),
          .preamble = preamble_of(config.preamble),
          .schedule = config.schedule,
          .transmit_antenna_delay = transmit_antenna_delay};
}

std::uint32_t schedule_hash_of(const groma_Config& config) noexcept {
  return mac::schedule_hash(config.schedule, config.network_id, preamble_of(config.preamble));
}

std::uint32_t config_hash_of(const groma_Config& config) noexcept {
  std::array<std::uint8_t, kMaxConfigBytes> bytes{};
  return wire::crc32(std::span(bytes).first(encode_config(config, bytes)));
}

}  // namespace groma::node
