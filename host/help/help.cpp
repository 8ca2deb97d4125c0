#include "host/help/help.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <utility>

#include <CLI/CLI.hpp>

#include "host/help/reference.hpp"
#include "host/help/usage_error.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"

namespace groma::help {
namespace {

constexpr std::size_t kWidth = 100;
constexpr std::size_t kTextColumn = 26;

// Lines of at most kWidth characters; each but the first begins with `indent` spaces, the first is indented
// already.
std::string wrapped(std::string_view text, std::size_t indent) {
  std::string out;
  std::size_t column = indent;
  while (!text.empty()) {
    const std::size_t end = text.find(' ');
    const std::string_view word = text.substr(0, end);
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
    if (column > indent && column + 1 + word.size() > kWidth) {
      out += '\n' + std::string(indent, ' ');
      column = indent;
    }
    if (column > indent) {
      out += ' ';
      ++column;
    }
    out += word;
    column += word.size();
  }
  return out;
}

class HelpFormatter : public CLI::Formatter {
 public:
  explicit HelpFormatter(std::string exit_codes) : exit_codes_(std::move(exit_codes)) {}

  [[nodiscard]] std::string make_description(const CLI::App* app) const override {
    return wrapped(app->get_description(), 0) + "\n\n";
  }
  [[nodiscard]] std::string make_usage(const CLI::App* app, std::string /*name*/) const override {
    return fmt::format("Usage: {} {}\n", full_name(*app), synopsis(*app));
  }
  [[nodiscard]] std::string make_option(const CLI::Option* option, bool /*is_positional*/) const override {
    const ShownOption shown = shown_of(*option);
    std::string names = "  ";
    for (const std::string& name : shown.names) names += (names.size() > 2 ? ", " : "") + name;
    if (!shown.value.empty() && !shown.positional) names += ' ' + shown.value;
    names += names.size() + 2 > kTextColumn ? '\n' + std::string(kTextColumn, ' ')
                                            : std::string(kTextColumn - names.size(), ' ');
    return names + wrapped(shown.text + (shown.required ? " Required." : ""), kTextColumn) + '\n';
  }
  [[nodiscard]] std::string make_subcommand(const CLI::App* command) const override {
    return fmt::format("{:<11}{}\n", command->get_name(), first_sentence(command->get_description()));
  }
  [[nodiscard]] std::string make_footer(const CLI::App* app) const override {
    const std::string guide = app->get_footer();
    return guide + (guide.empty() ? "" : "\n\n") + exit_codes_ + '\n';
  }

 private:
  std::string exit_codes_;
};

std::string help_of(const CLI::App& app) {
  return app.get_formatter()->make_help(&app, full_name(app), CLI::AppFormatMode::Normal);
}

// Prints a text that ends with one line end.
void print(std::string text) {
  while (text.ends_with('\n')) text.pop_back();
  fmt::print("{}\n", text);
}

int refuse(const CLI::App& app, const std::string& text) {
  fmt::print(stderr, "{}: {}\n", app.get_name(), text);
  return io::kUsage;
}

}  // namespace

void prepare(CLI::App& app, int manual_section, const std::string& exit_codes,
             std::map<std::string, Print> more) {
  app.formatter(std::make_shared<HelpFormatter>(exit_codes));
  more.emplace("man",
               [&app, manual_section, exit_codes] { return manual_page(app, manual_section, exit_codes); });
  more.emplace("bash", [&app] { return bash_completion(app); });
  more.emplace("zsh", [&app] { return zsh_completion(app); });
  more.emplace("markdown", [&app] { return option_tables(app); });
  app.add_option_function<std::string>("--print-reference",
                                       [more = std::move(more)](const std::string& format) {
                                         const auto print = more.find(format);
                                         if (print == more.end()) {
                                           throw CLI::ValidationError("--print-reference", "no such format");
                                         }
                                         throw CLI::CallForVersion(print->second(), 0);
                                       })
      ->group("");
}

void add_help_command(CLI::App& app) {
  const auto words = std::make_shared<std::vector<std::string>>();
  CLI::App* command = app.add_subcommand(
      "help", "Print the help of a command. Without a command it prints the list of all commands.");
  command->add_option("COMMAND", *words, "Its name, such as calibrate or surface fit")
      ->type_name(std::string(kCommandValue));
  command->callback([&app, words] {
    const CLI::App* of = &app;
    for (const std::string& word : *words) {
      const CLI::App* const next = find_command(*of, word);
      if (next == nullptr) throw CLI::ValidationError(unknown_command(*of, word));
      of = next;
    }
    throw CLI::CallForVersion(help_of(*of), 0);
  });
}

void add_guides(CLI::App& app, std::span<const Guide> guides) {
  for (const Guide& guide : guides) {
    CLI::App* of = &app;
    for (std::string_view rest = guide.command; !rest.empty();) {
      const std::string word(rest.substr(0, rest.find(' ')));
      rest.remove_prefix(std::min(rest.size(), word.size() + 1));
      of = of->get_subcommand(word);
    }
    std::string text = guide.examples.empty() ? "" : "Examples:\n";
    for (const Example& example : guide.examples)
      text += fmt::format("  # {}\n  {}\n", example.purpose, example.command);
    of->footer(fmt::format("{}Documentation: {}", text, guide.pages));
  }
}

CLI::Validator above_zero() {
  return {[](std::string& text) {
            char* end = nullptr;
            const double value = std::strtod(text.c_str(), &end);
            const bool is_number = end != text.c_str() && *end == '\0';
            if (is_number && std::isfinite(value) && value > 0.0) return std::string();
            return fmt::format("{} is not a number above 0", io::shown(text));
          },
          "POSITIVE"};
}

std::optional<int> parse(CLI::App& app, int argc, const char* const* argv) {
  try {
    app.parse(argc, argv);
    return std::nullopt;
  } catch (const CLI::CallForHelp&) {
    if (const auto error = unknown_command_in(app)) return refuse(app, *error);
    const CLI::App* of = &app;
    while (!of->get_subcommands().empty()) of = of->get_subcommands().front();
    print(help_of(*of));
    return io::kGood;
  } catch (const CLI::CallForVersion& call) {
    print(call.what());
    return io::kGood;
  } catch (const CLI::ParseError& error) {
    return refuse(app, usage_error(app, error));
  }
}

int guarded(const std::function<int()>& run, const std::function<void(std::string_view)>& complain) {
  try {
    return run();
  } catch (const CLI::Error& error) {
    complain(error.what());
    return io::kUsage;
  } catch (const io::DataError& error) {
    complain(error.what());
    return io::kBadData;
  } catch (const io::ConfigError& error) {
    complain(error.what());
    return io::kBadConfiguration;
  } catch (const io::PermissionError& error) {
    complain(error.what());
    return io::kNoPermission;
  } catch (const io::PathError& error) {
    complain(error.what());
    return io::kUsage;
  } catch (const std::exception& error) {
    complain(error.what());
    return io::kUnavailable;
  }
}

}  // namespace groma::help
