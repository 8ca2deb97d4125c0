#include "host/report/page.hpp"

#include <fmt/format.h>

#include <string_view>

#include "host/io/version.hpp"
#include "host/report/html.hpp"

namespace groma::report {

namespace {

constexpr std::string_view kStyle = R"css(
:root {
  color-scheme: light dark;
  --paper: #fbfbfa; --card: #ffffff; --ink: #1d2430; --soft: #667085; --rule: #e4e7ec; --grid: #eef0f3;
  --truth: #344054; --estimate: #2563eb; --path: #93a4bd; --wall: #475467; --anchor: #6d28d9;
  --good: #067647; --warn: #b54708; --bad: #d92d20;
  --s1: #2563eb; --s2: #d97706; --s3: #0d9488; --s4: #9333ea; --other: #98a2b3;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #101418; --card: #171c22; --ink: #e6e9ee; --soft: #98a2b3; --rule: #2b323b; --grid: #222931;
    --truth: #d0d5dd; --estimate: #6ea8fe; --path: #5d6f8a; --wall: #98a2b3; --anchor: #b794f6;
    --good: #4ade80; --warn: #fbbf24; --bad: #ff6b5e;
    --s1: #6ea8fe; --s2: #f5b04c; --s3: #4fd1c5; --s4: #c99bff; --other: #667085;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 36px 20px 60px; }
h1 { font-size: 27px; line-height: 1.2; margin: 0; letter-spacing: -0.01em; }
h2 { font-size: 18px; margin: 36px 0 10px; }
p { margin: 6px 0; max-width: 78ch; }
.subtitle, figcaption, footer { color: var(--soft); }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin: 22px 0; }
.fact { background: var(--card); border: 1px solid var(--rule); border-radius: 10px; padding: 12px 16px; }
.fact b { display: block; font-size: 22px; font-weight: 650; font-variant-numeric: tabular-nums; }
.fact span { color: var(--soft); font-size: 13px; }
figure { margin: 14px 0; background: var(--card); border: 1px solid var(--rule); border-radius: 10px; padding: 12px 12px 10px; }
figcaption { font-size: 13px; padding: 6px 6px 0; max-width: 100ch; }
.multiples { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 4px 10px; }
svg { display: block; width: 100%; height: auto; font: 12px system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif; }
.table { overflow-x: auto; border: 1px solid var(--rule); border-radius: 10px; background: var(--card); }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 7px 12px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--rule); }
th { color: var(--soft); font-weight: 600; font-size: 12.5px; }
th:first-child, td:first-child { text-align: left; font-weight: 600; }
th.words, td.words { text-align: left; white-space: normal; min-width: 14em; }
tr:last-child td { border-bottom: 0; }
.notice { max-width: none; border-left: 4px solid currentColor; padding: 6px 14px; background: var(--card); border-radius: 4px; }
.good { color: var(--good); } .warning { color: var(--warn); } .badly { color: var(--bad); }
footer { margin-top: 40px; font-size: 13px; }
.grid { stroke: var(--grid); fill: none; } .grid.zero { stroke: var(--path); }
.frame { fill: none; stroke: var(--rule); }
.tick { fill: var(--soft); font-size: 11.5px; } .axis { fill: var(--soft); }
.title { fill: var(--ink); font-weight: 600; font-size: 13.5px; }
.legend { fill: var(--ink); }
.label { fill: var(--ink); font-size: 12px; font-weight: 600; paint-order: stroke; stroke: var(--card); stroke-width: 3px; }
.line { fill: none; stroke-width: 1.6; stroke-linejoin: round; } .dashed { stroke-dasharray: 6 4; }
.stroke { fill: none; stroke-width: 3.5; stroke-linecap: round; }
.interval { fill: none; stroke-width: 1.6; }
.mark { stroke: var(--card); stroke-width: 1; }
.points { fill: none; stroke-width: 2.4; stroke-linecap: round; stroke-opacity: 0.75; }
details { border: 1px solid var(--rule); border-radius: 10px; background: var(--card); margin: 10px 0; padding: 0 16px; }
details[open] { padding-bottom: 12px; }
details figure { border: 0; padding: 0; } details .table { margin: 4px 0 10px; }
summary { cursor: pointer; padding: 10px 0; } summary b { margin-right: 10px; }
details:target { border-color: var(--estimate); }
.ellipse { fill-opacity: 0.16; stroke-width: 1.2; stroke-opacity: 0.9; }
)css";

// One style per ink: it colours the strokes of lines and the fill of marks.
std::string ink_style() {
  std::string style;
  for (const std::string_view ink : {"truth", "estimate", "path", "other", "wall", "anchor", "warn", "bad",
                                     "good", "s1", "s2", "s3", "s4"}) {
    style += fmt::format(
        ".line.{0},.stroke.{0},.interval.{0},.ellipse.{0},.points.{0}{{stroke:var(--{0})}} "
        ".mark.{0},.ellipse.{0}{{fill:var(--{0})}}\n",
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
  body_ += fmt::format("<figure>\n{}<figcaption>{}</figcaption>\n</figure>\n", chart.svg(), escaped(caption));
}

void Page::add_charts(const std::vector<Chart>& charts, const std::string& caption) {
  body_ += "<figure>\n<div class=\"multiples\">\n";
  for (const Chart& chart : charts) body_ += chart.svg();
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
  text += body_;
  text += fmt::format("<footer>groma {}</footer>\n</main>\n</body>\n</html>\n", io::program_version());
  return text;
}

}  // namespace groma::report
