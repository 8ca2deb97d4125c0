// Ten million updates for each model.
#include "test/host/filter/endurance.hpp"

namespace groma::filter {
namespace {

TEST(Endurance, ConsideredStaysPositive) {
  EXPECT_GT(testing::endure(Model::kSchmidt, 10'000'000, 1e-4, 91), -1e-12);
}

TEST(Endurance, EstimatedStaysPositive) {
  EXPECT_GT(testing::endure(Model::kJoint, 10'000'000, 1e-4, 92), -1e-12);
}

}  // namespace
}  // namespace groma::filter
