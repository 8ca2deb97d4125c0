// Attacks and faults against a running gromad on this computer: what they cost poses, memory and descriptors,
// compared with the undisturbed, in a table. GROMA_ATTACK_S: seconds of each attack; GROMA_JUDGED_S: of those
// whose latency is judged; GROMA_QUICK: whether only some attacks run, and no latency is judged.
#include <fmt/format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "host/io/exit_code.hpp"
#include "test/host/daemon/attacks.hpp"

namespace groma::daemon {
namespace {

using test::Arena;
using test::Attack;
using test::Measured;

constexpr bool kQuick = GROMA_QUICK != 0;
constexpr double kJudged_s = GROMA_JUDGED_S;
constexpr double kAttack_s = GROMA_ATTACK_S;
// By which an attack may delay one of 1,000 poses.
constexpr double kMostDelay_ms = 2.0;
// Of a row: samples whose poses had not come when it began or ended.
constexpr std::size_t kUnderWay = 2;

void print_row(const std::string& name, const Measured& row, std::optional<double> recovery_s) {
  fmt::print(
      "| {} | {:.2f} | {:.2f} | {:.2f} | {:.1f} | {:.0f} | {:.0f} % | {:.3f} | {} | {:.0f} % | {:.1f} | {} | "
      "{} |\n",
      name, row.latency_ms(0.5), row.latency_ms(0.99), row.latency_ms(0.999), row.latency_ms(1.0),
      static_cast<double>(row.poses) / row.seconds,
      100.0 * static_cast<double>(row.tracking) / static_cast<double>(std::max<std::size_t>(row.poses, 1)),
      row.worst_m, row.wrong, 100.0 * row.cpu_s / row.seconds, row.resident_mib, row.descriptors,
      recovery_s ? fmt::format("{:.1f}", *recovery_s) : "never");
  std::fflush(stdout);
}

class AttackCampaign : public ::testing::Test {
 protected:
  void SetUp() override {
    fmt::print(
        "odometry at 200 Hz; latency from the sending of a sample to its pose at a client; wrong: TRACKING "
        "poses beyond 5 sigmas; {} priority\n\n"
        "| attack | p50 ms | p99 | p99.9 | max | poses/s | TRACKING | largest error m | wrong | processor | "
        "memory MiB | descriptors | TRACKING again after s |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
        arena_.is_real_time() ? "real-time" : "normal");
    ASSERT_TRUE(arena_.recover()) << arena_.gromad().log();
    undisturbed_ = arena_.measure([this] {
      arena_.pump(kJudged_s);
      arena_.note_resources();
    });
    print_row("undisturbed", undisturbed_, 0.0);
    lost_ = frames_lost();
  }

  // keeps_frames: the tag's link is not attacked, and loses no frame.
  void run(const std::vector<Attack>& attacks, bool keeps_frames = true) {
    for (const Attack& attack : attacks) {
      if (kQuick && !attack.quick) continue;
      SCOPED_TRACE(attack.name);
      const Measured row =
          arena_.measure([&] { attack.act(arena_, attack.judged ? kJudged_s : kAttack_s); }, attack.harmless);
      const std::optional<double> recovery_s = arena_.recover();
      print_row(attack.name, row, recovery_s);
      EXPECT_EQ(row.problem, "");
      EXPECT_TRUE(recovery_s);
      ASSERT_TRUE(arena_.gromad().running()) << arena_.gromad().log();
      judge(attack, row, keeps_frames);
    }
  }

  // Of a STATUS from now on.
  std::uint64_t frames_lost() {
    return kQuick ? 0 : arena_.measure([this] { arena_.pump(1.1); }).frames_lost;
  }

  void judge(const Attack& attack, const Measured& row, bool keeps_frames) {
    const std::uint64_t lost_before = std::exchange(lost_, frames_lost());
    if (keeps_frames) EXPECT_EQ(lost_, lost_before);
    if (attack.harmless) EXPECT_GE(row.poses + kUnderWay, row.sent);
    if (kQuick) return;
    EXPECT_EQ(row.wrong, 0U);
    EXPECT_LT(row.resident_mib, undisturbed_.resident_mib + kMostGrowth_mib);
    if (attack.judged) judged_.emplace_back(attack.name, row.latency_ms(0.999));
  }

  // 64 clients with 256 KiB each, and twice as much where memory is returned late.
  static constexpr double kMostGrowth_mib = 32.0;
  Arena arena_{!kQuick};
  Measured undisturbed_;
  std::vector<std::pair<std::string, double>> judged_;  // each attack's p99.9, ms
  std::uint64_t lost_ = 0;                              // frames
};

TEST_F(AttackCampaign, NoAttackBreaksGromad) {
  run(test::attacks_on_the_pose_stream());
  run(test::attacks_on_the_web_server());
  run(test::attacks_on_the_robots_side());
  run(test::attacks_on_the_tags_link(), /*keeps_frames=*/false);
  run(test::attacks_on_the_process(), /*keeps_frames=*/false);
  const Measured after = arena_.measure([this] {
    arena_.pump(kJudged_s);
    arena_.note_resources();
  });
  print_row("undisturbed, at the end", after, 0.0);
  EXPECT_EQ(after.descriptors + 1, undisturbed_.descriptors) << "all are back, and the recording has ended";
  // The computer itself delays now more, now less.
  const double undisturbed_ms = std::max(undisturbed_.latency_ms(0.999), after.latency_ms(0.999));
  for (const auto& [attack, latency_ms] : judged_)
    EXPECT_LE(latency_ms, undisturbed_ms + kMostDelay_ms) << attack;
  arena_.gromad().terminate();
  EXPECT_EQ(arena_.gromad().exit_code(), io::kGood) << arena_.gromad().log();
}

}  // namespace
}  // namespace groma::daemon
