// Output of the commands: results to standard output, errors and warnings to standard error.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace groma::cli {

// Writes the text unchanged to standard output. Throws io::DeviceError if it cannot be written.
void say(std::string_view text);
// Throws io::DeviceError if the output of say() cannot be written.
void flush_output();

// Writes "groma: text" to standard error.
void complain(std::string_view text);

// On a terminal, shows that an action still runs: from 2 s on one line of standard error has its name, what
// show_progress() reported, and the seconds since its begin. say() and complain() clear the line, and so does
// the end. Elsewhere it does nothing. At most one exists at a time.
class Heartbeat {
 public:
  explicit Heartbeat(std::string action);
  Heartbeat(const Heartbeat&) = delete;
  Heartbeat& operator=(const Heartbeat&) = delete;
  ~Heartbeat();
};

// What the action does now, and the share that is done; none: unknown.
void show_progress(std::string_view phase, std::optional<double> done = std::nullopt);
// For an action that runs until it is stopped, or draws the terminal itself.
void stop_heartbeat();

// Columns of text with a line of titles; all but the first are right-aligned.
class Table {
 public:
  explicit Table(std::vector<std::string> titles) : rows_{std::move(titles)} {}
  // `cells` has one entry per title.
  void add(std::vector<std::string> cells) { rows_.push_back(std::move(cells)); }
  // The text ends with a line end; `text_last`: the last column is left-aligned.
  [[nodiscard]] std::string format(bool text_last = false) const;

 private:
  std::vector<std::vector<std::string>> rows_;
};

}  // namespace groma::cli
