#include "host/help/reference.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/io/version.hpp"

namespace groma::help {
namespace {

// The commands without subcommands, in the order of their definition; the program itself if it has none.
void append_commands(const CLI::App& app, std::vector<const CLI::App*>& out) {
  const std::vector<const CLI::App*> commands = commands_of(app);
  if (commands.empty()) out.push_back(&app);
  for (const CLI::App* command : commands) append_commands(*command, out);
}
std::vector<const CLI::App*> all_commands(const CLI::App& app) {
  std::vector<const CLI::App*> commands;
  append_commands(app, commands);
  return commands;
}

std::string joined(const std::vector<std::string>& words, std::string_view separator) {
  std::string out;
  for (const std::string& word : words) out += (out.empty() ? "" : std::string(separator)) + word;
  return out;
}

// CLI11 shows a type with its bounds, as in "UINT:UINT in [0 - 3]" and "TEXT:{final,next-poll}".
void split_type(std::string_view type, ShownOption& shown) {
  const std::size_t colon = type.find(':');
  shown.value = type.substr(0, colon);
  if (colon == std::string_view::npos) return;
  std::string_view bounds = type.substr(colon + 1);
  if (bounds.starts_with('{') && bounds.ends_with('}')) {
    bounds = bounds.substr(1, bounds.size() - 2);
    for (bool more = true; more;) {
      const std::size_t comma = bounds.find(',');
      shown.words.emplace_back(bounds.substr(0, comma));
      more = comma != std::string_view::npos;
      if (more) bounds.remove_prefix(comma + 1);
    }
    shown.text += fmt::format(" One of {}.", joined(shown.words, ", "));
  } else if (const std::size_t in = bounds.find("in ["); in != std::string_view::npos) {
    std::string range(bounds.substr(in + 4, bounds.size() - in - 5));
    if (const std::size_t dash = range.find(" - "); dash != std::string::npos) range.replace(dash, 3, " to ");
    shown.text += fmt::format(" From {}.", range);
  } else if (bounds == "POSITIVE") {
    shown.text += " Above 0.";
  }
}

std::vector<ShownOption> options_of(const CLI::App& app) {
  std::vector<ShownOption> out;
  for (const CLI::Option* option : app.get_options()) {
    if (!option->get_group().empty()) out.push_back(shown_of(*option));
  }
  // What has no name comes first, as on the command line.
  std::stable_partition(out.begin(), out.end(), [](const ShownOption& option) { return option.positional; });
  return out;
}

// Text for roff: no line begins with a control character, hyphens can be copied as minus.
std::string roff(std::string_view text) {
  std::string out;
  bool begins_line = true;
  for (const char c : text) {
    if (begins_line && (c == '.' || c == '\'')) out += "\\&";
    if (c == '-' || c == '\\') out += '\\';
    out += c == '\\' ? 'e' : c;
    begins_line = c == '\n';
  }
  return out;
}

std::string roff_options(const CLI::App& app) {
  std::string out;
  for (const ShownOption& option : options_of(app)) {
    out += ".TP\n";
    if (option.positional) {
      out += fmt::format("\\fI{}\\fR\n", roff(option.names.front()));
    } else {
      out += fmt::format("\\fB{}\\fR", roff(joined(option.names, ", ")));
      out += option.value.empty() ? "\n" : fmt::format(" \\fI{}\\fR\n", roff(option.value));
    }
    out += roff(option.text) + (option.required ? " Required.\n" : "\n");
  }
  return out;
}

// Examples and pages, line by line.
std::string roff_guide(const CLI::App& app) {
  const std::string guide = app.get_footer();
  return guide.empty() ? "" : fmt::format(".PP\n.nf\n{}\n.fi\n", roff(guide));
}

struct Word {
  std::string name;
  std::string text;  // what it means
};
// What may follow the words of a command.
struct Case {
  std::string before;  // those words, each with a space behind it
  bool runs = false;   // it has no subcommands: its other arguments are files
  std::vector<Word> words{};
};
// What may follow an option with a choice of words.
struct ValueCase {
  std::string before;
  std::string option;
  std::vector<std::string> words;
};
struct Cases {
  std::vector<Case> commands;  // a command's subcommands come before it
  std::vector<ValueCase> values;
};

void append_cases(const CLI::App& app, const std::string& before, Cases& out) {
  Case own{.before = before};
  for (const CLI::App* command : commands_of(app)) {
    append_cases(*command, before + command->get_name() + ' ', out);
    own.words.push_back({command->get_name(), first_sentence(command->get_description())});
  }
  own.runs = own.words.empty();
  for (const ShownOption& option : options_of(app)) {
    if (option.positional) {
      if (option.value != kCommandValue) continue;
      for (const CLI::App* command : commands_of(*app.get_parent()))
        own.words.push_back({command->get_name(), first_sentence(command->get_description())});
      own.runs = false;
      continue;
    }
    for (const std::string& name : option.names) {
      own.words.push_back({name, first_sentence(option.text)});
      if (!option.words.empty()) out.values.push_back({before, name, option.words});
    }
  }
  out.commands.push_back(std::move(own));
}

Cases cases_of(const CLI::App& app) {
  Cases cases;
  append_cases(app, "", cases);
  return cases;
}

// In single quotes; a colon separates name and text.
std::string zsh_word(const Word& word) {
  const auto escaped = [](std::string_view text) {
    std::string out;
    for (const char c : text) {
      if (c == ':' || c == '\\') out += '\\';
      out += c == '\'' ? "'\\''" : std::string(1, c == '\n' ? ' ' : c);
    }
    return out;
  };
  return fmt::format("'{}:{}'", escaped(word.name), escaped(word.text));
}

// As a block of code in Markdown.
std::string indented(std::string_view text) {
  std::string out;
  while (!text.empty()) {
    const std::size_t end = text.find('\n');
    out += fmt::format("    {}\n", text.substr(0, end));
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
  }
  return out;
}

// Text in a cell of a table.
std::string cell(std::string_view text) {
  std::string out;
  for (const char c : text) {
    if (c == '|') out += '\\';
    out += c == '\n' ? ' ' : c;
  }
  return out;
}

}  // namespace

std::vector<const CLI::App*> commands_of(const CLI::App& app) {
  return app.get_subcommands([](const CLI::App* command) { return !command->get_name().empty(); });
}

const CLI::App* find_command(const CLI::App& app, std::string_view name) {
  const std::vector<const CLI::App*> commands = commands_of(app);
  const auto found = std::find_if(commands.begin(), commands.end(),
                                  [name](const CLI::App* command) { return command->get_name() == name; });
  return found == commands.end() ? nullptr : *found;
}

std::string full_name(const CLI::App& app) {
  const CLI::App* const parent = app.get_parent();
  return parent == nullptr ? app.get_name() : full_name(*parent) + ' ' + app.get_name();
}

ShownOption shown_of(const CLI::Option& option) {
  ShownOption shown;
  for (const std::string& name : option.get_snames()) shown.names.push_back('-' + name);
  for (const std::string& name : option.get_lnames()) shown.names.push_back("--" + name);
  shown.positional = shown.names.empty();
  if (shown.positional) shown.names.push_back(option.get_name(true));
  shown.required = option.get_required();
  shown.text = option.get_description();
  if (!shown.text.empty() && shown.text.back() != '.') shown.text += '.';
  split_type(option.get_type_name(), shown);
  if (!option.get_default_str().empty()) shown.text += fmt::format(" Default: {}.", option.get_default_str());
  return shown;
}

std::string synopsis(const CLI::App& app) {
  std::string out = "[OPTIONS]";
  for (const ShownOption& option : options_of(app)) {
    if (!option.positional) continue;
    out += option.required ? ' ' + option.names.front() : " [" + option.names.front() + ']';
  }
  return commands_of(app).empty() ? out : out + " COMMAND ...";
}

std::string first_sentence(std::string_view text) {
  const std::size_t stop = text.find(". ");
  std::string_view sentence = text.substr(0, stop);
  if (sentence.ends_with('.')) sentence.remove_suffix(1);
  return std::string(sentence);
}

std::string manual_page(const CLI::App& app, int section, std::string_view exit_codes) {
  const std::string& name = app.get_name();
  std::string title = name;
  std::transform(title.begin(), title.end(), title.begin(),
                 [](unsigned char c) { return static_cast<char>(std::toupper(c)); });
  std::string page =
      fmt::format(".TH {} {} \"\" \"Groma {}\" \"Groma\"\n", title, section, io::program_version());
  page += fmt::format(".SH NAME\n{} \\- {}\n", name, roff(first_sentence(app.get_description())));
  page += fmt::format(".SH SYNOPSIS\n\\fB{}\\fR {}\n", name, roff(synopsis(app)));
  page +=
      fmt::format(".SH DESCRIPTION\n{}\n.SH OPTIONS\n{}", roff(app.get_description()), roff_options(app)) +
      roff_guide(app);
  const std::vector<const CLI::App*> commands = all_commands(app);
  if (commands.front() != &app) {
    page += ".SH COMMANDS\n";
    for (const CLI::App* command : commands) {
      const std::string words = roff(full_name(*command));
      page += fmt::format(".SS {}\n\\fB{}\\fR {}\n.PP\n{}\n{}{}", words, words, roff(synopsis(*command)),
                          roff(command->get_description()), roff_options(*command), roff_guide(*command));
    }
  }
  page += fmt::format(".SH EXIT STATUS\n{}\n", roff(exit_codes));
  page += ".SH SEE ALSO\n\\fBgroma\\fR(1), \\fBgromad\\fR(8)";
  return page;
}

std::string bash_completion(const CLI::App& app) {
  const std::string& name = app.get_name();
  const Cases cases = cases_of(app);
  std::string out = fmt::format("# Completion of {} for bash.\n_{}() {{\n", name, name);
  out += "  local current=${COMP_WORDS[COMP_CWORD]} words=\n";
  out += "  local line=\"${COMP_WORDS[*]:1:COMP_CWORD-1} \"\n  line=${line# }\n";
  out += "  case \"$line\" in\n";
  for (const Case& of : cases.commands) {
    std::vector<std::string> names;
    for (const Word& word : of.words) names.push_back(word.name);
    // The other arguments of a command are files, which readline completes where no word fits.
    out += fmt::format("    \"{}\"*) {}words='{}' ;;\n", of.before, of.runs ? "[[ $current == -* ]] && " : "",
                       joined(names, " "));
  }
  out += "  esac\n";
  if (!cases.values.empty()) out += "  case \"$line\" in\n";
  for (const ValueCase& of : cases.values) {
    out += fmt::format("    \"{}\"*\"{} \") words='{}' ;;\n", of.before, of.option, joined(of.words, " "));
  }
  if (!cases.values.empty()) out += "  esac\n";
  out += "  mapfile -t COMPREPLY < <(compgen -W \"$words\" -- \"$current\")\n}\n";
  out += fmt::format("complete -o default -F _{} {}", name, name);
  return out;
}

std::string zsh_completion(const CLI::App& app) {
  const std::string& name = app.get_name();
  const Cases cases = cases_of(app);
  std::string out = fmt::format("#compdef {0}\n# Completion of {0} for zsh.\n_{0}() {{\n", name);
  out += "  local line=\"${(j: :)words[2,CURRENT-1]} \" runs=\n  local -a found\n  line=${line# }\n";
  out += "  case \"$line\" in\n";
  for (const ValueCase& of : cases.values) {
    out += fmt::format("    \"{}\"*\"{} \") compadd -- {}; return ;;\n", of.before, of.option,
                       joined(of.words, " "));
  }
  for (const Case& of : cases.commands) {
    out += fmt::format("    \"{}\"*) {}found=(", of.before, of.runs ? "runs=1 " : "");
    for (const Word& word : of.words) out += "\n      " + zsh_word(word);
    out += ") ;;\n";
  }
  out += "  esac\n";
  out += "  if [[ -n $runs && ${words[CURRENT]} != -* ]]; then\n    _files\n  else\n";
  out += fmt::format("    _describe argument found\n  fi\n}}\n_{} \"$@\"", name);
  return out;
}

std::string option_tables(const CLI::App& app) {
  std::string out;
  for (const CLI::App* command : all_commands(app)) {
    const std::string words = full_name(*command);
    out += fmt::format("{}## {}\n\n    {} {}\n\n{}\n\n| option | |\n|---|---|\n", out.empty() ? "" : "\n",
                       words, words, synopsis(*command), command->get_description());
    for (const ShownOption& option : options_of(*command)) {
      const std::string value = option.value.empty() || option.positional ? "" : ' ' + option.value;
      out += fmt::format("| `{}{}` | {}{} |\n", joined(option.names, ", "), value, cell(option.text),
                         option.required ? " Required." : "");
    }
    if (!command->get_footer().empty()) out += "\n" + indented(command->get_footer());
  }
  out.pop_back();
  return out;
}

}  // namespace groma::help
