// Help, manual page, completion and tables of options of groma, and the pages of docs/reference that have to
// agree.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <regex>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma {
namespace {

using test::ChildResult;
using test::read_text;
using testing::HasSubstr;
using testing::IsEmpty;

const std::filesystem::path kReference = std::filesystem::path(GROMA_SOURCE_DIR) / "docs" / "reference";

ChildResult groma(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), GROMA_EXECUTABLE);
  return test::run_child(arguments);
}

std::string printed(const std::string& format) {
  const ChildResult result = groma({"--print-reference", format});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  return result.out;
}

// Long options in a text.
std::set<std::string> options_in(const std::string& text) {
  static const std::regex kOption("(?:^|[^-\\w])(--[a-z][-a-z0-9]*)");
  std::set<std::string> out;
  for (std::sregex_iterator match(text.begin(), text.end(), kOption), end; match != end; ++match) {
    out.insert((*match)[1]);
  }
  return out;
}

// The sections of a page in Markdown by their headings of the second level, without `prefix`.
std::map<std::string, std::string> sections(const std::string& page, const std::string& prefix) {
  std::map<std::string, std::string> out;
  std::istringstream lines(page);
  std::string* section = nullptr;
  for (std::string line; std::getline(lines, line);) {
    const std::string heading = "## " + prefix;
    if (line.rfind("## ", 0) == 0) {
      section = line.rfind(heading, 0) == 0 ? &out[line.substr(heading.size())] : nullptr;
    } else if (section != nullptr) {
      *section += line + '\n';
    }
  }
  return out;
}

// The options of each command, by the tables that groma prints.
std::map<std::string, std::set<std::string>> defined_options() {
  std::map<std::string, std::set<std::string>> out;
  for (const auto& [command, text] : sections(printed("markdown"), "groma ")) {
    std::istringstream lines(text);
    for (std::string line; std::getline(lines, line);) {
      if (line.rfind("| `", 0) != 0) continue;
      out[command].merge(options_in(line.substr(0, line.find("` |"))));
    }
    out[command].erase("--help");
  }
  return out;
}

TEST(Help, HasEachCommandAtTheStartOfALineOfItsOwn) {
  const ChildResult help = groma({"--help"});
  ASSERT_EQ(help.exit_code, 0);
  std::set<std::string> first_words;
  std::istringstream lines(help.out);
  for (std::string line; std::getline(lines, line);) first_words.insert(line.substr(0, line.find(' ')));
  const auto commands = defined_options();
  EXPECT_GE(commands.size(), 16U);
  for (const auto& [command, options] : commands) {
    EXPECT_TRUE(first_words.contains(command.substr(0, command.find(' ')))) << command << "\n" << help.out;
  }
}

TEST(Help, OfACommandThatDoesNotExistIsAUsageError) {
  const ChildResult help = groma({"nonsense", "--help"});
  EXPECT_EQ(help.exit_code, 2);
  EXPECT_THAT(help.out, IsEmpty());
  EXPECT_THAT(help.err, HasSubstr("nonsense"));
  EXPECT_EQ(groma({"--help", "nonsense"}).exit_code, 2);
  EXPECT_EQ(groma({"surface", "nonsense", "--help"}).exit_code, 2);
  EXPECT_EQ(groma({"nonsense"}).exit_code, 2);
  EXPECT_EQ(groma({"calibrate", "--help"}).exit_code, 0);
  EXPECT_EQ(groma({"surface", "fit", "--help"}).exit_code, 0);
  EXPECT_EQ(groma({"--print-reference", "nonsense"}).exit_code, 2);
}

TEST(Help, NamesTheCommandOrOptionThatWasMeant) {
  const std::vector<std::pair<std::vector<std::string>, std::string>> kMeant{
      {{"calibrat"}, "groma: unknown command 'calibrat'; did you mean 'calibrate'? see 'groma --help'\n"},
      {{"--verson"}, "groma: unknown option '--verson'; did you mean '--version'? see 'groma --help'\n"},
      {{"surface", "fi"}, "groma: unknown command 'fi'; did you mean 'fit'? see 'groma surface --help'\n"},
      {{"replay", "--modle", "joint", "drive"},
       "groma: unknown option '--modle'; did you mean '--model'? see 'groma replay --help'\n"},
      {{"replay", "drive", "--model", "jiont"},
       "groma: --model: unknown word 'jiont'; did you mean 'joint'? it has to be one of odometry, original, "
       "inflated, schmidt, anchor-states, joint\n"},
      {{"calibrate", "drive", "out.yaml"},
       "groma: unexpected argument 'out.yaml'; did you mean '--output out.yaml'? see 'groma calibrate "
       "--help'\n"},
      {{"dance"}, "groma: unknown command 'dance'; see 'groma --help'\n"},
  };
  for (const auto& [arguments, text] : kMeant) {
    const ChildResult result = groma(arguments);
    EXPECT_EQ(result.exit_code, 2) << text;
    EXPECT_EQ(result.err, text);
    EXPECT_THAT(result.out, IsEmpty());
  }
}

