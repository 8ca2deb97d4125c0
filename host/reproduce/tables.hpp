// Tables of the source paper beside the same rows here.
#pragma once

#include <span>
#include <string>
#include <string_view>
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
// A figure of a row over the seeds, such as of "ate_m" the "mean"; empty without the row.
[[nodiscard]] std::vector<double> values_of(const Seeds& seeds, const TableRow& row, Who who,
                                            std::string_view figure, std::string_view statistic);

}  // namespace groma::reproduce
