// Another program, run to its end.
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
  std::string output;  // standard output and error in the order in which they came
};

// arguments[0] is the program's path. It ends with this one, however that ends. `on_line` is told each line
// as it comes; may be empty. Throws io::DeviceError where the program cannot be started.
[[nodiscard]] ProcessResult run_process(const std::vector<std::string>& arguments,
                                        const std::function<void(std::string_view)>& on_line = {});

// Where a program of this name is on the PATH. A name with a slash is a path already, and has to be a
// program.
[[nodiscard]] std::optional<std::filesystem::path> find_program(const std::string& name);

}  // namespace groma::provision
