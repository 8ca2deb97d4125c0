// What groma bugreport writes: one tar archive, without secrets.
#pragma once

#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

namespace groma::doctor {

// The text without secrets, each replaced by "[removed]": values of keys whose name says key, token, secret,
// password or credential (but not of names of files), 32 or more hexadecimal digits (but not after sha256),
// private keys in PEM, and names and passwords in URLs.
[[nodiscard]] std::string without_secrets(std::string_view text);

struct ReportFile {
  std::string name;
  std::string content;
};

// An archive in POSIX' format ustar, with all files in that folder. Names are at most 99 bytes with it.
[[nodiscard]] std::string tar_archive(const std::string& folder, const std::vector<ReportFile>& files);

struct ReportSource {
  std::filesystem::path config{};
  std::filesystem::path log{};  // gromad's; empty: systemd's journal
  double listen_s = 3.0;        // to gromad
};
// Versions, configuration, calibration, what gromad reports, its counters and last log lines, and the
// doctor's checks. A part that cannot be had says why. Nothing of it has secrets.
[[nodiscard]] std::vector<ReportFile> collect_report(const ReportSource& source);

}  // namespace groma::doctor
