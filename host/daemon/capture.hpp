// A capture: the events of the loop that a log holds beside its measurements, with snapshots of all that
// later poses depend on. The same build repeats the pose lines from them, byte for byte.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/daemon/pipeline.hpp"

namespace groma::daemon {

// The configuration, with the files that it names, and the state of the pipeline.
void take_snapshot(const Config& config, Pipeline& pipeline, std::string& bytes);

// A section of a capture that was replayed.
struct ReplayedSection {
  std::string program_version;
  std::string build{};             // as io::build_name(), of its last snapshot
  std::uint64_t unix_time_ns = 0;  // of its start
  double duration_s = 0.0;
  std::size_t poses = 0;
  std::size_t digests = 0;               // compared with those of the capture
  std::optional<double> differs_from_s;  // since the section's start: the first digest that is another
  bool has_snapshot = false;
  bool is_of_this_build = true;  // its snapshot can be read
};

struct StreamReplay {
  std::vector<ReplayedSection> sections;
  std::size_t damaged_bytes = 0;
};

// Receive what went out; either may be empty.
struct StreamReceiver {
  std::function<void(const PoseEstimate& pose, std::string_view line)> on_pose;
  // The calibration in use from now on, also at the start of a section.
  std::function<void(const model::Calibration& calibration)> on_calibration = {};
};

// Gives the poses of all sections, or of one (from 1), as they went out. A snapshot is an image of gromad's
// memory: replay only captures that you trust.
[[nodiscard]] StreamReplay replay_stream(std::string_view capture, std::optional<std::size_t> only,
                                         const StreamReceiver& receiver);

}  // namespace groma::daemon
