// Tables of the source paper beside the same rows here.
#pragma once

#include <span>
#include <string>
#include <vector>

#include "host/reproduce/paper.hpp"
#include "host/reproduce/runner.hpp"

namespace groma::reproduce {

struct TableRow {
  std::string group;  // of the result's rows; empty: the result has no groups
  std::string key;
  std::string label;
  const PaperRow* paper = nullptr;  // null: the paper has no such row
};

struct TableSpec {
  std::string experiment;
  std::string title;
  std::string remark;  // what is comparable, and what is not
  std::vector<TableRow> rows;
};

// What a table of poses has for each row.
struct Column {
  const char* title;
  const char* figure;
  const char* statistic;
  double PaperStatistic::*of_paper;
  PaperStatistic PaperRow::*row;
  const char* format;
};
[[nodiscard]] std::span<const Column> columns();
// kNotGiven where the paper has none.
[[nodiscard]] double paper_value(const TableRow& row, const Column& column);

// "indoor", "table2" and "table3".
[[nodiscard]] const std::vector<TableSpec>& tables();

enum class Who { kPublished, kOurs };
// Where a result has the row's run by the filter.
[[nodiscard]] Json::json_pointer run_of(const TableRow& row, Who who);

}  // namespace groma::reproduce
