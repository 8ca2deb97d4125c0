// The log of a drive: measurements as they came, one record a frame (proto/log.proto), appended and never
// changed. Whatever part of a file is lost or torn, the other frames are read.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "host/io/dataset.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// Measurements to bytes. What was put stays here until a record is full, or flush() is called.
class LogEncoder {
 public:
  LogEncoder();
  ~LogEncoder();
  LogEncoder(const LogEncoder&) = delete;
  LogEncoder& operator=(const LogEncoder&) = delete;

  // Begins a section with the site's description; times before and after do not compare.
  void begin_section(std::span<const DescriptionFile> description, std::uint64_t unix_time_ns);

  void put(const model::RangeSample& range);
  void put(const model::OdometrySample& row);
  void put(const model::PoseSample& pose);  // a prior
  void put(const model::SensorSample& sample);
  void flush();

  // The bytes of whole frames so far, which are then forgotten.
  [[nodiscard]] std::string take();
  [[nodiscard]] std::size_t size() const noexcept { return bytes_.size(); }

 private:
  struct Records;

  std::string bytes_;
  std::unique_ptr<Records> records_;
};

// As they came: late ones out of order.
struct LogSamples {
  std::vector<model::RangeSample> ranges;
  std::vector<model::OdometrySample> odometry;
  std::vector<model::PoseSample> poses;  // priors
  model::SensorTables sensors;
};

struct LogSection {
  std::string program_version;
  std::uint64_t unix_time_ns = 0;  // of the computer, when it began
  std::vector<DescriptionFile> description;
  LogSamples samples;
};

struct LogContent {
  std::vector<LogSection> sections;
  std::size_t damaged_bytes = 0;  // of frames that are torn or not understood
};

// `only`: the samples of this section alone, from 1; the others are then empty. None: of the last.
[[nodiscard]] LogContent parse_log(std::string_view bytes, std::optional<std::size_t> only = std::nullopt);

}  // namespace groma::io
