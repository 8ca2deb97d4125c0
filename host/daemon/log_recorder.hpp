// Records the measurements of a session in a log (host/io/log_file.hpp). A separate thread writes, so that a
// slow or full disk blocks nothing else.
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
  // Period of write(2), and minimum period of fdatasync(2), which protects against a power cut.
  static constexpr double kWriteEvery_s = 1.0;
  static constexpr double kSyncEvery_s = 5.0;
  // Bytes that may wait for the disk; beyond that the recording ends.
  static constexpr std::size_t kMaxWaiting = 16'777'216;

  // Opens or creates the file for appending and begins a section. Throws io::PathError,
  // io::PermissionError or io::DeviceError (another gromad records into it). On a full disk it does not throw
  // and records nothing: see take_failure().
  LogRecorder(const std::filesystem::path& path, std::vector<io::DescriptionFile> description);
  ~LogRecorder() override;
  LogRecorder(const LogRecorder&) = delete;
  LogRecorder& operator=(const LogRecorder&) = delete;

  void on_odometry(const model::OdometrySample& sample) override { encoder_.put(sample); }
  void on_range(const model::RangeSample& range) override { encoder_.put(range); }
  void on_pose_prior(const model::PoseSample& pose) override { encoder_.put(pose); }
  void on_sensor(const model::SensorSample& sample) override { encoder_.put(sample); }
  void on_clock_set() override;  // begins a section

  // Hands over to the writer thread every kWriteEvery_s; now_s is host time and never decreases.
  void advance(double now_s);

  // Why the recording ended, once; nothing while it works.
  [[nodiscard]] std::optional<std::string> take_failure();

 private:
  // 0, or the error of a full disk. Throws as the constructor.
  [[nodiscard]] int begin();
  void hand_over();
  void write_loop();

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
