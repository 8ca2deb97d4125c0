// The command line of a program: parsing, help, and the texts that follow from its definition.
#pragma once

#include <functional>
#include <map>
#include <optional>
#include <string>

#include <CLI/App.hpp>

namespace groma::help {

// A text that --print-reference prints.
using Print = std::function<std::string()>;

// Call it before subcommands are added. Makes --help print each command at the start of a line of its own,
// and adds the hidden option --print-reference FORMAT, which prints a text and ends the program:
//   man       the manual page, of this section
//   bash      the completion for bash
//   zsh       the completion for zsh
//   markdown  the options of each command as tables
//   others as in `more`
void prepare(CLI::App& app, int manual_section, std::map<std::string, Print> more = {});

// Returns the exit code if the program ends here: after --help, --version or --print-reference, and with
// io::kUsage after an error, also for the help of a command that does not exist.
[[nodiscard]] std::optional<int> parse(CLI::App& app, int argc, const char* const* argv);

}  // namespace groma::help
