#include "host/filter/ordered_filter.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <limits>
#include <memory>
#include <random>
#include <utility>
#include <variant>
#include <vector>

#include "test/host/filter/small_site.hpp"
#include "test/support/allocations.hpp"

namespace groma::filter {
namespace {

using test::Random;
using Input = std::variant<model::OdometrySample, model::RangeSample>;

constexpr double kWindow_s = 0.5;

double time_of(const Input& input) {
  return std::visit([](const auto& of) { return of.t_s; }, input);
}

// All inputs by time; odometry before ranges with equal times.
std::vector<Input> in_order(const testing::Drive& drive) {
  std::vector<Input> inputs(drive.odometry.begin(), drive.odometry.end());
  inputs.insert(inputs.end(), drive.ranges.begin(), drive.ranges.end());
  std::stable_sort(inputs.begin(), inputs.end(),
                   [](const Input& a, const Input& b) { return time_of(a) < time_of(b); });
  return inputs;
}

// Each input delayed by 0 to most_s.
std::vector<Input> shuffled(const std::vector<Input>& inputs, double most_s, std::uint64_t seed) {
  std::mt19937_64 random(seed);
  std::vector<std::pair<double, Input>> arrivals;
  arrivals.reserve(inputs.size());
  for (const Input& input : inputs) {
    const double delay_s = most_s * static_cast<double>(random() >> 11) * 0x1p-53;
    arrivals.emplace_back(time_of(input) + delay_s, input);
  }
  std::stable_sort(arrivals.begin(), arrivals.end(),
                   [](const auto& a, const auto& b) { return a.first < b.first; });
  std::vector<Input> out;
  out.reserve(arrivals.size());
  for (auto& [arrival_s, input] : arrivals) out.push_back(std::move(input));
  return out;
}

template <class Into>
void feed(const std::vector<Input>& inputs, Into& into) {
  for (const Input& input : inputs) std::visit([&into](const auto& of) { into.process(of); }, input);
}

template <class Filter>
std::unique_ptr<Filter> make(Model model) {
  return std::make_unique<Filter>(testing::hills(0.2), testing::three_tags(), testing::six_anchors(),
                                  testing::config_of(model));
}

testing::Drive some_drive(double duration_s = 6.0) {
  Random random(5);
  return testing::drive(testing::hills(0.2), testing::six_anchors(), {},
                        {.duration_s = duration_s, .range_s = 1.0 / 300.0}, random);
}

void expect_same(const Filter& a, const Filter& b) {
  EXPECT_EQ(a.estimate().t_s, b.estimate().t_s);
  EXPECT_EQ(a.core(), b.core());
  EXPECT_EQ(a.covariance().core(), b.covariance().core());
  EXPECT_EQ(a.covariance().cross(), b.covariance().cross());
  EXPECT_EQ(testing::whole(a), testing::whole(b));
  EXPECT_EQ(a.parameters().values(), b.parameters().values());
}

class OrderedModels : public ::testing::TestWithParam<Model> {};
INSTANTIATE_TEST_SUITE_P(OrderedFilter, OrderedModels, ::testing::ValuesIn(kModels),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           std::string name(model_name(model.param));
                           std::replace(name.begin(), name.end(), '-', '_');
                           return name;
                         });

// The reference processes all inputs in order of time.
TEST_P(OrderedModels, ShuffledWithinTheWindowEqualsInOrder) {
  const testing::Drive drive = some_drive();
  const std::vector<Input> inputs = in_order(drive);
  const auto reference = make<Filter>(GetParam());
  reference->start({});
  feed(inputs, *reference);
  for (const double most_s : {0.02, kWindow_s}) {
    const auto filter = make<OrderedFilter>(GetParam());
    ASSERT_TRUE(filter->start({}));
    feed(shuffled(inputs, most_s, 3), *filter);
    EXPECT_GT(filter->reordered(), inputs.size() * 2 / 5) << most_s;
    expect_same(filter->filter(), *reference);
    EXPECT_EQ(filter->counters().ranges[RangeOutcome::kUsed],
              reference->counters().ranges[RangeOutcome::kUsed]);
    EXPECT_EQ(filter->counters().ranges[RangeOutcome::kGated],
              reference->counters().ranges[RangeOutcome::kGated]);
    EXPECT_EQ(filter->counters().odometry[OdometryOutcome::kUsed],
              reference->counters().odometry[OdometryOutcome::kUsed]);
    EXPECT_EQ(filter->counters().ranges[RangeOutcome::kOutOfOrder], 0U);
    EXPECT_EQ(filter->counters().odometry[OdometryOutcome::kOutOfOrder], 0U);
  }
}

TEST(OrderedFilter, InputsOlderThanTheWindowAreRefusedAndChangeNothing) {
  const std::vector<Input> inputs = in_order(some_drive());
  const auto filter = make<OrderedFilter>(Model::kSchmidt);
  ASSERT_TRUE(filter->start({}));
  feed(inputs, *filter);
  const auto before = std::make_unique<Filter::Snapshot>(filter->filter().snapshot());
  const double newest_s = filter->estimate().t_s;
  const model::RangeSample late{
      .t_s = newest_s - 1.01 * kWindow_s, .tag_id = 1, .anchor_id = 11, .range_m = 9.0};
  EXPECT_EQ(filter->process(late).outcome, RangeOutcome::kOutOfOrder);
  EXPECT_EQ(filter->process(model::OdometrySample{newest_s - 2.0, 1.0, 0.0, 0.0}),
            OdometryOutcome::kOutOfOrder);
  EXPECT_FALSE(filter->start({.t_s = newest_s - 2.0}));
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kOutOfOrder], 1U);
  EXPECT_EQ(filter->counters().odometry[OdometryOutcome::kOutOfOrder], 1U);
  EXPECT_EQ(filter->filter().core(), before->core);
  EXPECT_EQ(filter->filter().covariance().core(), before->covariance.core());
  // An input just within the window is accepted.
  model::RangeSample timely = late;
  timely.t_s = newest_s - 0.99 * kWindow_s;
  EXPECT_NE(filter->process(timely).outcome, RangeOutcome::kOutOfOrder);
}

