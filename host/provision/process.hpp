// Runs another program to its end.
#pragma once

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace groma::provision {

struct ProcessResult {
  int exit_code = -1;  // -1: a signal ended it
  std::string output;  // standard output and error, interleaved as they came
};

// arguments[0] is the program's path. It is killed when this program ends, however that happens. `on_line`
// gets each complete line as it comes; may be empty. Throws io::DeviceError if the program cannot be
// started.
[[nodiscard]] ProcessResult run_process(const std::vector<std::string>& arguments,
                                        const std::function<void(std::string_view)>& on_line = {});

// Finds a program on the PATH. A name with a slash is taken as a path. Nothing unless it is an executable
// file.
[[nodiscard]] std::optional<std::filesystem::path> find_program(const std::string& name);

}  // namespace groma::provision
