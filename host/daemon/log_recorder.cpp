#include "host/daemon/log_recorder.hpp"

#include <chrono>
#include <type_traits>
#include <utility>
#include <variant>

namespace groma::daemon {
namespace {

std::uint64_t unix_time_ns() {
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  return static_cast<std::uint64_t>(std::chrono::duration_cast<std::chrono::nanoseconds>(now).count());
}

}  // namespace

LogRecorder::LogRecorder(Setup setup) : setup_(std::move(setup)), writer_(setup_.name, setup_.open, begin()) {
  std::string empty = LogWriter::make_buffer();
  encoder_.take(empty);
  bytes_ = LogWriter::make_buffer();
}

LogRecorder::~LogRecorder() {
  encoder_.flush();
  put_digest();
  hand_over();
}

std::string LogRecorder::begin() {
  begin_section();
  put_snapshot();
  file_size_ = encoder_.size();
  return encoder_.take();
}

void LogRecorder::begin_section(bool continues) {
  encoder_.begin_section(setup_.description, unix_time_ns(), continues);
  needs_snapshot_ = true;
}

void LogRecorder::describe(std::vector<io::DescriptionFile> description) {
  if (description == setup_.description) return;
  setup_.description = std::move(description);
  begin_section();
}

void LogRecorder::take(const Pipeline::Event& event) {
  if (const auto* adopted = std::get_if<Pipeline::Adoption>(&event)) {
    Pipeline::Adoption adoption = *adopted;
    std::string state;
    model::StateArchive archive(state);
    archive(adoption);
    encoder_.put(io::LoopState{io::LoopState::Kind::kAdoption, state});
    return;
  }
  std::visit(
      [this](const auto& of) {
        if constexpr (!std::is_same_v<std::decay_t<decltype(of)>, Pipeline::Adoption>) encoder_.put(of);
      },
      event);
}

void LogRecorder::on_pose(std::string_view line) {
  ++poses_;
  hash_ = io::fnv1a(line, hash_);
}

void LogRecorder::advance(double now_s) {
  now_s_ = now_s;
  const bool is_full = setup_.file_bytes > 0 && file_size_ + encoder_.size() >= setup_.file_bytes;
  if (!next_snapshot_s_) next_snapshot_s_ = now_s + kSnapshotEvery_s;
  if (needs_snapshot_ || now_s >= *next_snapshot_s_ || is_full) renew();
  if (now_s < next_write_s_) return;
  next_write_s_ = now_s + kWriteEvery_s;
  encoder_.flush();
  put_digest();
  hand_over();
}

void LogRecorder::renew() {
  next_snapshot_s_ = now_s_ + kSnapshotEvery_s;
  encoder_.flush();
  put_digest();
  if (setup_.file_bytes > 0 && !needs_snapshot_) {
    hand_over();
    in_next_file_ = true;
    file_size_ = 0;
    begin_section(/*continues=*/true);
  }
  put_snapshot();
}

void LogRecorder::put_snapshot() {
  needs_snapshot_ = false;
  setup_.snapshot(snapshot_);
  encoder_.put(io::LoopState{io::LoopState::Kind::kSnapshot, snapshot_});
  poses_ = 0;
  hash_ = io::kFnv1aBegin;
}

void LogRecorder::put_digest() {
  encoder_.put(io::PoseDigest{now_s_, poses_, hash_});
  poses_ = 0;
  hash_ = io::kFnv1aBegin;
}

void LogRecorder::hand_over() {
  encoder_.take(bytes_);
  file_size_ += bytes_.size();
  writer_.write(bytes_, std::exchange(in_next_file_, false));
}

}  // namespace groma::daemon
