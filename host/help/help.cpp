#include "host/help/help.hpp"

#include <fmt/format.h>

#include <memory>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/help/reference.hpp"
#include "host/io/exit_code.hpp"

namespace groma::help {
namespace {

class HelpFormatter : public CLI::Formatter {
 public:
  [[nodiscard]] std::string make_subcommand(const CLI::App* command) const override {
    return fmt::format("{:<11}{}\n", command->get_name(), first_sentence(command->get_description()));
  }
};

// The words in place of a command where one is required.
std::vector<std::string> unknown_commands(const CLI::App& app) {
  if (app.get_require_subcommand_min() > 0 && app.remaining_size() > 0) return app.remaining();
  const std::vector<CLI::App*> chosen = app.get_subcommands();
  return chosen.empty() ? std::vector<std::string>() : unknown_commands(*chosen.front());
}

}  // namespace

void prepare(CLI::App& app, int manual_section, std::map<std::string, Print> more) {
  app.formatter(std::make_shared<HelpFormatter>());
  more.emplace("man", [&app, manual_section] { return manual_page(app, manual_section); });
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

std::optional<int> parse(CLI::App& app, int argc, const char* const* argv) {
  try {
    app.parse(argc, argv);
    return std::nullopt;
  } catch (const CLI::CallForHelp& call) {
    if (const std::vector<std::string> unknown = unknown_commands(app); !unknown.empty()) {
      app.exit(CLI::ExtrasError(unknown));
      return io::kUsage;
    }
    app.exit(call);
    return io::kGood;
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? io::kGood : io::kUsage;
  }
}

}  // namespace groma::help
