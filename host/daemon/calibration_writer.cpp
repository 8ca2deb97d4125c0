#include "host/daemon/calibration_writer.hpp"

#include <fmt/format.h>

#include <utility>

#include "host/io/calibration_file.hpp"
#include "host/io/output_file.hpp"

namespace groma::daemon {

CalibrationWriter::CalibrationWriter(std::optional<std::filesystem::path> path, Log log)
    : path_(std::move(path)), log_(std::move(log)) {}

void CalibrationWriter::put(const model::Calibration& calibration) {
  if (path_) to_write_ = io::format_calibration(calibration);
}

void CalibrationWriter::service(double now_s) {
  if (writer_.busy()) return;
  collect();
  if (!to_write_ || (!error_.empty() && now_s < next_try_s_)) return;
  next_try_s_ = now_s + kRetry_s;
  writing_ = *std::exchange(to_write_, std::nullopt);
  writer_.start(*path_, writing_);
}

void CalibrationWriter::collect() {
  const std::optional<std::string> error = writer_.finish();
  if (!error) return;
  if (error->empty()) {
    if (!error_.empty() || !reported_) log_(fmt::format("calibration written to {}", path_->string()));
    reported_ = true;
  } else {
    if (!to_write_) to_write_ = std::move(writing_);
    if (*error != error_) {
      log_(fmt::format("{}; the calibration is used, and written as soon as possible", *error));
    }
  }
  error_ = *error;
}

void CalibrationWriter::finish() {
  collect();
  if (!to_write_) return;
  io::write_file(*path_, *to_write_);
  log_(fmt::format("calibration written to {}", path_->string()));
}

}  // namespace groma::daemon
