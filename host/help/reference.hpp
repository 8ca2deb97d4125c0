// Texts that follow from a program's definition. None ends with a line end; none depends on the machine.
#pragma once

#include <string>
#include <string_view>

#include <CLI/App.hpp>

namespace groma::help {

// Up to the first full stop that ends a sentence, without it.
[[nodiscard]] std::string first_sentence(std::string_view text);

// For man(1).
[[nodiscard]] std::string manual_page(const CLI::App& app, int section);

// For bash-completion: commands, options, their words, and files.
[[nodiscard]] std::string bash_completion(const CLI::App& app);

// For zsh: the same, with what each word means.
[[nodiscard]] std::string zsh_completion(const CLI::App& app);

// In Markdown, a section for each command.
[[nodiscard]] std::string option_tables(const CLI::App& app);

}  // namespace groma::help
