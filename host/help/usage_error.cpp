#include "host/help/usage_error.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cstddef>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/help/reference.hpp"
#include "host/io/error.hpp"
#include "host/io/spelling.hpp"

namespace groma::help {
namespace {

// The command chosen below `app`; null if there is none.
const CLI::App* chosen_in(const CLI::App& app) {
  const std::vector<CLI::App*> chosen = app.get_subcommands();
  return chosen.empty() ? nullptr : chosen.front();
}

bool lacks_command(const CLI::App& app) {
  return app.get_require_subcommand_min() > 0 && chosen_in(app) == nullptr;
}

std::string unknown_option(const CLI::App& app, std::string_view word) {
  word = word.substr(0, word.find('='));
  std::vector<std::string> names;
  for (const CLI::Option* option : app.get_options()) {
    if (option->get_group().empty()) continue;
    for (const std::string& name : option->get_lnames()) names.push_back("--" + name);
  }
  const std::vector<std::string_view> views(names.begin(), names.end());
  const std::string meant =
      "--" + std::string(word.substr(std::min(word.find_first_not_of('-'), word.size())));
  return fmt::format("unknown option {}; {}see '{} --help'", io::shown(word), io::did_you_mean(meant, views),
                     full_name(app));
}

// A word too many may be the value of an option that is required and was not given.
std::string unexpected_argument(const CLI::App& app, std::string_view word) {
  const std::vector<const CLI::Option*> options = app.get_options();
  const auto missing = std::find_if(options.begin(), options.end(), [](const CLI::Option* option) {
    return option->get_required() && option->count() == 0 && !option->get_lnames().empty();
  });
  const std::string meant = missing == options.end() ? ""
                                                     : fmt::format("did you mean '--{} {}'? ",
                                                                   (*missing)->get_lnames().front(), word);
  return fmt::format("unexpected argument {}; {}see '{} --help'", io::shown(word), meant, full_name(app));
}

std::string unexpected(const CLI::App& app, std::string_view word) {
  if (word.starts_with('-')) return unknown_option(app, word);
  return lacks_command(app) ? unknown_command(app, word) : unexpected_argument(app, word);
}

// Of "OPTION: VALUE not in {A,B}": the words that the option takes.
std::string plain_choice(const std::string& text, std::size_t colon, std::size_t at, std::string_view mark) {
  const std::string value = text.substr(colon + 2, at - colon - 2);
  const std::string list = text.substr(at + mark.size(), text.size() - at - mark.size() - 1);
  std::vector<std::string_view> words;
  for (std::string_view rest = list; !rest.empty();) {
    const std::size_t comma = std::min(rest.find(','), rest.size());
    words.push_back(rest.substr(0, comma));
    rest.remove_prefix(std::min(comma + 1, rest.size()));
  }
  return fmt::format("{}: unknown word {}; {}it has to be one of {}", text.substr(0, colon), io::shown(value),
                     io::did_you_mean(value, words), fmt::join(words, ", "));
}

// The parser's text in other words, where it is hard to understand.
std::string plain(const std::string& text) {
  static constexpr std::string_view kConversion = "Could not convert: ";
  static constexpr std::string_view kIs = " = ";
  static constexpr std::string_view kExcludes = " excludes ";
  static constexpr std::string_view kNotIn = " not in {";
  static constexpr std::string_view kNotInRange = " not in range ";
  if (text.starts_with(kConversion)) {
    const std::size_t is = text.find(kIs);
    return fmt::format("{}: {} is not a number", text.substr(kConversion.size(), is - kConversion.size()),
                       io::shown(text.substr(is + kIs.size())));
  }
  const std::size_t colon = text.find(": ");
  if (const std::size_t at = text.find(kNotIn); at != std::string::npos && colon < at)
    return plain_choice(text, colon, at, kNotIn);
  if (const std::size_t at = text.find(kNotInRange); at != std::string::npos) {
    return fmt::format("{} is not within {}", text.substr(0, at), text.substr(at + kNotInRange.size()));
  }
  if (text.ends_with(" missing")) return fmt::format("{} needs a value", text.substr(0, text.find(':')));
  if (const std::size_t at = text.find(kExcludes); at != std::string::npos) {
    return fmt::format("{} cannot be combined with {}", text.substr(0, at),
                       text.substr(at + kExcludes.size()));
  }
  return text;
}

}  // namespace

std::string unknown_command(const CLI::App& app, std::string_view word) {
  std::vector<std::string_view> names;
  for (const CLI::App* command : commands_of(app)) names.push_back(command->get_name());
  return fmt::format("unknown command {}; {}see '{} --help'", io::shown(word), io::did_you_mean(word, names),
                     full_name(app));
}

std::optional<std::string> unknown_command_in(const CLI::App& app) {
  for (const CLI::App* of = &app; of != nullptr; of = chosen_in(*of)) {
    if (of->get_require_subcommand_min() == 0) continue;
    const std::vector<std::string> words = of->remaining();
    if (!words.empty()) return unexpected(*of, words.front());
  }
  return std::nullopt;
}

std::string usage_error(const CLI::App& app, const CLI::ParseError& error) {
  const CLI::App* of = &app;
  for (const CLI::App* next = of; next != nullptr; next = chosen_in(*next)) {
    of = next;
    if (const std::vector<std::string> words = of->remaining(); !words.empty())
      return unexpected(*of, words.front());
  }
  const std::string problem = lacks_command(*of) ? "a command is missing" : plain(error.what());
  const bool has_remedy = problem.find("; ") != std::string::npos;
  return has_remedy ? problem : fmt::format("{}; see '{} --help'", problem, full_name(*of));
}

}  // namespace groma::help
