#include "host/io/log_ring.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <pb_decode.h>
#include <sys/file.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <memory>
#include <optional>
#include <span>
#include <string_view>
#include <system_error>
#include <utility>
#include <variant>

#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/io/log_event.hpp"
#include "host/io/output_file.hpp"
#include "log.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::io {
namespace {

constexpr std::size_t kDigits = 8;

std::optional<std::uint64_t> number_of(const std::filesystem::path& file) {
  const std::string stem = file.stem().string();
  std::uint64_t number = 0;
  const auto [end, error] = std::from_chars(stem.data(), stem.data() + stem.size(), number);
  const bool is_ours = file.extension() == ".glog" && stem.size() >= kDigits && error == std::errc() &&
                       end == stem.data() + stem.size();
  return is_ours ? std::optional(number) : std::nullopt;
}

std::uint64_t size_of(const std::filesystem::path& file) {
  std::error_code error;
  const std::uintmax_t size = std::filesystem::file_size(file, error);
  return error ? 0 : size;
}

// The time between the first and the last tick.
double duration_s(std::string_view log) {
  std::optional<double> first_s;
  double last_s = 0.0;
  static_cast<void>(read_log_events(log, [&](const LogEvent& event) {
    const auto* tick = std::get_if<LoopTick>(&event);
    if (tick == nullptr) return;
    if (!first_s) first_s = tick->now_s;
    last_s = tick->now_s;
  }));
  return first_s ? last_s - *first_s : 0.0;
}

struct Frames {
  bool continues = false;  // the section of the file before
  std::size_t begin = 0;   // of the first frame after the section's description
  std::size_t end = 0;     // of the last complete frame
};

Frames frames_of(std::string_view log) {
  Frames out;
  const auto decoder = std::make_unique<wire::FrameDecoder>();
  const auto record = std::make_unique<groma_LogRecord>();
  bool is_described = false;
  for (std::size_t i = 0; i < log.size(); ++i) {
    if (!decoder->push(static_cast<std::uint8_t>(log[i]))) continue;
    out.end = i + 1;
    if (is_described) continue;
    const std::span<const std::uint8_t> payload = decoder->payload();
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    *record = groma_LogRecord_init_zero;
    const bool understood = pb_decode(&stream, groma_LogRecord_fields, record.get());
    if (understood && record->which_body == groma_LogRecord_start_tag) {
      out.continues = record->body.start.continues;
      out.begin = out.end;
    } else if (understood && record->which_body == groma_LogRecord_file_tag) {
      out.begin = out.end;
    } else {
      is_described = true;
    }
  }
  return out;
}

}  // namespace

std::vector<std::filesystem::path> ring_files(const std::filesystem::path& folder) {
  std::vector<std::pair<std::uint64_t, std::filesystem::path>> numbered;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(folder, error)) {
    if (const auto number = number_of(entry.path())) numbered.emplace_back(*number, entry.path());
  }
  std::sort(numbered.begin(), numbered.end());
  std::vector<std::filesystem::path> files;
  files.reserve(numbered.size());
  for (auto& [number, file] : numbered) files.push_back(std::move(file));
  return files;
}

LogRing::LogRing(std::filesystem::path folder, std::uint64_t max_bytes)
    : folder_(std::move(folder)), max_bytes_(max_bytes) {
  make_folder(folder_);
  const std::filesystem::path lock = folder_ / "lock";
  expect_writable(lock);
  lock_ = Descriptor(::open(lock.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644));
  if (!lock_.valid()) {
    throw DeviceError({lock}, fmt::format("cannot be opened ({})", std::generic_category().message(errno)),
                      "make room, or choose another folder for `ring`");
  }
  if (::flock(lock_.get(), LOCK_EX | LOCK_NB) != 0) {
    throw DeviceError({folder_}, "another program records there",
                      "stop it, or choose another folder for `ring`");
  }
}

Descriptor LogRing::open_next() {
  std::vector<std::filesystem::path> files = ring_files(folder_);
  const std::uint64_t number = files.empty() ? 1 : *number_of(files.back()) + 1;
  std::uint64_t total = 2 * file_bytes();  // of the next one, with reserve
  for (const auto& file : files) total += size_of(file);
  for (const auto& file : files) {
    if (total <= max_bytes_) break;
    total -= size_of(file);
    std::error_code ignored;
    std::filesystem::remove(file, ignored);
  }
  const std::filesystem::path next = folder_ / fmt::format("{:0{}}.glog", number, kDigits);
  Descriptor file(::open(next.c_str(), O_WRONLY | O_APPEND | O_CREAT | O_EXCL | O_CLOEXEC, 0644));
  if (!file.valid()) {
    throw DeviceError({next}, fmt::format("cannot be written ({})", std::generic_category().message(errno)),
                      "make room, or choose another folder for `ring`");
  }
  return file;
}

std::string last_of_ring(const std::filesystem::path& folder, double last_s) {
  const std::vector<std::filesystem::path> files = ring_files(folder);
  std::vector<std::string> logs;  // the newest first
  double recorded_s = 0.0;
  for (auto file = files.rbegin(); file != files.rend() && recorded_s < last_s; ++file) {
    // gromad may have removed the oldest by now.
    std::error_code ignored;
    if (!std::filesystem::exists(*file, ignored)) break;
    logs.push_back(read_file(*file));
    recorded_s += duration_s(logs.back());
  }
  std::string out;
  for (auto log = logs.rbegin(); log != logs.rend(); ++log) {
    const Frames frames = frames_of(*log);
    const std::size_t begin = frames.continues && !out.empty() ? frames.begin : 0;
    out.append(*log, begin, frames.end - begin);
  }
  return out;
}

}  // namespace groma::io
