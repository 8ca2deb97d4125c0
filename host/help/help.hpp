// The command line of a program: parsing, help, and the texts that follow from its definition.
#pragma once

#include <functional>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <CLI/App.hpp>

namespace groma::help {

// A text that --print-reference prints.
using Print = std::function<std::string()>;

// Call it before subcommands are added. Makes --help print each command at the start of a line of its own,
// and `exit_codes` at the end of each help. Adds the hidden option --print-reference FORMAT, which prints a
// text and ends the program:
//   man       the manual page, of this section
//   bash      the completion for bash
//   zsh       the completion for zsh
//   markdown  the options of each command as tables
//   others as in `more`
void prepare(CLI::App& app, int manual_section, const std::string& exit_codes,
             std::map<std::string, Print> more = {});

// Adds the command `help`, which prints the help of the program or of the command that it names.
void add_help_command(CLI::App& app);

// What the help of a command shows below its options.
struct Example {
  std::string_view purpose;
  std::string_view command;
};
struct Guide {
  std::string_view command;  // as "surface fit"; empty: the program itself
  std::vector<Example> examples;
  std::string_view pages;  // of the documents that explain the command
};
// Call it when all commands have been added. Throws CLI::OptionNotFound for a guide of no command.
void add_guides(CLI::App& app, std::span<const Guide> guides);

// Checks that a number is finite and above 0.
[[nodiscard]] CLI::Validator above_zero();

// Returns the exit code if the program ends here: after --help, --version or --print-reference, and with
// io::kUsage after an error, also for the help of a command that does not exist. The error goes to standard
// error as "PROGRAM: problem; what to do", with the command or option that was probably meant.
[[nodiscard]] std::optional<int> parse(CLI::App& app, int argc, const char* const* argv);

// Runs the program. An error goes to `complain`, and becomes the exit code of its kind.
[[nodiscard]] int guarded(const std::function<int()>& run,
                          const std::function<void(std::string_view)>& complain);

}  // namespace groma::help