TEST(OrderedFilter, NonFiniteValuesAreRefused) {
  const auto filter = make<OrderedFilter>(Model::kSchmidt);
  EXPECT_FALSE(filter->start({.t_s = testing::kNan}));
  EXPECT_FALSE(filter->start({.pose = {testing::kNan, 0.0, 0.0}}));
  ASSERT_TRUE(filter->start({}));
  EXPECT_EQ(filter->process(model::OdometrySample{testing::kNan, 1.0, 0.0, 0.0}), OdometryOutcome::kBadValue);
  EXPECT_EQ(filter->process(model::OdometrySample{1.0, 1.0, testing::kNan, 0.0}), OdometryOutcome::kBadValue);
  EXPECT_EQ(filter->process({.t_s = 1.0, .tag_id = 1, .anchor_id = 11, .range_m = testing::kNan}).outcome,
            RangeOutcome::kBadValue);
  EXPECT_EQ(filter->process({.t_s = testing::kNan, .tag_id = 1, .anchor_id = 11, .range_m = 5.0}).outcome,
            RangeOutcome::kBadValue);
  EXPECT_EQ(filter->counters().odometry[OdometryOutcome::kBadValue], 2U);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kBadValue], 2U);
  EXPECT_EQ(filter->estimate().t_s, 0.0);
}

// The estimate for a late odometry sample equals the one for the same sample in time.
TEST(OrderedFilter, GivesTheEstimateAtALateOdometrySample) {
  const std::vector<Input> inputs = in_order(some_drive(3.0));
  const auto reference = make<OrderedFilter>(Model::kSchmidt);
  const auto filter = make<OrderedFilter>(Model::kSchmidt);
  ASSERT_TRUE(reference->start({}));
  ASSERT_TRUE(filter->start({}));
  std::vector<Estimate> in_time;
  std::vector<Input> held_back;
  for (const Input& input : inputs) {
    const auto* row = std::get_if<model::OdometrySample>(&input);
    const bool late = row != nullptr && row->t_s > 2.0 && row->t_s < 2.3;
    std::visit([&](const auto& of) { reference->process(of); }, input);
    if (late) {
      in_time.push_back(reference->sample_estimate());
      EXPECT_EQ(in_time.back().t_s, row->t_s);
      EXPECT_EQ(in_time.back().covariance, reference->estimate().covariance);
      held_back.push_back(input);
    } else if (time_of(input) < 2.3) {
      std::visit([&](const auto& of) { filter->process(of); }, input);
    }
  }
  ASSERT_GE(held_back.size(), 4U);
  for (std::size_t i = 0; i < held_back.size(); ++i) {
    const auto& row = std::get<model::OdometrySample>(held_back[i]);
    EXPECT_EQ(filter->process(row), OdometryOutcome::kUsed);
    const Estimate then = filter->sample_estimate();
    EXPECT_EQ(then.t_s, row.t_s);
    EXPECT_EQ(then.pose.x_m, in_time[i].pose.x_m);
    EXPECT_EQ(then.pose.y_m, in_time[i].pose.y_m);
    EXPECT_EQ(then.covariance, in_time[i].covariance);
    EXPECT_GT(filter->estimate().t_s, row.t_s);
  }
}

