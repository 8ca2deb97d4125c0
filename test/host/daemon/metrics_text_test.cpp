#include "host/daemon/metrics_text.hpp"

#include <gtest/gtest.h>

#include <stdexcept>
#include <string>

#include "test/host/daemon/prometheus_parser.hpp"

namespace groma::daemon {
namespace {

using test::PrometheusParser;

TEST(MetricsText, IsReadByAPrometheusParser) {
  MetricsText text;
  text.family("a_total", "counter", "Of any kind.");
  text.add(std::uint64_t{18'446'744'073'709'551'615U},
           MetricsText::label("link", "C:\\a \"b\"\n") + "," + MetricsText::label("reason", "late"));
  text.family("b_seconds", "gauge", "A number.");
  text.add(1.5e-7);
  text.family("c", "gauge", "Without samples.");
  const auto families = PrometheusParser::parse(text.text());
  EXPECT_EQ(families.at("a_total").samples.at("a_total").begin()->first.at("link"), "C:\\a \"b\"\n");
  EXPECT_EQ(families.at("a_total").samples.at("a_total").begin()->second, 18'446'744'073'709'551'615.0);
  EXPECT_EQ(families.at("b_seconds").samples.at("b_seconds").at({}), 1.5e-7);
  EXPECT_TRUE(families.at("c").samples.empty());
}

TEST(MetricsText, HistogramsAreCumulative) {
  LatencyHistogram histogram;
  for (const double duration_s : {0.0, 20e-6, 21e-6, 0.004, 0.5, 7.0}) histogram.observe(duration_s);
  EXPECT_EQ(histogram.count(), 6U);
  EXPECT_EQ(histogram.quantile_s(0.5), 50e-6);
  EXPECT_EQ(histogram.quantile_s(0.8), 1.0);
  EXPECT_FALSE(histogram.quantile_s(0.99)) << "longer than all bounds";
  EXPECT_FALSE(LatencyHistogram().quantile_s(0.5));
  MetricsText text;
  text.histogram("latency_seconds", "Latency.", histogram);
  const auto family = PrometheusParser::parse(text.text()).at("latency_seconds");
  const auto& buckets = family.samples.at("latency_seconds_bucket");
  EXPECT_EQ(buckets.size(), LatencyHistogram::kBounds_s.size() + 1);
  EXPECT_EQ(buckets.at({{"le", "2e-05"}}), 2.0);
  EXPECT_EQ(buckets.at({{"le", "5e-05"}}), 3.0);
  EXPECT_EQ(buckets.at({{"le", "0.005"}}), 4.0);
  EXPECT_EQ(buckets.at({{"le", "1"}}), 5.0);
  EXPECT_EQ(buckets.at({{"le", "+Inf"}}), 6.0);
  EXPECT_NEAR(family.samples.at("latency_seconds_sum").at({}), 7.504041, 1e-9);
}

// The parser itself finds faults.
TEST(MetricsText, TheParserIsStrict) {
  const std::string head = "# HELP a_total A.\n# TYPE a_total counter\n";
  EXPECT_NO_THROW(PrometheusParser::parse(head + "a_total{x=\"1\"} 2\na_total 3\n"));
  for (const std::string wrong :
       {"a_total 1", "a_total 1\na_total 2\n", "b_total 1\n", "a_total -1\n", "a_total{x=\"1} 2\n",
        "a_total{x=1} 2\n", "a_total  1\n", "a_total one\n", "a_total{} 1\n", "\n",
        "# TYPE a_total counter\n", "# HELP a_total B.\n# TYPE a_total counter\n"}) {
    EXPECT_THROW(PrometheusParser::parse(head + wrong), std::runtime_error) << wrong;
  }
  EXPECT_THROW(PrometheusParser::parse("# HELP a A.\n# TYPE a counter\na 1\n"), std::runtime_error);
}

}  // namespace
}  // namespace groma::daemon
