// Evaluates the formulas of a page: numbers, variables, functions, + - /, the dot of multiplication or
// nothing in its place, and the functions up (to a multiple of 512), max and ceil.
#pragma once

#include <map>
#include <string>
#include <string_view>
#include <vector>

namespace groma::reference {

class Formulas {
 public:
  // Takes lines of the form "name = expression" or "name(a, b) = expression"; a comment may follow after
  // three blanks. Ignores other lines.
  void define(const std::vector<std::string>& lines);
  // Overrides a formula of this name.
  void set(const std::string& name, double value) { values_[name] = value; }

  // A failed test and 0 if the expression is not valid or names something unknown.
  [[nodiscard]] double value(std::string_view expression) const { return value(expression, values_); }

 private:
  using Values = std::map<std::string, double>;
  struct Function {
    std::vector<std::string> parameters;
    std::string expression;
  };
  class Parser;

  [[nodiscard]] double value(std::string_view expression, const Values& values) const;
  [[nodiscard]] double call(const std::string& name, const std::vector<double>& arguments) const;

  Values values_;
  std::map<std::string, Function> functions_;
};

}  // namespace groma::reference
