// Problems that did not stop the command: printed at once, and remembered for the exit code.
#pragma once

#include <string>

#include "host/diagnosis/finding.hpp"
#include "host/io/dataset.hpp"
#include "host/io/exit_code.hpp"

namespace groma::cli {

class Warnings {
 public:
  void add(const std::string& text);
  // Two lines: what is wrong, and what to do.
  void add(const diagnosis::Finding& finding);
  // One warning for all dropped rows; none if no row was dropped.
  void add(const io::DroppedRows& dropped);
  // The data set's dropped rows, and damaged bytes of its log.
  void add(const io::Dataset& dataset);
  // Printed as a note, which does not change the exit code.
  static void note(const std::string& text);
  [[nodiscard]] int exit_code() const { return any_ ? io::kDoneWithWarnings : io::kGood; }

 private:
  bool any_ = false;
};

}  // namespace groma::cli
