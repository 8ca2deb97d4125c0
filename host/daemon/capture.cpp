#include "host/daemon/capture.hpp"

#include <memory>
#include <utility>
#include <variant>

#include "host/daemon/pose_message.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

struct File {
  std::string path;
  std::string text;

  void archive(model::StateArchive& state) { state(path, text); }
};

class Replayer {
 public:
  Replayer(std::optional<std::size_t> only, const StreamReceiver& receiver)
      : only_(only), receiver_(receiver) {}

  void take(const io::LogEvent& event) {
    if (const auto* start = std::get_if<io::SectionStart>(&event)) {
      begin_section(*start);
    } else if (!is_skipped()) {
      std::visit([this](const auto& of) { process(of); }, event);
    }
  }

  [[nodiscard]] std::vector<ReplayedSection> take_sections() { return std::move(sections_); }

 private:
  // The poses of a section up to its snapshot, if the robot's clock was set, are those of the one before.
  [[nodiscard]] bool is_skipped() const {
    return sections_.empty() || (only_ && sections_.size() + 1 < *only_);
  }
  [[nodiscard]] bool is_written() const { return !only_ || sections_.size() == *only_; }

  void begin_section(const io::SectionStart& start) {
    if (start.continues && !sections_.empty()) return;
    sections_.push_back(
        {.program_version = std::string(start.program_version), .unix_time_ns = start.unix_time_ns});
    begin_s_.reset();
  }

  void process(const io::SectionStart& /*start*/) {}
  void process(const io::LinkBytes& bytes) {
    note_time(bytes.now_s);
    give(bytes);
  }
  void process(const io::LoopTick& tick) {
    note_time(tick.now_s);
    give(tick);
  }
  void process(const io::LinkReopened& reopened) { give(reopened); }
  void process(const io::LoopFlush& flush) { give(flush); }

  void process(const io::LoopState& state) {
    if (state.kind == io::LoopState::Kind::kAdoption && !pipeline_) return;
    try {
      model::StateArchive archive(state.content);
      if (state.kind == io::LoopState::Kind::kSnapshot) {
        begin(archive);
      } else {
        Pipeline::Adoption adoption;
        archive(adoption);
        give(adoption.calibration);
        pipeline_->take(std::move(adoption));
      }
    } catch (const model::StateArchive::Mismatch&) {
      pipeline_.reset();
      sections_.back().is_of_this_build = false;
    }
  }

  void process(const io::PoseDigest& digest) {
    note_time(digest.now_s);
    const bool same = digest.poses == poses_ && digest.fnv1a == hash_;
    restart_digest();
    if (!pipeline_) return;
    ReplayedSection& section = sections_.back();
    ++section.digests;
    if (!same && !section.differs_from_s) section.differs_from_s = section.duration_s;
  }

  void begin(model::StateArchive& archive) {
    pipeline_.reset();
    restart_digest();
    ReplayedSection& section = sections_.back();
    section.has_snapshot = true;
    std::string path;
    std::vector<File> files;
    archive(section.build);
    if (section.build != io::build_name()) throw model::StateArchive::Mismatch();
    archive(path, files);
    io::InputFiles::Texts texts;
    for (File& file : files) texts.emplace(std::move(file.path), std::move(file.text));
    ConfigReading reading = parse_config(path, texts);
    if (!reading.problems.empty()) throw model::StateArchive::Mismatch();
    config_ = std::move(reading.config);
    pipeline_ = std::make_unique<Pipeline>(
        config_, [](std::string_view) {}, [this](const PoseEstimate& pose) { write(pose); },
        [](const PoseEstimate&) {});
    pipeline_->archive(archive);
    if (!archive.at_end()) throw model::StateArchive::Mismatch();
    if (pipeline_->localizer() != nullptr) give(pipeline_->localizer()->calibration());
  }

  void give(const model::Calibration& calibration) {
    if (is_written() && receiver_.on_calibration) receiver_.on_calibration(calibration);
  }

  template <class Event>
  void give(const Event& event) {
    if (pipeline_) pipeline_->take(event);
  }

  void write(const PoseEstimate& pose) {
    const std::string line = pose_line(pose, pipeline_->frame(), filter::model_name(config_.model));
    ++poses_;
    hash_ = io::fnv1a(line, hash_);
    ++sections_.back().poses;
    if (is_written() && receiver_.on_pose) receiver_.on_pose(pose, line);
  }

  void restart_digest() {
    poses_ = 0;
    hash_ = io::kFnv1aBegin;
  }

  void note_time(double now_s) {
    if (!begin_s_) begin_s_ = now_s;
    sections_.back().duration_s = now_s - *begin_s_;
  }

  std::optional<std::size_t> only_;
  const StreamReceiver& receiver_;
  std::vector<ReplayedSection> sections_;
  Config config_;
  std::unique_ptr<Pipeline> pipeline_;  // null: no snapshot yet, or one of another build
  std::optional<double> begin_s_;       // host time of the section's first event
  std::uint32_t poses_ = 0;             // since the last digest or snapshot
  std::uint64_t hash_ = io::kFnv1aBegin;
};

}  // namespace

void take_snapshot(const Config& config, Pipeline& pipeline, std::string& bytes) {
  bytes.clear();
  std::string build = io::build_name();
  std::string path = config.path.string();
  std::vector<File> files;
  files.reserve(config.files.size());
  for (const auto& [name, text] : config.files) files.push_back({name.string(), text});
  model::StateArchive archive(bytes);
  archive(build, path, files, pipeline);
}

StreamReplay replay_stream(std::string_view capture, std::optional<std::size_t> only,
                           const StreamReceiver& receiver) {
  Replayer replayer(only, receiver);
  StreamReplay out;
  out.damaged_bytes =
      io::read_log_events(capture, [&replayer](const io::LogEvent& event) { replayer.take(event); });
  out.sections = replayer.take_sections();
  return out;
}

}  // namespace groma::daemon
