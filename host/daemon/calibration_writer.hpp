// Writes gromad's calibration to its file, in a thread that may wait for the disk, and tries again until it
// is written.
#pragma once

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <string_view>

#include "host/daemon/file_writer.hpp"
#include "host/model/calibration.hpp"

namespace groma::daemon {

class CalibrationWriter {
 public:
  using Log = std::function<void(std::string_view)>;
  // The time between two attempts.
  static constexpr double kRetry_s = 10.0;

  // path: none: nothing is written.
  CalibrationWriter(std::optional<std::filesystem::path> path, Log log);

  // Takes a calibration to write. It replaces one that is not written yet.
  void put(const model::Calibration& calibration);
  // Starts what is due, and logs each different error, the first success, and one after an error; now_s never
  // decreases. Never waits.
  void service(double now_s);
  // At the end: waits, and tries once more. Throws as io::write_file() if it fails then too.
  void finish();

 private:
  // Notes how the attempt has ended.
  void collect();

  std::optional<std::filesystem::path> path_;
  Log log_;
  FileWriter writer_;
  std::string writing_;  // the text of the running attempt
  std::optional<std::string> to_write_;
  std::string error_;      // of the last attempt; empty: it was written
  bool reported_ = false;  // that a file was written
  double next_try_s_ = 0.0;
};

}  // namespace groma::daemon