// Inputs with equal times in random order.
TEST(OrderedFilter, InputsWithEqualTimesGiveTheSameResultInAnyOrder) {
  std::vector<Input> inputs{model::OdometrySample{1.0, 1.0, 0.0, 0.1}};
  for (const model::NodeId anchor : std::to_array<model::NodeId>({11, 12, 13, 14})) {
    for (const model::NodeId tag : std::to_array<model::NodeId>({1, 2, 3}))
      inputs.emplace_back(
          model::RangeSample{.t_s = 1.0, .tag_id = tag, .anchor_id = anchor, .range_m = 17.0});
  }
  const auto reference = make<OrderedFilter>(Model::kJoint);
  ASSERT_TRUE(reference->start({}));
  feed(inputs, *reference);
  std::mt19937_64 random(9);
  for (int i = 0; i < 20; ++i) {
    std::shuffle(inputs.begin(), inputs.end(), random);
    const auto filter = make<OrderedFilter>(Model::kJoint);
    ASSERT_TRUE(filter->start({}));
    feed(inputs, *filter);
    expect_same(filter->filter(), reference->filter());
  }
}

TEST(OrderedFilter, ALateStartAppliesFromItsTime) {
  const std::vector<Input> inputs = in_order(some_drive(1.0));
  const Start start{.t_s = 0.8};
  const auto reference = make<Filter>(Model::kSchmidt);
  for (const Input& input : inputs) {
    if (time_of(input) >= start.t_s && !reference->started()) reference->start(start);
    std::visit([&](const auto& of) { reference->process(of); }, input);
  }
  const auto filter = make<OrderedFilter>(Model::kSchmidt);
  feed(inputs, *filter);
  EXPECT_FALSE(filter->started());
  ASSERT_TRUE(filter->start(start));
  EXPECT_TRUE(filter->started());
  expect_same(filter->filter(), *reference);
}

// More inputs within the window than the buffer holds only shorten the window.
TEST(OrderedFilter, AFloodOfInputsShortensTheWindow) {
  const auto filter = make<OrderedFilter>(Model::kSchmidt);
  const auto reference = make<Filter>(Model::kSchmidt);
  ASSERT_TRUE(filter->start({}));
  reference->start({});
  std::vector<Input> inputs;
  constexpr int kFlood = 3 * static_cast<int>(OrderedFilter::kMaxInputs) / 2;
  inputs.reserve(kFlood);
  for (int i = 0; i < kFlood; ++i) {
    inputs.emplace_back(model::RangeSample{.t_s = 0.1 + 1e-5 * i,
                                           .tag_id = 1,
                                           .anchor_id = static_cast<model::NodeId>(11 + i % 6),
                                           .range_m = 17.0});
  }
  for (std::size_t i = 0; i + 1 < inputs.size(); i += 16) std::swap(inputs[i], inputs[i + 1]);
  feed(inputs, *filter);
  for (std::size_t i = 0; i + 1 < inputs.size(); i += 16) std::swap(inputs[i], inputs[i + 1]);
  feed(inputs, *reference);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kOutOfOrder], 0U);
  expect_same(filter->filter(), *reference);
  EXPECT_EQ(filter->process({.t_s = 0.1, .tag_id = 1, .anchor_id = 11, .range_m = 17.0}).outcome,
            RangeOutcome::kOutOfOrder);
}

TEST(OrderedFilter, NeverAllocatesAfterConstruction) {
  const std::vector<Input> inputs = shuffled(in_order(some_drive(4.0)), kWindow_s, 4);
  for (const Model model : {Model::kSchmidt, Model::kJoint}) {
    const auto filter = make<OrderedFilter>(model);
    const std::size_t before = test::allocations();
    filter->start({});
    feed(inputs, *filter);
    EXPECT_EQ(test::allocations(), before);
    EXPECT_GT(filter->reordered(), 500U);
  }
}

}  // namespace
}  // namespace groma::filter
