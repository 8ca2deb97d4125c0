// A strict parser of Prometheus' text exposition format, version 0.0.4, written from its specification.
#pragma once

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>

namespace groma::daemon::test {

using Labels = std::map<std::string, std::string>;

struct MetricFamily {
  std::string type;
  std::string help;
  std::map<std::string, std::map<Labels, double>> samples;  // by the sample's name
};

class PrometheusParser {
 public:
  // Throws std::runtime_error with the line.
  static std::map<std::string, MetricFamily> parse(const std::string& text) {
    if (text.empty() || text.back() != '\n') throw std::runtime_error("no line feed at the end");
    PrometheusParser parser;
    std::istringstream lines(text);
    for (std::string line; std::getline(lines, line);) {
      parser.rest_ = line;
      try {
        parser.take_line();
      } catch (const std::runtime_error& error) {
        throw std::runtime_error(error.what() + (": " + line));
      }
    }
    for (const auto& [name, family] : parser.families_) check(name, family);
    return parser.families_;
  }

 private:
  static void require(bool good, const char* what) {
    if (!good) throw std::runtime_error(what);
  }
  void expect(std::string_view text) {
    require(rest_.starts_with(text), "unexpected character");
    rest_.remove_prefix(text.size());
  }

  std::string name(bool colon) {
    std::size_t n = 0;
    const auto letter = [&](char c) {
      return std::isalpha(static_cast<unsigned char>(c)) != 0 || c == '_' || (colon && c == ':');
    };
    while (n < rest_.size() &&
           (letter(rest_[n]) || (n > 0 && std::isdigit(static_cast<unsigned char>(rest_[n])) != 0)))
      ++n;
    require(n > 0, "no name");
    std::string text(rest_.substr(0, n));
    rest_.remove_prefix(n);
    return text;
  }

  void take_line() {
    if (rest_.starts_with("# HELP ")) {
      expect("# HELP ");
      current_ = name(true);
      expect(" ");
      require(!families_.contains(current_), "a family that is not in one place");
      families_[current_].help = rest_;
    } else if (rest_.starts_with("# TYPE ")) {
      expect("# TYPE ");
      require(name(true) == current_, "TYPE of another family than HELP");
      expect(" ");
      MetricFamily& family = families_[current_];
      require(family.type.empty() && family.samples.empty(), "TYPE is not before the samples");
      family.type = rest_;
      require(std::set<std::string>{"counter", "gauge", "histogram"}.contains(family.type), "unknown type");
    } else {
      take_sample();
    }
  }

  void take_sample() {
    const std::string of = name(true);
    MetricFamily& family = families_[current_];
    require(!family.type.empty(), "a sample without TYPE");
    const std::string suffix = of.starts_with(current_) ? of.substr(current_.size()) : "?";
    const bool part = suffix == "_bucket" || suffix == "_sum" || suffix == "_count";
    require(family.type == "histogram" ? part : suffix.empty(), "a sample of another family");
    Labels labels;
    if (rest_.starts_with("{")) {
      do {
        rest_.remove_prefix(1);
        const std::string label = name(false);
        expect("=\"");
        require(labels.emplace(label, quoted()).second, "a label twice");
      } while (rest_.starts_with(","));
      expect("}");
    }
    expect(" ");
    require(family.samples[of].emplace(labels, number()).second, "a sample twice");
  }

  std::string quoted() {
    std::string text;
    while (!rest_.starts_with("\"")) {
      require(!rest_.empty(), "an open quote");
      char c = rest_.front();
      rest_.remove_prefix(1);
      if (c == '\\') {
        require(!rest_.empty(), "an open quote");
        c = rest_.front() == 'n' ? '\n' : rest_.front();
        require(c == '\n' || c == '\\' || c == '"', "an unknown escape");
        rest_.remove_prefix(1);
      }
      text += c;
    }
    expect("\"");
    return text;
  }

  double number() {
    if (rest_ == "+Inf") return std::numeric_limits<double>::infinity();
    double value = 0.0;
    const auto [end, error] = std::from_chars(rest_.data(), rest_.data() + rest_.size(), value);
    require(error == std::errc() && end == rest_.data() + rest_.size(), "not a number");
    return value;
  }

  static void check(const std::string& name, const MetricFamily& family) {
    require(!family.help.empty() && !family.type.empty(), "a family without HELP or TYPE");
    if (family.type == "counter") {
      require(name.ends_with("_total"), "a counter's name does not end in _total");
      for (const auto& [of, samples] : family.samples)
        for (const auto& [labels, value] : samples) require(value >= 0.0, "a negative counter");
    }
    if (family.type == "histogram") check_histogram(name, family);
  }

  // Without other labels than le.
  static void check_histogram(const std::string& name, const MetricFamily& family) {
    std::map<double, double> up_to;
    for (const auto& [labels, value] : family.samples.at(name + "_bucket")) {
      require(labels.size() == 1, "labels of a bucket");
      const std::string& bound = labels.at("le");
      up_to[bound == "+Inf" ? std::numeric_limits<double>::infinity() : std::stod(bound)] = value;
    }
    require(std::isinf(up_to.rbegin()->first), "no bucket without a bound");
    double before = 0.0;
    for (const auto& [bound, value] : up_to) {
      require(value >= before, "buckets are not cumulative");
      before = value;
    }
    require(family.samples.at(name + "_count").at({}) == before, "the count is not that of all buckets");
    require(family.samples.at(name + "_sum").at({}) >= 0.0, "a negative sum");
  }

  std::string_view rest_;
  std::string current_;
  std::map<std::string, MetricFamily> families_;
};

}  // namespace groma::daemon::test
