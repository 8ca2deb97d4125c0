// Texts that follow from a program's definition. None ends with a line end; none depends on the machine.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include <CLI/App.hpp>

namespace groma::help {

// Placeholder of an argument that is a command of the parent.
inline constexpr std::string_view kCommandValue = "COMMAND";

// An option as it is shown.
struct ShownOption {
  std::vector<std::string> names;
  std::string value;               // placeholder of its value; empty: a flag
  std::vector<std::string> words;  // the values that it takes; empty: any
  std::string text;                // what it does, its bounds and its default
  bool required = false;
  bool positional = false;
};
[[nodiscard]] ShownOption shown_of(const CLI::Option& option);

// The commands of a program or command, without option groups.
[[nodiscard]] std::vector<const CLI::App*> commands_of(const CLI::App& app);
// One of them by its name; null if there is none.
[[nodiscard]] const CLI::App* find_command(const CLI::App& app, std::string_view name);

// As it is typed, such as "groma surface fit".
[[nodiscard]] std::string full_name(const CLI::App& app);
// What follows the words of the command, such as "[OPTIONS] ESTIMATE TRUTH".
[[nodiscard]] std::string synopsis(const CLI::App& app);

// Up to the first full stop that ends a sentence, without it.
[[nodiscard]] std::string first_sentence(std::string_view text);

// For man(1).
[[nodiscard]] std::string manual_page(const CLI::App& app, int section, std::string_view exit_codes);

// For bash-completion: commands, options, their words, and files.
[[nodiscard]] std::string bash_completion(const CLI::App& app);

// For zsh: the same, with what each word means.
[[nodiscard]] std::string zsh_completion(const CLI::App& app);

// In Markdown, a section for each command.
[[nodiscard]] std::string option_tables(const CLI::App& app);

}  // namespace groma::help
