// What to say of a command line that cannot be parsed.
#pragma once

#include <optional>
#include <string>
#include <string_view>

#include <CLI/App.hpp>

namespace groma::help {

// "unknown command 'X'; ...", with the command of `app` that is closest to it.
[[nodiscard]] std::string unknown_command(const CLI::App& app, std::string_view word);

// The same for the word that was given to a parsed `app`, or to its chosen command, in place of a command;
// none if there is no such word.
[[nodiscard]] std::optional<std::string> unknown_command_in(const CLI::App& app);

// Problem and remedy after app.parse() threw `error`. A word that the program does not know comes first: what
// else is wrong usually follows from it.
[[nodiscard]] std::string usage_error(const CLI::App& app, const CLI::ParseError& error);

}  // namespace groma::help
