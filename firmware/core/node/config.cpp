#include "firmware/core/node/config.hpp"

#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <utility>

#include "firmware/core/mcp2518fd/bit_timing.hpp"
#include "firmware/core/security/block_cipher.hpp"
#include "proto/crc32.hpp"

namespace groma::node {
namespace {

constexpr std::uint32_t kLargest16 = 0xFFFF;
constexpr std::uint32_t kBeforeTag = 100;

radio::Preamble preamble_of(groma_Preamble preamble) noexcept {
  if (preamble == groma_Preamble_PREAMBLE_64) return radio::Preamble::k64;
  return preamble == groma_Preamble_PREAMBLE_256 ? radio::Preamble::k256 : radio::Preamble::k128;
}

// The schedule need not list the id, but must not list it for the other role.
bool id_fits(const groma_Config& config) noexcept {
  if (config.id == mac::kNobody || config.id >= mac::kBroadcast) return false;
  const groma_Schedule& schedule = config.schedule;
  const bool tag = config.role == groma_Role_ROLE_TAG;
  const auto* others = tag ? schedule.anchor_ids : schedule.tag_ids;
  const auto* end = others + (tag ? schedule.anchor_ids_count : schedule.tag_ids_count);
  return std::find(others, end, config.id) == end;
}

template <class T>
std::optional<T> unless_zero(std::uint32_t value) noexcept {
  if (value == 0) return std::nullopt;
  return static_cast<T>(value);
}

}  // namespace

const char* fault_of(const groma_Config& config) noexcept {
  const std::uint32_t role = mac::number_of(config.role);
  if (role != groma_Role_ROLE_ANCHOR && role != groma_Role_ROLE_TAG) return "role: ANCHOR or TAG";
  if (config.network_id >= kLargest16) return "network_id: 0 to 65534";
  if (!config.has_schedule) return "schedule: missing";
  if (const char* const fault = mac::fault_of(config.schedule); *fault != '\0') return fault;
  if (!id_fits(config)) return "id: 1 to 65534, not in the schedule for the other role";
  if (mac::number_of(config.preamble) > _groma_Preamble_MAX) return "preamble: 64, 128 or 256";
  if (config.transmit_antenna_delay_dtu > kLargest16) return "transmit_antenna_delay_dtu: 0 to 65535";
  if (config.receive_antenna_delay_dtu > kLargest16) return "receive_antenna_delay_dtu: 0 to 65535";
  if (mac::number_of(config.link) > _groma_Link_MAX) return "link: UART, CAN or CAN_FD";
  if (config.network_key.size != 0 && config.network_key.size != security::kBlockBytes)
    return "network_key: 16 bytes, or none";
  if (config.network_key_hash != 0 && config.network_key.size == 0)
    return "network_key: missing, and this node has a different one";
  if (config.can_nominal_bit_per_s != 0 && !mcp2518fd::nominal_timing(config.can_nominal_bit_per_s))
    return "can_nominal_bit_per_s: such as 1000000, 500000, 250000, 125000";
  if (config.can_data_bit_per_s != 0 && !mcp2518fd::data_timing(config.can_data_bit_per_s))
    return "can_data_bit_per_s: such as 1000000, 2000000, 4000000, 5000000";
  return "";
}

std::size_t encode_config(const groma_Config& config, std::span<std::uint8_t> out,
                          const groma_Config* before) noexcept {
  pb_ostream_t stream = pb_ostream_from_buffer(out.data(), out.size());
  const bool fits = pb_encode(&stream, groma_Config_fields, &config) &&
                    (before == nullptr || (pb_encode_tag(&stream, PB_WT_STRING, kBeforeTag) &&
                                           pb_encode_submessage(&stream, groma_Config_fields, before)));
  return fits ? stream.bytes_written : 0;
}

std::optional<groma_Config> decode_config(std::span<const std::uint8_t> bytes) noexcept {
  std::optional<groma_Config> config(std::in_place);
  pb_istream_t stream = pb_istream_from_buffer(bytes.data(), bytes.size());
  if (!pb_decode(&stream, groma_Config_fields, &*config)) config.reset();
  return config;
}

std::span<const std::uint8_t> before_trial(std::span<const std::uint8_t> stored) noexcept {
  pb_istream_t stream = pb_istream_from_buffer(stored.data(), stored.size());
  pb_wire_type_t type{};
  std::uint32_t tag = 0;
  bool end = false;
  while (pb_decode_tag(&stream, &type, &tag, &end)) {
    if (tag != kBeforeTag || type != PB_WT_STRING) {
      if (!pb_skip_field(&stream, type)) return {};
      continue;
    }
    std::uint32_t size = 0;
    if (!pb_decode_varint32(&stream, &size) || size > stream.bytes_left) return {};
    return stored.last(stream.bytes_left).first(size);
  }
  return {};
}

std::span<const std::uint8_t> shown(std::span<std::uint8_t> stored) noexcept {
  pb_istream_t stream = pb_istream_from_buffer(stored.data(), stored.size());
  pb_wire_type_t type{};
  std::uint32_t tag = 0;
  bool end = false;
  std::size_t kept = 0;
  for (std::size_t begin = 0; pb_decode_tag(&stream, &type, &tag, &end) && pb_skip_field(&stream, type);) {
    const std::size_t next = stored.size() - stream.bytes_left;
    if (tag != kBeforeTag && tag != groma_Config_network_key_tag) {
      std::copy(stored.data() + begin, stored.data() + next, stored.data() + kept);
      kept += next - begin;
    }
    begin = next;
  }
  return stored.first(kept);
}

radio::Settings radio_settings(const groma_Config& config) noexcept {
  return {.preamble = preamble_of(config.preamble),
          .transmit_power = unless_zero<std::uint32_t>(config.transmit_power),
          .transmit_antenna_delay_dtu = unless_zero<std::uint16_t>(config.transmit_antenna_delay_dtu),
          .receive_antenna_delay_dtu = unless_zero<std::uint16_t>(config.receive_antenna_delay_dtu)};
}

std::uint32_t schedule_hash_of(const groma_Config& config) noexcept {
  return mac::schedule_hash(config.schedule, config.network_id, preamble_of(config.preamble));
}

std::uint32_t config_hash_of(const groma_Config& config) noexcept {
  std::array<std::uint8_t, kMaxConfigBytes> bytes{};
  return wire::crc32(shown(std::span(bytes).first(encode_config(config, bytes))));
}

}  // namespace groma::node