TEST(Help, SaysInPlainWordsWhatIsWrong) {
  const std::vector<std::pair<std::vector<std::string>, std::string>> kErrors{
      {{}, "groma: a command is missing; see 'groma --help'\n"},
      {{"surface"}, "groma: a command is missing; see 'groma surface --help'\n"},
      {{"survey"}, "groma: PORT is required; see 'groma survey --help'\n"},
      {{"demo", "--seed", "abc"}, "groma: --seed: 'abc' is not a number; see 'groma demo --help'\n"},
      {{"demo", "--seed"}, "groma: --seed needs a value; see 'groma demo --help'\n"},
      {{"explain", "drive", "--window", "0"},
       "groma: --window: '0' is not a number above 0; see 'groma explain --help'\n"},
      {{"replay", "drive", "--from", "3s"},
       "groma: --from: '3s' is not a number; give seconds without a unit, such as 12.5\n"},
      {{"plan", "--tags", "99"}, "groma: --tags: Value 99 is not within 1 to 16; see 'groma plan --help'\n"},
      {{"plan", "plan.yaml", "--tags", "3"},
       "groma: PLAN cannot be combined with --tags; see 'groma plan --help'\n"},
  };
  for (const auto& [arguments, text] : kErrors) {
    const ChildResult result = groma(arguments);
    EXPECT_EQ(result.exit_code, 2) << text;
    EXPECT_EQ(result.err, text);
  }
}

TEST(Help, IsACommandToo) {
  EXPECT_EQ(groma({"help"}).out, groma({"--help"}).out);
  EXPECT_EQ(groma({"help", "calibrate"}).out, groma({"calibrate", "--help"}).out);
  EXPECT_EQ(groma({"help", "surface", "fit"}).out, groma({"surface", "fit", "--help"}).out);
  EXPECT_EQ(groma({"help", "--help"}).exit_code, 0);
  const ChildResult unknown = groma({"help", "calibrat"});
  EXPECT_EQ(unknown.exit_code, 2);
  EXPECT_THAT(unknown.err, HasSubstr("did you mean 'calibrate'?"));
}

// Each example is one of the command's own, or of a command that goes with it, and has options that exist.
TEST(Help, OfEachCommandHasExamplesAndPages) {
  const auto commands = defined_options();
  for (const auto& [command, options] : commands) {
    std::vector<std::string> words{"help"};
    std::istringstream of(command);
    for (std::string word; of >> word;) words.push_back(word);
    const std::string help = groma(words).out;
    std::istringstream lines(help);
    std::size_t examples = 0;
    for (std::string line; std::getline(lines, line);) {
      EXPECT_LE(line.size(), 110U) << line;
      EXPECT_THAT(line, testing::Not(testing::ContainsRegex("(TEXT|UINT|FLOAT|INT)( |$)"))) << command;
      if (line.rfind("  groma ", 0) != 0) continue;
      ++examples;
      const std::string typed = line.substr(8) + ' ';
      const auto run = std::find_if(commands.begin(), commands.end(),
                                    [&](const auto& each) { return typed.rfind(each.first + ' ', 0) == 0; });
      ASSERT_NE(run, commands.end()) << line;
      for (const std::string& option : options_in(line)) EXPECT_TRUE(run->second.contains(option)) << line;
    }
    EXPECT_GE(examples, 2U) << command;
    std::smatch page;
    ASSERT_TRUE(std::regex_search(help, page, std::regex("\nDocumentation: ([^,#\n]+)"))) << command;
    EXPECT_TRUE(std::filesystem::exists(kReference / "../.." / page[1].str())) << page[1];
  }
}

TEST(Reference, IndexOfCommandsHasEachCommand) {
  const std::string page = read_text(kReference / "commands.md");
  for (const auto& [command, options] : defined_options()) {
    const std::string anchor = std::regex_replace("groma " + command, std::regex(" "), "-");
    EXPECT_THAT(page, HasSubstr("| [`" + command + "`](#" + anchor + ") | "));
  }
}

TEST(Reference, PageOfOptionsIsThePrintedOne) {
  const std::string page = read_text(kReference / "options.md");
  const std::string text = printed("markdown");
  ASSERT_THAT(page, HasSubstr(text.substr(0, text.find('\n'))));
  const std::size_t begin = page.find("\n## groma ") + 1;
  EXPECT_EQ(page.substr(begin, text.size()), text)
      << "replace it by the output of groma --print-reference markdown";
}

