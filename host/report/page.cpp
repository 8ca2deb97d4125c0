#include "host/report/page.hpp"

#include <fmt/format.h>

#include <string_view>

#include "generated/report_files.hpp"
#include "host/io/version.hpp"
#include "host/report/html.hpp"

namespace groma::report {

namespace {

// One style per ink: it colours the strokes of lines and the fill of marks.
std::string ink_style() {
  std::string style;
  for (const std::string_view ink : {"truth", "estimate", "path", "other", "wall", "anchor", "warn", "bad",
                                     "good", "s1", "s2", "s3", "s4"}) {
    style += fmt::format(
        ".line.{0},.stroke.{0},.interval.{0},.ellipse.{0},.points.{0},.mark.start.{0}{{stroke:var(--{0})}} "
        ".mark.{0}:not(.start),.ellipse.{0},.band.{0},.bar.{0}{{fill:var(--{0})}}\n",
        ink);
  }
  return style;
}

std::string_view css_class(Tone tone) {
  switch (tone) {
    case Tone::kPlain:
      return "";
    case Tone::kGood:
      return "good";
    case Tone::kWarning:
      return "warning";
    case Tone::kBad:
      return "badly";
  }
  return "";
}

}  // namespace

void Page::add_facts(const std::vector<Fact>& facts) {
  body_ += "<div class=\"facts\">\n";
  for (const Fact& fact : facts) {
    body_ += fmt::format("<div class=\"fact\"><b class=\"{}\">{}</b><span>{}</span></div>\n",
                         css_class(fact.tone), escaped(fact.value), escaped(fact.name));
  }
  body_ += "</div>\n";
}

void Page::add_heading(const std::string& text) {
  body_ += fmt::format("<h2>{}</h2>\n", escaped(text));
}

void Page::begin_part(const std::string& id, const std::string& title, const std::string& remark, Tone tone,
                      bool open) {
  body_ += fmt::format("<details id=\"{}\"{}><summary><b>{}</b> <span class=\"{}\">{}</span></summary>\n",
                       escaped(id), open ? " open" : "", escaped(title), css_class(tone), escaped(remark));
}

void Page::end_part() {
  body_ += "</details>\n";
}

void Page::add_text(const std::string& text) {
  body_ += fmt::format("<p>{}</p>\n", escaped(text));
}

void Page::add_notice(const std::string& what, const std::string& text, Tone tone) {
  body_ +=
      fmt::format("<p class=\"notice {}\"><b>{}</b> {}</p>\n", css_class(tone), escaped(what), escaped(text));
}

void Page::add_chart(const Chart& chart, const std::string& caption) {
  has_charts_ = true;
  body_ +=
      fmt::format("<figure>\n{}<figcaption>{}</figcaption>\n</figure>\n", chart.html(), escaped(caption));
}

void Page::add_charts(const std::vector<Chart>& charts, const std::string& caption) {
  has_charts_ = true;
  body_ += "<figure>\n<div class=\"multiples\">\n";
  for (const Chart& chart : charts) body_ += chart.html();
  body_ += fmt::format("</div>\n<figcaption>{}</figcaption>\n</figure>\n", escaped(caption));
}

void Page::add_table(const std::vector<std::string>& titles, const std::vector<std::vector<Cell>>& rows) {
  body_ += "<div class=\"table\"><table>\n<thead><tr>";
  for (std::size_t i = 0; i < titles.size(); ++i) {
    const bool words = !rows.empty() && rows.front()[i].words;
    body_ += fmt::format("<th{}>{}</th>", words ? " class=\"words\"" : "", escaped(titles[i]));
  }
  body_ += "</tr></thead>\n<tbody>\n";
  for (const std::vector<Cell>& row : rows) {
    body_ += "<tr>";
    for (const Cell& cell : row) {
      body_ += fmt::format("<td class=\"{}{}\">{}</td>", css_class(cell.tone), cell.words ? " words" : "",
                           escaped(cell.text));
    }
    body_ += "</tr>\n";
  }
  body_ += "</tbody></table></div>\n";
}

std::string Page::html() const {
  std::string text = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n";
  text += "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n";
  text += fmt::format("<title>{}</title>\n<style>{}{}</style>\n</head>\n<body>\n<main>\n", escaped(title_),
                      kStyle, ink_style());
  text += fmt::format("<h1>{}</h1>\n<p class=\"subtitle\">{}</p>\n", escaped(title_), escaped(subtitle_));
  if (has_charts_) {
    text +=
        "<p class=\"howto\" hidden>Hover over a chart for its values. Wheel or drag to zoom, drag with Shift "
        "to move, "
        "double-click to show all.</p>\n";
  }
  text += body_;
  text += "<footer>\n<dl>\n";
  const auto add = [&text](std::string_view name, std::string_view value, std::string_view element) {
    if (value.empty()) return;
    text += fmt::format("<dt>{0}</dt><dd><{2}>{1}</{2}></dd>\n", escaped(name), escaped(value), element);
  };
  add("command", provenance_.command, "code");
  add("written", provenance_.date, "span");
  add("groma", io::build_name(), "span");
  for (const auto& [name, version] : provenance_.versions) add(name, version, "span");
  text += "</dl>\n</footer>\n</main>\n";
  if (has_charts_) text += fmt::format("<script>\n{}</script>\n", kScript);
  text += "</body>\n</html>\n";
  return text;
}

}  // namespace groma::report
