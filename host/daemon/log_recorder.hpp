// Records a drive in a log (host/io/log_file.hpp): the measurements of a session, and the events of a
// pipeline with snapshots of its state (capture.hpp).
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/daemon/log_writer.hpp"
#include "host/daemon/measurement_sink.hpp"
#include "host/daemon/pipeline.hpp"
#include "host/io/dataset.hpp"
#include "host/io/log_file.hpp"

namespace groma::daemon {

class LogRecorder : public MeasurementSink {
 public:
  static constexpr double kWriteEvery_s = 1.0;  // period of writing, and of the digests of pose lines
  static constexpr double kSnapshotEvery_s = 60.0;

  struct Setup {
    std::filesystem::path name;  // of the log, in messages
    LogWriter::Open open;
    // The next file begins at each snapshot, and once a file has this many bytes; 0: there is one file only.
    std::uint64_t file_bytes = 0;
    std::vector<io::DescriptionFile> description{};
    std::function<void(std::string& bytes)> snapshot{};  // take_snapshot(), between two events
  };

  // Begins a section with a snapshot. Throws as LogWriter does.
  explicit LogRecorder(Setup setup);
  ~LogRecorder() override;
  LogRecorder(const LogRecorder&) = delete;
  LogRecorder& operator=(const LogRecorder&) = delete;

  void on_odometry(const model::OdometrySample& sample) override { encoder_.put(sample); }
  // As received, because who reads the log corrects times by a calibration of their choice.
  void on_uncorrected_range(const model::RangeSample& range) override { encoder_.put(range); }
  void on_range(const model::RangeSample& /*range*/) override {}
  void on_pose_prior(const model::PoseSample& pose) override { encoder_.put(pose); }
  void on_sensor(const model::SensorSample& sample) override { encoder_.put(sample); }
  void on_clock_set() override { begin_section(); }

  // Each event before the pipeline takes it, and each pose line.
  void take(const Pipeline::Event& event);
  void on_pose(std::string_view line);
  // Begins a section if the description is another one: the tags have changed.
  void describe(std::vector<io::DescriptionFile> description);

  // Writes and takes a snapshot when that is due; between two events. now_s is host time and never decreases.
  void advance(double now_s);

  // As LogWriter's.
  [[nodiscard]] std::optional<std::string> take_failure() { return writer_.take_failure(); }

 private:
  // Its snapshot follows: this may be in the middle of an event.
  void begin_section(bool continues = false);
  [[nodiscard]] std::string begin();
  void renew();
  void put_snapshot();
  void put_digest();
  void hand_over();

  Setup setup_;
  io::LogEncoder encoder_;
  std::string snapshot_;  // keeps its capacity
  double now_s_ = 0.0;
  double next_write_s_ = 0.0;
  bool needs_snapshot_ = false;
  std::optional<double> next_snapshot_s_;
  std::uint32_t poses_ = 0;  // since the last digest or snapshot
  std::uint64_t hash_ = io::kFnv1aBegin;
  std::uint64_t file_size_ = 0;
  bool in_next_file_ = false;  // the encoder's bytes begin the next file
  std::string bytes_;          // scratch
  LogWriter writer_;
};

}  // namespace groma::daemon
