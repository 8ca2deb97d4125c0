// The log of a drive: measurements in order of arrival, one record per frame (proto/log.proto), append-only.
// If parts of a file are lost or damaged, the remaining frames can still be read.
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
#include "host/io/log_event.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// Encodes measurements to bytes. Samples are buffered until a record is full or flush() is called.
class LogEncoder {
 public:
  LogEncoder();
  ~LogEncoder();
  LogEncoder(const LogEncoder&) = delete;
  LogEncoder& operator=(const LogEncoder&) = delete;

  // Begins a section with the site's description. Times of different sections are not comparable.
  // continues: the same drive in another file, whose times are comparable.
  void begin_section(std::span<const DescriptionFile> description, std::uint64_t unix_time_ns,
                     bool continues = false);

  void put(const model::RangeSample& range);
  void put(const model::OdometrySample& sample);
  void put(const model::PoseSample& pose);  // a prior
  void put(const model::SensorSample& sample);
  // Appended at once.
  void put(const LogEvent& event) { append_event(event, bytes_); }
  void flush();

  // Returns the bytes of the complete frames and clears them.
  [[nodiscard]] std::string take();
  // The same by exchange with an empty string, whose capacity is used again.
  void take(std::string& empty) { bytes_.swap(empty); }
  [[nodiscard]] std::size_t size() const noexcept { return bytes_.size(); }

 private:
  struct Records;

  std::string bytes_;
  std::unique_ptr<Records> records_;
};

// In order of arrival: late samples are out of order.
struct LogSamples {
  std::vector<model::RangeSample> ranges;
  std::vector<model::OdometrySample> odometry;
  std::vector<model::PoseSample> poses;  // priors
  model::SensorTables sensors;
};

struct LogSection {
  std::string program_version;
  std::uint64_t unix_time_ns = 0;  // the computer's time at the section's start
  std::vector<DescriptionFile> description;
  LogSamples samples;
};

struct LogContent {
  std::vector<LogSection> sections;
  std::size_t damaged_bytes = 0;  // in frames that are damaged or not understood
};

// `only`: read the samples of this section only, from 1; the other sections have none. None: the last
// section.
[[nodiscard]] LogContent parse_log(std::string_view bytes, std::optional<std::size_t> only = std::nullopt);

}  // namespace groma::io
