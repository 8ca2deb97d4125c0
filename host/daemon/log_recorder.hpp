// Keeps what a session passes on in a log (host/io/log_file.hpp), in a thread of its own: a disk that is slow
// or full holds up nobody.
#pragma once

#include <condition_variable>
#include <cstddef>
#include <filesystem>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "host/daemon/measurement_sink.hpp"
#include "host/io/dataset.hpp"
#include "host/io/descriptor.hpp"
#include "host/io/log_file.hpp"

namespace groma::daemon {

class LogRecorder : public MeasurementSink {
 public:
  // What is measured is handed to the disk after so long, and is safe from a power cut after so long again.
  static constexpr double kWriteEvery_s = 1.0;
  static constexpr double kSyncEvery_s = 5.0;
  // Bytes that may wait for the disk; with more the recording ends.
  static constexpr std::size_t kMaxWaiting = 16'777'216;

  // Opens the file for appending, or makes it, and begins a section. Throws io::PathError,
  // io::PermissionError or io::DeviceError (another gromad records into it, the disk is full).
  LogRecorder(const std::filesystem::path& path, std::vector<io::DescriptionFile> description);
  ~LogRecorder() override;
  LogRecorder(const LogRecorder&) = delete;
  LogRecorder& operator=(const LogRecorder&) = delete;

  void on_odometry(const model::OdometrySample& row) override { encoder_.put(row); }
  void on_range(const model::RangeSample& range) override { encoder_.put(range); }
  void on_pose_prior(const model::PoseSample& pose) override { encoder_.put(pose); }
  void on_sensor(const model::SensorSample& sample) override { encoder_.put(sample); }
  void on_clock_set() override;  // begins a section

  // Hands over what is due; now_s never decreases.
  void advance(double now_s);

  // Why the recording has ended, told once; none as long as all is well.
  [[nodiscard]] std::optional<std::string> take_failure();

 private:
  void hand_over();
  void write_on();

  std::filesystem::path path_;
  std::vector<io::DescriptionFile> description_;
  io::Descriptor file_;
  io::LogEncoder encoder_;
  double next_write_s_ = 0.0;

  std::mutex mutex_;
  std::condition_variable changed_;
  std::string waiting_;
  bool ending_ = false;
  bool failed_ = false;
  std::optional<std::string> failure_;
  std::thread writer_;
};

}  // namespace groma::daemon
