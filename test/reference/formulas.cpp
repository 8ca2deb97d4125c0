#include "test/reference/formulas.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdlib>

#include "test/reference/page.hpp"

namespace groma::reference {

// Recursive descent: sum, product, factor.
class Formulas::Parser {
 public:
  Parser(const Formulas& formulas, std::string_view text, const Values& values)
      : formulas_(formulas), text_(text), values_(values) {}

  double parse() {
    const double result = sum();
    EXPECT_TRUE(at_end()) << text_;
    return result;
  }

 private:
  double sum() {
    double result = product();
    for (;;) {
      if (take("+")) {
        result += product();
      } else if (take("-")) {
        result -= product();
      } else {
        return result;
      }
    }
  }
  double product() {
    double result = factor();
    for (;;) {
      if (take("\u00B7") || starts_factor()) {
        result *= factor();
      } else if (take("/")) {
        result /= factor();
      } else {
        return result;
      }
    }
  }
  double factor() {
    if (take("(")) {
      const double result = sum();
      EXPECT_TRUE(take(")")) << text_;
      return result;
    }
    const std::string word = take_word();
    EXPECT_FALSE(word.empty()) << text_ << ", at " << at_;
    if (word.empty()) {
      at_ = text_.size();
      return 0.0;
    }
    if (std::isdigit(static_cast<unsigned char>(word[0])) != 0) return std::strtod(word.c_str(), nullptr);
    if (const auto found = values_.find(word); found != values_.end()) return found->second;
    std::vector<double> arguments;
    if (take("(")) {
      do {
        arguments.push_back(sum());
      } while (take(","));
      EXPECT_TRUE(take(")")) << text_;
    }
    return formulas_.call(word, arguments);
  }

  void skip_blanks() {
    while (at_ < text_.size() && text_[at_] == ' ') ++at_;
  }
  bool at_end() {
    skip_blanks();
    return at_ == text_.size();
  }
  bool starts_factor() {
    skip_blanks();
    return at_ < text_.size() && (is_word(text_[at_]) || text_[at_] == '(');
  }
  bool take(std::string_view token) {
    skip_blanks();
    if (text_.substr(at_, token.size()) != token) return false;
    at_ += token.size();
    return true;
  }
  // Digits, or a name: 2n is two words.
  std::string take_word() {
    skip_blanks();
    const std::size_t begin = at_;
    const auto is_digit = [&] { return std::isdigit(static_cast<unsigned char>(text_[at_])) != 0; };
    const bool numeric = at_ < text_.size() && is_digit();
    while (at_ < text_.size() && (numeric ? is_digit() : is_word(text_[at_]))) ++at_;
    return std::string(text_.substr(begin, at_ - begin));
  }
  static bool is_word(char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_'; }

  const Formulas& formulas_;
  std::string_view text_;
  const Values& values_;
  std::size_t at_ = 0;
};

void Formulas::define(const std::vector<std::string>& lines) {
  for (const std::string& line : lines) {
    const auto equals = line.find(" = ");
    if (equals == std::string::npos) continue;
    std::string name = line.substr(0, equals);
    Function function;
    if (const auto open = name.find('('); open != std::string::npos) {
      std::string parameter;
      for (const char c : name.substr(open + 1)) {
        if (c == ',' || c == ')') {
          function.parameters.push_back(trimmed(parameter));
          parameter.clear();
        } else {
          parameter += c;
        }
      }
      name.resize(open);
    }
    const std::string right = line.substr(equals + 3);
    function.expression = right.substr(0, right.find("   "));
    EXPECT_EQ(functions_.count(name), 0U) << "defined twice: " << name;
    functions_[name] = function;
  }
}

double Formulas::value(std::string_view expression, const Values& values) const {
  return Parser(*this, expression, values).parse();
}

double Formulas::call(const std::string& name, const std::vector<double>& arguments) const {
  if (name == "up" && arguments.size() == 1) return 512.0 * std::ceil(arguments[0] / 512.0);
  if (name == "ceil" && arguments.size() == 1) return std::ceil(arguments[0]);
  if (name == "max" && arguments.size() == 2) return std::max(arguments[0], arguments[1]);
  const auto found = functions_.find(name);
  const bool known = found != functions_.end() && found->second.parameters.size() == arguments.size();
  EXPECT_TRUE(known) << name << " with " << arguments.size() << " arguments";
  if (!known) return 0.0;
  Values values = values_;
  for (std::size_t i = 0; i < arguments.size(); ++i) values[found->second.parameters[i]] = arguments[i];
  return value(found->second.expression, values);
}

}  // namespace groma::reference