// The first indented lines of a section are the command's usage.
TEST(Reference, UsageOfEachCommandHasAllItsOptions) {
  const auto documented = sections(read_text(kReference / "commands.md"), "groma ");
  for (const auto& [command, options] : defined_options()) {
    ASSERT_TRUE(documented.contains(command)) << command;
    const std::string& section = documented.at(command);
    const std::size_t begin = section.find("\n    groma ");
    ASSERT_NE(begin, std::string::npos) << command;
    const std::string usage = section.substr(begin, section.find("\n\n", begin + 1) - begin);
    EXPECT_EQ(options_in(std::regex_replace(usage, std::regex(" -o "), " --output ")), options) << command;
  }
}

TEST(Reference, ManualPageHasEachCommandAndOption) {
  std::string page = printed("man");
  EXPECT_EQ(page.rfind(".TH GROMA 1 ", 0), 0U) << page.substr(0, 80);
  page = std::regex_replace(page, std::regex("\\\\-"), "-");
  for (const auto& [command, options] : defined_options()) {
    const std::size_t begin = page.find(".SS groma " + command + "\n");
    ASSERT_NE(begin, std::string::npos) << command;
    const std::string section = page.substr(begin, page.find("\n.S", begin + 1) - begin);
    for (const std::string& option : options) EXPECT_THAT(section, HasSubstr(option + "\\fR")) << command;
  }
}

TEST(Reference, CompletionKnowsCommandsOptionsAndTheirWords) {
  const test::ScratchFolder folder;
  folder.write("groma", printed("bash"));
  const auto after = [&](const std::vector<std::string>& words) {
    std::vector<std::string> arguments{
        "/bin/bash", "-c",
        "set -u; . \"$0\"; COMP_WORDS=(\"$@\"); COMP_CWORD=$(($# - 1)); _groma; echo \"${COMPREPLY[*]-}\"",
        (folder / "groma").string(), "groma"};
    arguments.insert(arguments.end(), words.begin(), words.end());
    const ChildResult result = test::run_child(arguments);
    EXPECT_THAT(result.err, IsEmpty());
    return result.out;
  };
  EXPECT_EQ(after({"cal"}), "calibrate\n");
  EXPECT_EQ(after({"su"}), "surface survey\n");
  EXPECT_EQ(after({"help", "cal"}), "calibrate\n");
  EXPECT_EQ(after({"surface", ""}), "fit -h --help\n");
  EXPECT_EQ(after({"surface", "fit", "--sp"}), "--spacing\n");
  EXPECT_EQ(after({"calibrate", "--known"}), "--known-anchors\n");
  EXPECT_EQ(after({"plan", "--method", ""}), "final next-poll\n");
  EXPECT_EQ(after({"calibrate", ""}), "\n") << "files, by readline";
}

// zsh's own functions are replaced by ones that print what they are given.
TEST(Reference, CompletionForZshKnowsTheSame) {
  const test::ScratchFolder folder;
  folder.write("_groma", printed("zsh"));
  const auto after = [&](const std::vector<std::string>& words) {
    std::vector<std::string> arguments{
        "/usr/bin/zsh",
        "-f",
        "-c",
        "setopt nounset; _describe() { local word; for word in ${(P)2}; do [[ $word == ${words[CURRENT]}* ]] "
        "&& "
        "print -r -- $word; done; true; }; _files() { print files; }; compadd() { shift; print -r -- $*; }; "
        "file=$1; shift; words=(groma \"$@\"); CURRENT=$#words; . $file",
        "zsh",
        (folder / "_groma").string()};
    arguments.insert(arguments.end(), words.begin(), words.end());
    const ChildResult result = test::run_child(arguments);
    EXPECT_THAT(result.err, IsEmpty());
    return result.out;
  };
  EXPECT_THAT(after({"cal"}), testing::StartsWith("calibrate:"));
  EXPECT_THAT(after({"su"}), testing::ContainsRegex("^surface:.+\nsurvey:.+\n$"));
  EXPECT_THAT(after({"help", "cal"}), testing::StartsWith("calibrate:"));
  EXPECT_THAT(after({"surface", ""}), testing::StartsWith("fit:"));
  EXPECT_THAT(after({"surface", "fit", "--sp"}), testing::StartsWith("--spacing:"));
  EXPECT_THAT(after({"calibrate", "--known"}), testing::StartsWith("--known-anchors:"));
  EXPECT_EQ(after({"plan", "--method", ""}), "final next-poll\n");
  EXPECT_EQ(after({"calibrate", ""}), "files\n");
}

}  // namespace
}  // namespace groma
