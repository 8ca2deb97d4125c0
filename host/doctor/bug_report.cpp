#include "host/doctor/bug_report.hpp"

#include <fmt/format.h>
#include <sys/utsname.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <exception>
#include <iterator>

#include <nlohmann/json.hpp>

#include "host/doctor/doctor.hpp"
#include "host/io/input_file.hpp"
#include "host/io/version.hpp"
#include "host/provision/process.hpp"

namespace groma::doctor {
namespace {

constexpr std::size_t kLongestPart = 1U << 20U;  // bytes; the end is kept
constexpr std::size_t kLogLines = 500;
constexpr std::size_t kTarBlock = 512;

// The file's end, or why it cannot be read.
std::string end_of_file(const std::filesystem::path& path) {
  try {
    std::string text = io::read_file(path);
    if (text.size() > kLongestPart) text.erase(0, text.size() - kLongestPart);
    return text;
  } catch (const std::exception& error) {
    return fmt::format("{}\n", error.what());
  }
}

std::string last_lines(const std::string& text, std::size_t lines) {
  std::size_t begin = text.size();
  for (std::size_t found = 0; begin > 0; --begin) {
    if (text.at(begin - 1) == '\n' && begin < text.size() && ++found == lines) break;
  }
  return text.substr(begin);
}

std::string read_log(const std::filesystem::path& log) {
  if (!log.empty()) return last_lines(end_of_file(log), kLogLines);
  const auto journalctl = provision::find_program("journalctl");
  if (!journalctl) return "no journal: this computer has no journalctl; name gromad's log by --log\n";
  try {
    const provision::ProcessResult journal =
        provision::run_process({journalctl->string(), "--unit=gromad", fmt::format("--lines={}", kLogLines),
                                "--no-pager", "--output=short-iso", "--quiet"});
    return journal.output.empty() ? "the journal has no line of gromad that this user may read\n"
                                  : journal.output;
  } catch (const std::exception& error) {
    return fmt::format("{}\n", error.what());
  }
}

std::string versions(const Observation& observation) {
  utsname system{};
  static_cast<void>(::uname(&system));
  const std::string gromad = observation.version.is_object() ? observation.version.value("version", "")
                                                             : "does not answer: " + observation.error;
  const auto now = std::chrono::system_clock::to_time_t(std::chrono::system_clock::now());
  return fmt::format("groma {}\ngromad {}\nsystem {} {} {}\ntime {} s since 1970\n", io::program_version(),
                     gromad, system.sysname, system.release, system.machine, now);
}

void put(std::string& header, std::size_t at, std::string_view text) {
  header.replace(at, text.size(), text);
}

std::string tar_header(const std::string& name, std::size_t size) {
  std::string header(kTarBlock, '\0');
  put(header, 0, std::string_view(name).substr(0, 99));
  put(header, 100, "0000644");
  put(header, 108, "0000000");
  put(header, 116, "0000000");
  put(header, 124, fmt::format("{:011o}", size));
  put(header, 136, "00000000000");
  put(header, 148, "        ");  // counts as blanks in its own sum
  put(header, 156, "0");
  put(header, 257, "ustar");
  put(header, 263, "00");
  unsigned sum = 0;
  for (const char c : header) sum += static_cast<unsigned char>(c);
  put(header, 148, fmt::format("{:06o}", sum));
  header[154] = '\0';
  return header;
}

}  // namespace

std::string tar_archive(const std::string& folder, const std::vector<ReportFile>& files) {
  std::string archive;
  for (const ReportFile& file : files) {
    archive += tar_header(folder + "/" + file.name, file.content.size());
    archive += file.content;
    archive.append((kTarBlock - file.content.size() % kTarBlock) % kTarBlock, '\0');
  }
  return archive + std::string(2 * kTarBlock, '\0');
}

std::vector<ReportFile> collect_report(const ReportSource& source) {
  const Examination examination = examine(source.config, source.listen_s);
  const daemon::ConfigReading reading = daemon::parse_config(source.config);
  std::vector<ReportFile> files{{"version.txt", versions(examination.observation)},
                                {"doctor.txt", as_text(examination.checks)},
                                {"doctor.json", to_json(examination.checks).dump(2) + "\n"},
                                {"gromad.yaml", end_of_file(source.config)}};
  if (const auto& calibration = reading.config.calibration.file) {
    files.push_back({"calibration.yaml", end_of_file(*calibration)});
  }
  std::string stream = examination.observation.error.empty() ? "" : examination.observation.error + "\n";
  for (const std::string& line : examination.observation.lines) stream += line + "\n";
  if (examination.observation.pose.is_object()) stream += examination.observation.pose.dump() + "\n";
  files.push_back({"status.jsonl", stream});
  if (reading.config.web && !reading.config.web->tls) {
    std::string metrics;
    try {
      metrics = read_metrics(*reading.config.web);
    } catch (const io::Error& error) {
      metrics = std::string(error.what()) + "\n";
    }
    files.push_back({"metrics.txt", metrics.empty() ? "/metrics does not answer\n" : metrics});
  }
  files.push_back({"log.txt", read_log(source.log)});
  for (ReportFile& file : files) file.content = without_secrets(file.content);
  return files;
}

}  // namespace groma::doctor
