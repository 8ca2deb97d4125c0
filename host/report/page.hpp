// A report as a single HTML file that opens offline: it loads no other resource and follows the reader's
// light or dark theme. Its script, report.js, adds hover and zoom to charts.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "host/report/chart.hpp"

namespace groma::report {

enum class Tone { kPlain, kGood, kWarning, kBad };

// A figure in large print with its name.
struct Fact {
  std::string value;
  std::string name;
  Tone tone = Tone::kPlain;
};

struct Cell {
  std::string text;
  Tone tone = Tone::kPlain;
  bool words = false;  // text: left-aligned and wrapped, unlike numbers
};

// Where a report comes from, for its foot.
struct Provenance {
  std::string command;  // as it was given
  std::string date;
  std::vector<std::pair<std::string, std::string>>
      versions{};  // of further files: name and version or digest
};

class Page {
 public:
  Page(std::string title, std::string subtitle) : title_(std::move(title)), subtitle_(std::move(subtitle)) {}

  void set_provenance(Provenance provenance) { provenance_ = std::move(provenance); }

  // Elements appear in the order of the calls; text is escaped.
  void add_facts(const std::vector<Fact>& facts);
  void add_heading(const std::string& text);
  // A part that the reader can open and close; `id` is the target of a mark's link.
  void begin_part(const std::string& id, const std::string& title, const std::string& remark, Tone tone,
                  bool open);
  void end_part();
  void add_text(const std::string& text);
  // A notice about `what`.
  void add_notice(const std::string& what, const std::string& text, Tone tone);
  void add_chart(const Chart& chart, const std::string& caption);
  // Several small charts side by side.
  void add_charts(const std::vector<Chart>& charts, const std::string& caption);
  // Each row has as many cells as there are titles.
  void add_table(const std::vector<std::string>& titles, const std::vector<std::vector<Cell>>& rows);

  [[nodiscard]] std::string html() const;

 private:
  std::string title_;
  std::string subtitle_;
  Provenance provenance_;
  bool has_charts_ = false;
  std::string body_;
};

}  // namespace groma::report
