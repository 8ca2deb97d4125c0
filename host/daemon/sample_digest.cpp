#include "host/daemon/sample_digest.hpp"

#include <bit>
#include <cstddef>
#include <cstdint>

#include "host/io/input_file.hpp"

namespace groma::daemon {
namespace {

template <std::size_t kBytes>
void append_little_endian(std::string& out, std::uint64_t value) {
  for (std::size_t i = 0; i < kBytes; ++i) out.push_back(static_cast<char>(value >> (8 * i) & 0xFFU));
}

void append(std::string& out, double value) {
  append_little_endian<8>(out, std::bit_cast<std::uint64_t>(value));
}

}  // namespace

std::string sample_digest(std::span<const model::RangeSample> ranges,
                          std::span<const model::PoseSample> poses) {
  std::string bytes;
  for (const model::RangeSample& range : ranges) {
    append(bytes, range.t_s);
    append_little_endian<2>(bytes, range.tag_id);
    append_little_endian<2>(bytes, range.anchor_id);
    append(bytes, range.range_m);
  }
  for (const model::PoseSample& pose : poses) {
    for (const double value :
         {pose.t_s, pose.x_m, pose.y_m, pose.z_m, pose.yaw_rad, pose.roll_rad, pose.pitch_rad}) {
      append(bytes, value);
    }
    if (!pose.covariance) continue;
    for (const double term : *pose.covariance) append(bytes, term);
  }
  return io::sha256(bytes);
}

}  // namespace groma::daemon
