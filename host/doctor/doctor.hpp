// Examines a configuration of gromad, what it names, and gromad where it runs.
#pragma once

#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/doctor/check.hpp"
#include "host/doctor/link_probe.hpp"
#include "host/doctor/pose_stream.hpp"

namespace groma::doctor {

struct Examination {  // NOLINT(bugprone-exception-escape): moving JSON does not throw
  std::vector<Check> checks;
  Observation observation;  // of gromad; with an error if it does not run
};

// `config`: the file. listen_s: for how long it listens to gromad.
[[nodiscard]] Examination examine(const std::filesystem::path& config, double listen_s);

// What the parts of an examination share.
struct Subject {
  const daemon::Config& config;
  const Observation* live = nullptr;  // null: gromad does not run
  std::set<model::NodeId> anchors{};  // of the calibration
};

// Each of these gives the checks of one part.
[[nodiscard]] std::vector<Check> check_configuration(const daemon::ConfigReading& reading);
[[nodiscard]] Check check_calibration(const daemon::Config& config, std::set<model::NodeId>& anchors);
[[nodiscard]] std::vector<Check> check_files(const daemon::Config& config);
[[nodiscard]] Check check_computer_clock();
[[nodiscard]] std::vector<Check> check_can_buses(const daemon::Config& config);
[[nodiscard]] std::vector<Check> check_servers(const daemon::Config& config, const Observation& observation);
[[nodiscard]] std::vector<Check> check_links(const Subject& subject);
[[nodiscard]] Check check_odometry(const Subject& subject);
[[nodiscard]] Check check_robot_clock(const Subject& subject);
[[nodiscard]] std::vector<Check> check_pairs(const Subject& subject);
[[nodiscard]] std::vector<Check> check_localization(const Subject& subject);

// The checks of a node's link, of the node, and of its clock if its round trip is known.
[[nodiscard]] std::vector<Check> judge_link(const daemon::NodeLink& node, const LinkFacts& facts,
                                            const Subject& subject);

}  // namespace groma::doctor
