// A site of emulated nodes that run the shipped image, on real pseudo-terminals.
#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <vector>

#include "firmware/sim/world/built_in_scenarios.hpp"
#include "host/simulation/demo.hpp"
#include "host/simulation/lock_step.hpp"
#include "test/host/simulation/small_site.hpp"
#include "test/support/shipped_image.hpp"

namespace groma::simulation {
namespace {

constexpr double kRun_s = 2.0;

class EmulatedSite : public ::testing::Test {
 protected:
  void SetUp() override {
    GROMA_NEEDS_SHIPPED_IMAGE();
    image_ =
        std::make_shared<const sim::FirmwareImage>(sim::read_firmware_image(test::shipped_image(".hex")));
  }
  [[nodiscard]] SiteOptions emulated(std::uint64_t seed, double quantum_us = 40.0) const {
    SiteOptions options;
    options.seed = seed;
    options.image = image_;
    options.emulator.quantum = sim::from_seconds(quantum_us * 1e-6);
    return options;
  }

 private:
  std::shared_ptr<const sim::FirmwareImage> image_;
};

// The bytes of each tag's serial port.
std::vector<std::vector<std::uint8_t>> bytes_of(const sim::Scenario& scenario, const SiteOptions& options) {
  SimulatedSite site(scenario, options);
  std::vector<std::vector<std::uint8_t>> bytes(site.port_count());
  site.run_until(kRun_s);
  for (std::size_t i = 0; i < bytes.size(); ++i) site.take(i, bytes[i]);
  return bytes;
}

class Counter : public daemon::MeasurementSink {
 public:
  void on_odometry(const model::OdometrySample& /*row*/) override {}
  void on_range(const model::RangeSample& range) override { ranges_late += range.t_s > kRun_s - 1.0; }
  void on_pose_prior(const model::PoseSample& /*pose*/) override {}
  void on_clock_set() override {}

  int ranges_late = 0;  // in the last second
};

TEST_F(EmulatedSite, FifteenImagesRangeWithoutLosses) {
  LockStep run(sim::paper_hall(), emulated(1));
  Counter counter;
  run.session().attach(counter);
  run.run_until(kRun_s);
  run.session().flush();
  EXPECT_GE(counter.ranges_late, 300);
  EXPECT_EQ(run.session().frames_lost(), 0U);
}

TEST_F(EmulatedSite, ASeedGivesTheSameBytesOnEachPortWhateverTheQuantum) {
  const auto once = bytes_of(sim::paper_hall(), emulated(7));
  ASSERT_EQ(once.size(), 3U);
  for (const auto& bytes : once) EXPECT_GT(bytes.size(), 10'000U);
  EXPECT_EQ(bytes_of(sim::paper_hall(), emulated(7)), once);
  EXPECT_EQ(bytes_of(sim::paper_hall(), emulated(7, 15.0)), once);
  EXPECT_NE(bytes_of(sim::paper_hall(), emulated(8)), once);
}

TEST_F(EmulatedSite, CalibratesAndLocalizesAsANativeOneDoes) {
  const auto mean_ate_m = [](const SiteOptions& site) {
    DemoOptions options;
    options.site = site;
    const DemoResult result = run_demo(small_site(), options);
    EXPECT_EQ(result.frames_lost, 0U);
    for (const double error_m : result.anchor_errors_m) EXPECT_LT(error_m, 0.6);
    for (const ModelRun& run : result.models) {
      if (run.model == filter::Model::kSchmidt) return run.evaluation.ate_m.mean;
    }
    return std::nan("");
  };
  SiteOptions native;
  native.seed = 3;
  EXPECT_NEAR(mean_ate_m(emulated(3)), mean_ate_m(native), 0.02);
}

}  // namespace
}  // namespace groma::simulation
