#include "firmware/core/dw1000/driver.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <tuple>

#include "test/firmware/fake_chip.hpp"

namespace groma::dw1000 {
namespace {

using radio::line_of_sight;
using radio::LineOfSight;
using radio::LinkQuality;
using radio::power_cdbm;
using ranging::DeviceTime;
using ranging::Ticks;
using testing::FakeChip;
using testing::Transfer;

// ---- the table --------------------------------------------------------------------------------------------

struct Place {
  std::uint8_t file;
  std::uint16_t sub;
  std::size_t bytes;
};

template <class R>
constexpr bool lies_at(Place place) {
  return R::kId == place.file && R::kSub == place.sub && R::kLength == place.bytes;
}

// As in the register map of the DW1000 User Manual.
static_assert(lies_at<reg::DevId>({0x00, 0, 4}));
static_assert(lies_at<reg::SysCfg>({0x04, 0, 4}));
static_assert(lies_at<reg::SysTime>({0x06, 0, 5}));
static_assert(lies_at<reg::TxFctrl>({0x08, 0, 5}));
static_assert(lies_at<reg::DxTime>({0x0A, 0, 5}));
static_assert(lies_at<reg::RxFwto>({0x0C, 0, 2}));
static_assert(lies_at<reg::SysCtrl>({0x0D, 0, 4}));
static_assert(lies_at<reg::SysMask>({0x0E, 0, 4}));
static_assert(lies_at<reg::SysStatus>({0x0F, 0, 5}));
static_assert(lies_at<reg::RxFinfo>({0x10, 0, 4}));
static_assert(lies_at<reg::RxFqual>({0x12, 0, 8}));
static_assert(lies_at<reg::RxTime>({0x15, 0, 14}));
static_assert(lies_at<reg::TxTime>({0x17, 0, 5}));
static_assert(lies_at<reg::TxAntd>({0x18, 0, 2}));
static_assert(lies_at<reg::TxPower>({0x1E, 0, 4}));
static_assert(lies_at<reg::ChanCtrl>({0x1F, 0, 4}));
static_assert(lies_at<reg::AgcTune1>({0x23, 0x04, 2}));
static_assert(lies_at<reg::AgcTune2>({0x23, 0x0C, 4}));
static_assert(lies_at<reg::AgcTune3>({0x23, 0x12, 2}));
static_assert(lies_at<reg::DrxTune0b>({0x27, 0x02, 2}));
static_assert(lies_at<reg::DrxTune1a>({0x27, 0x04, 2}));
static_assert(lies_at<reg::DrxTune1b>({0x27, 0x06, 2}));
static_assert(lies_at<reg::DrxTune2>({0x27, 0x08, 4}));
static_assert(lies_at<reg::DrxSfdtoc>({0x27, 0x20, 2}));
static_assert(lies_at<reg::DrxPretoc>({0x27, 0x24, 2}));
static_assert(lies_at<reg::DrxTune4h>({0x27, 0x26, 2}));
static_assert(lies_at<reg::DrxCarInt>({0x27, 0x28, 3}));
static_assert(lies_at<reg::RxpaccNosat>({0x27, 0x2C, 2}));
static_assert(lies_at<reg::RfRxctrlh>({0x28, 0x0B, 1}));
static_assert(lies_at<reg::RfTxctrl>({0x28, 0x0C, 4}));
static_assert(lies_at<reg::RfBias>({0x28, 0x11, 1}));
static_assert(lies_at<reg::RfSensors>({0x28, 0x12, 1}));
static_assert(lies_at<reg::TcSarc>({0x2A, 0x00, 1}));
static_assert(lies_at<reg::TcSarSupply>({0x2A, 0x03, 1}));
static_assert(lies_at<reg::TcSarTemperature>({0x2A, 0x04, 1}));
static_assert(lies_at<reg::TcPgdelay>({0x2A, 0x0B, 1}));
static_assert(lies_at<reg::FsPllcfg>({0x2B, 0x07, 4}));
static_assert(lies_at<reg::FsPlltune>({0x2B, 0x0B, 1}));
static_assert(lies_at<reg::FsXtalt>({0x2B, 0x0E, 1}));
static_assert(lies_at<reg::AonWcfg>({0x2C, 0x00, 2}));
static_assert(lies_at<reg::AonCtrl>({0x2C, 0x02, 1}));
static_assert(lies_at<reg::AonCfg0>({0x2C, 0x06, 1}));
static_assert(lies_at<reg::OtpAddr>({0x2D, 0x04, 2}));
static_assert(lies_at<reg::OtpCtrl>({0x2D, 0x06, 2}));
static_assert(lies_at<reg::OtpRdat>({0x2D, 0x0A, 4}));
static_assert(lies_at<reg::OtpSf>({0x2D, 0x12, 1}));
static_assert(lies_at<reg::LdeCfg1>({0x2E, 0x0806, 1}));
static_assert(lies_at<reg::LdePpindx>({0x2E, 0x1000, 2}));
static_assert(lies_at<reg::LdeRxantd>({0x2E, 0x1804, 2}));
static_assert(lies_at<reg::LdeCfg2>({0x2E, 0x1806, 2}));
static_assert(lies_at<reg::LdeRepc>({0x2E, 0x2804, 2}));
static_assert(lies_at<reg::PmscReset>({0x36, 0x03, 1}));

// Fields are read and set at compile time, and only in their own register.
static_assert(
    Value<reg::SysCtrl>().set(reg::sys_ctrl::kTransmit).set(reg::sys_ctrl::kDelayedTransmit).word() == 0x06);
static_assert(Value<reg::SysStatus>(0x4'0000'0000).has(reg::sys_status::kPowerUpError));
static_assert(Value<reg::SysStatus>(0x0800'0000).has(reg::sys_status::kHalfPeriod));
static_assert(Value<reg::RxFinfo>(0x0760'007F).get(reg::rx_finfo::kPreambleCount) == 0x076);
static_assert(Value<reg::DrxCarInt>(0x1F'FFFF).get_signed(reg::drx_car_int::kIntegral) == -1);
static_assert(Value<reg::DrxCarInt>(0x0F'FFFF).get_signed(reg::drx_car_int::kIntegral) == 0x0F'FFFF);

TEST(Register, FieldsComeBackAsSetAndLeaveTheOthersAlone) {
  Value<reg::RxTime> value;
  value.set(reg::rx_time::kTimestamp, 0xAB'CDEF'0123);
  value.set(reg::rx_time::kFirstPath, 0xBEEF);
  value.set(reg::rx_time::kAmplitude1, 0x1234);
  EXPECT_EQ(value.get(reg::rx_time::kTimestamp), 0xAB'CDEF'0123U);
  EXPECT_EQ(value.get(reg::rx_time::kFirstPath), 0xBEEFU);
  EXPECT_EQ(value.get(reg::rx_time::kAmplitude1), 0x1234U);
  EXPECT_EQ(value.bytes()[0], 0x23);
  EXPECT_EQ(value.bytes()[4], 0xAB);
  EXPECT_EQ(value.bytes()[5], 0xEF);
  EXPECT_EQ(value.bytes()[7], 0x34);
  value.set(reg::rx_time::kFirstPath, 0);
  EXPECT_EQ(value.get(reg::rx_time::kTimestamp), 0xAB'CDEF'0123U);
  EXPECT_EQ(value.get(reg::rx_time::kAmplitude1), 0x1234U);
  // More bits than the field has do not spill.
  Value<reg::TxFctrl> format;
  format.set(reg::tx_fctrl::kLength, 0xFFFF);
  EXPECT_EQ(format.word(), 0x3FFU);
}

TEST(TransactionHeader, HasOneTwoOrThreeBytes) {
  const auto bytes = [](bool write, std::uint8_t id, std::uint16_t sub) {
    const TransactionHeader header(write, id, sub);
    return std::vector<std::uint8_t>(header.bytes().begin(), header.bytes().end());
  };
  EXPECT_EQ(bytes(false, 0x0F, 0), (std::vector<std::uint8_t>{0x0F}));
  EXPECT_EQ(bytes(true, 0x0D, 0), (std::vector<std::uint8_t>{0x8D}));
  EXPECT_EQ(bytes(false, 0x27, 0x2C), (std::vector<std::uint8_t>{0x67, 0x2C}));
  EXPECT_EQ(bytes(true, 0x2E, 0x0806), (std::vector<std::uint8_t>{0xEE, 0x86, 0x10}));
  EXPECT_EQ(bytes(true, 0x2E, 0x2804), (std::vector<std::uint8_t>{0xEE, 0x84, 0x50}));
}

// ---- the driver -------------------------------------------------------------------------------------------

// As a caller uses it that is in no hurry.
struct PlainDriver : Dw1000<FakeChip> {
  using Dw1000::Dw1000;
  Start transmit_at(DeviceTime timestamp, std::span<const std::uint8_t> frame) {
    const Start loaded = load(timestamp, frame, [] {});
    return loaded == Start::kStarted ? launch() : loaded;
  }
  Event take_event() {
    Event event = poll_event();
    if (event.kind == EventKind::kReceived) {
      read_frame(event, [](std::span<const std::uint8_t>) { return true; });
    }
    return event;
  }
};

class Driver : public ::testing::Test {
 protected:
  BringUp bring_up(const Settings& settings = {}) {
    return radio.bring_up(
        settings,
        [this] {
          ++resets;
          chip.reset();
        },
        [this](std::uint32_t us) {
          waited_us += us;
          chip.wait(us);
          waits.push_back({us, chip.writes().empty() ? Transfer{} : chip.writes().back()});
        });
  }
  void ready() {
    ASSERT_EQ(bring_up(), BringUp::kOk);
    chip.log.clear();
  }
  void expect_writes(const std::vector<std::tuple<int, int, std::uint64_t>>& expected) {
    const auto writes = chip.writes();
    ASSERT_EQ(writes.size(), expected.size());
    for (std::size_t i = 0; i < writes.size(); ++i) {
      EXPECT_EQ(int{writes[i].file}, std::get<0>(expected[i])) << i;
      EXPECT_EQ(int{writes[i].sub}, std::get<1>(expected[i])) << i;
      EXPECT_EQ(writes[i].word(), std::get<2>(expected[i])) << i;
    }
  }

  struct Wait {
    std::uint32_t us;
    Transfer after;
  };
  FakeChip chip;
  PlainDriver radio{chip};
  int resets = 0;
  std::uint32_t waited_us = 0;
  std::vector<Wait> waits;
};

struct PreambleFacts {
  Preamble preamble;
  std::uint64_t format;
  std::uint64_t tune2;
  std::uint64_t tune1b;
  std::uint64_t tune4h;
  std::uint64_t sfd_timeout;
};

TEST_F(Driver, BringUpWritesTheReferenceValues) {
  for (const PreambleFacts& facts :
       {PreambleFacts{Preamble::k64, 0x0006C000, 0x313B006B, 0x0010, 0x0010, 65},
        PreambleFacts{Preamble::k128, 0x0016C000, 0x313B006B, 0x0020, 0x0028, 129},
        PreambleFacts{Preamble::k256, 0x0026C000, 0x333B00BE, 0x0020, 0x0028, 249}}) {
    chip.log.clear();
    ASSERT_EQ(bring_up({.preamble = facts.preamble}), BringUp::kOk);
    EXPECT_EQ(chip.written(0x27, 0x08), facts.tune2);
    EXPECT_EQ(chip.written(0x27, 0x06), facts.tune1b);
    EXPECT_EQ(chip.written(0x27, 0x26), facts.tune4h);
    EXPECT_EQ(chip.written(0x27, 0x20), facts.sfd_timeout);
    EXPECT_EQ(chip.written(0x1F, 0), 0x4A480055U);
    EXPECT_EQ(chip.written(0x23, 0x04), 0x889BU);
    EXPECT_EQ(chip.written(0x23, 0x0C), 0x2502A907U);
    EXPECT_EQ(chip.written(0x23, 0x12), 0x0035U);
    EXPECT_EQ(chip.written(0x27, 0x02), 0x0001U);
    EXPECT_EQ(chip.written(0x27, 0x04), 0x008DU);
    EXPECT_EQ(chip.written(0x28, 0x0B), 0xD8U);
    EXPECT_EQ(chip.written(0x28, 0x0C), 0x001E3FE3U);
    EXPECT_EQ(chip.written(0x2A, 0x0B), 0xB5U);
    EXPECT_EQ(chip.written(0x2B, 0x07), 0x0800041DU);
    EXPECT_EQ(chip.written(0x2B, 0x0B), 0xBEU);
    EXPECT_EQ(chip.written(0x2E, 0x0806), 0x6DU);
    EXPECT_EQ(chip.written(0x2E, 0x1806), 0x0607U);
    EXPECT_EQ(chip.written(0x2E, 0x2804), 0x28F4U);
    EXPECT_EQ(chip.written(0x1E, 0), 0x85858585U);
    // Interrupt high, single buffer, constant power, frame wait time-out.
    EXPECT_EQ(chip.written(0x04, 0), (1U << 9) | (1U << 12) | (1U << 18) | (1U << 28));
    const std::uint8_t frame[] = {1, 2, 3};
    ASSERT_EQ(radio.transmit_at(DeviceTime(1 << 20), frame), Start::kStarted);
    EXPECT_EQ(chip.written(0x08, 0), facts.format + 5);
  }
  EXPECT_FALSE(chip.headers_bad);
}

TEST_F(Driver, BringUpLoadsTheLeadingEdgeMicrocode) {
  ASSERT_EQ(bring_up(), BringUp::kOk);
  const auto writes = chip.writes();
  const auto load = std::find_if(writes.begin(), writes.end(), [](const Transfer& t) {
    return t.file == 0x2D && t.sub == 0x06 && t.word() == 0x8000;
  });
  ASSERT_NE(load, writes.end());
  EXPECT_EQ((load - 1)->file, 0x36);
  EXPECT_EQ((load - 1)->word(), 0x0301U);
  EXPECT_EQ((load + 1)->file, 0x36);
  EXPECT_EQ((load + 1)->word(), 0x0200U);
  // The bus is idle for at least 150 us.
  ASSERT_FALSE(waits.empty());
  EXPECT_EQ(waits.front().after.file, 0x2D);
  EXPECT_EQ(waits.front().after.word(), 0x8000U);
  EXPECT_GE(waits.front().us, 150U);
}

TEST_F(Driver, TheBusIsSlowUntilThePllHasLocked) {
  ASSERT_EQ(bring_up(), BringUp::kOk);
  EXPECT_EQ(resets, 1);
  bool fast = false;
  for (const Transfer& t : chip.log) {
    if (t.speed == SpiSpeed::kFast) fast = true;
    EXPECT_EQ(t.speed, fast ? SpiSpeed::kFast : SpiSpeed::kSlow);
    EXPECT_FALSE(fast && t.write);
  }
  EXPECT_TRUE(fast);
}

TEST_F(Driver, WakesAChipThatSleeps) {
  for (const int wake_ups : {1, 3}) {
    resets = 0;
    chip.fall_asleep(wake_ups);
    EXPECT_EQ(bring_up(), BringUp::kOk);
    EXPECT_TRUE(radio.woken());
    EXPECT_EQ(resets, 1 + wake_ups);
  }
  EXPECT_EQ(bring_up(), BringUp::kOk);
  EXPECT_FALSE(radio.woken());
  chip.fall_asleep(100);
  EXPECT_EQ(bring_up(), BringUp::kNoChip);
}

TEST_F(Driver, OtpGivesLdoTuneCrystalTrimAndAntennaDelay) {
  chip.otp[0x04] = 0x1234'5688;
  chip.otp[0x1E] = 0xFFFF'FF0B;
  chip.otp[0x1C] = 0x4041'0000;
  ASSERT_EQ(bring_up(), BringUp::kOk);
  EXPECT_EQ(chip.written(0x2D, 0x12), 0x02U);
  EXPECT_EQ(chip.written(0x2B, 0x0E), 0x60U | 0x0BU);
  EXPECT_EQ(chip.written(0x18, 0), 0x4041U);
  EXPECT_EQ(chip.written(0x2E, 0x1804), 0x4041U);
  EXPECT_EQ(radio.transmit_antenna_delay().count(), 0x4041);
}

TEST_F(Driver, AnEmptyOtpLeavesTheDefaults) {
  chip.otp[0x04] = 0xFFFF'FF00;
  ASSERT_EQ(bring_up(), BringUp::kOk);
  EXPECT_EQ(chip.written(0x2D, 0x12), ~std::uint64_t{0});
  EXPECT_EQ(chip.written(0x2B, 0x0E), 0x70U);
  EXPECT_EQ(chip.written(0x18, 0), 16436U);
  EXPECT_EQ(chip.written(0x2E, 0x1804), 16436U);
}

TEST_F(Driver, ImplausibleAntennaDelaysAreReplaced) {
  using Delay = std::optional<std::uint16_t>;
  struct Case {
    std::uint32_t otp;
    Delay configured;
    std::uint64_t used;
    bool warns;
  };
  for (const Case& c :
       {Case{0x404C'404C, {}, 0x404C, false}, Case{0x8098'8098, {}, 16436, true},
        Case{0x3A97'0000, {}, 16436, true}, Case{0x3A98'0000, {}, 15'000, false},
        Case{0x4650'0000, {}, 18'000, false}, Case{0x4651'0000, {}, 16436, true},
        Case{0x8098'8098, Delay(16'500), 16'500, false}, Case{0x404C'404C, Delay(14'000), 16436, true}}) {
    chip.otp[0x1C] = c.otp;
    ASSERT_EQ(
        bring_up({.transmit_antenna_delay_dtu = c.configured, .receive_antenna_delay_dtu = c.configured}),
        BringUp::kOk);
    EXPECT_EQ(chip.written(0x18, 0), c.used);
    EXPECT_EQ(chip.written(0x2E, 0x1804), c.used);
    EXPECT_EQ(radio.transmit_antenna_delay().count(), static_cast<std::int64_t>(c.used));
    EXPECT_EQ(radio.warning()[0] != '\0', c.warns);
    EXPECT_LT(std::string_view(radio.warning()).size(), 48U);
  }
}

TEST_F(Driver, ConfiguredAntennaDelaysAndPowerWin) {
  chip.otp[0x1C] = 0x4041'0000;
  ASSERT_EQ(bring_up({.transmit_power = 0x1F1F1F1F,
                      .transmit_antenna_delay_dtu = std::uint16_t{16000},
                      .receive_antenna_delay_dtu = std::uint16_t{17000}}),
            BringUp::kOk);
  EXPECT_EQ(chip.written(0x18, 0), 16000U);
  EXPECT_EQ(chip.written(0x2E, 0x1804), 17000U);
  EXPECT_EQ(chip.written(0x1E, 0), 0x1F1F1F1FU);
}

TEST_F(Driver, BringUpReportsWhatFailed) {
  chip.absent = true;
  EXPECT_EQ(bring_up(), BringUp::kNoChip);
  EXPECT_LT(waited_us, 50'000U);
  waited_us = 0;
  chip.absent = false;
  chip.locks = false;
  EXPECT_EQ(bring_up(), BringUp::kNoLock);
  EXPECT_LT(waited_us, 20'000U);
  chip.locks = true;
  chip.slow_only = true;
  EXPECT_EQ(bring_up(), BringUp::kNoFastBus);
  chip.slow_only = false;
  chip.deaf = true;
  EXPECT_EQ(bring_up(), BringUp::kNotWritable);
  EXPECT_EQ(radio.state(), State::kDown);
  const std::uint8_t frame[] = {1};
  EXPECT_EQ(radio.transmit_at(DeviceTime(0), frame), Start::kNotIdle);
  EXPECT_EQ(radio.receive_now(Ticks(1'000'000), std::nullopt), Start::kNotIdle);
  chip.deaf = false;
  chip.on_write = [this](const Transfer& transfer) {
    if (transfer.file == 0x2B && transfer.sub == 0x0E) chip.put(0x2B, 0x0E, 0x60, 1);
  };
  EXPECT_EQ(bring_up(), BringUp::kNoTrim);
  for (const std::uint16_t setting : {std::uint16_t{0x0806}, std::uint16_t{0x2804}}) {
    chip.on_write = [this, setting](const Transfer& transfer) {
      if (transfer.file == 0x2E && transfer.sub == setting) chip.put(0x2E, setting, 0, 1);
    };
    EXPECT_EQ(bring_up(), BringUp::kNoTimestamps);
  }
  chip.on_write = [this](const Transfer&) { chip.put(0x36, 0x04, 0x81000738, 4); };
  EXPECT_EQ(bring_up(), BringUp::kNoTimestamps);
  chip.on_write = nullptr;
  EXPECT_EQ(bring_up(), BringUp::kOk);
  EXPECT_EQ(radio.state(), State::kIdle);
  for (const BringUp result : {BringUp::kNoChip, BringUp::kNoLock, BringUp::kNoFastBus, BringUp::kNotWritable,
                               BringUp::kNoTrim, BringUp::kNoTimestamps}) {
    EXPECT_GT(std::string_view(describe(result)).size(), 10U);
    EXPECT_LT(std::string_view(describe(result)).size(), 32U);
  }
}

TEST_F(Driver, EachRegisterWrittenAtBringUpIsReadBack) {
  ASSERT_EQ(bring_up(), BringUp::kOk);
  std::vector<Transfer> settings;
  for (const Transfer& t : chip.writes()) {
    // Commands, and what each operation sets again.
    const bool setting =
        t.file != 0x0F && t.file != 0x2D && t.file != 0x36 && !(t.file == 0x27 && t.sub == 0x24);
    if (setting) settings.push_back(t);
  }
  EXPECT_EQ(settings.size(), 25U);
  for (const Transfer& lost : settings) {
    chip.on_write = [&](const Transfer& t) {
      if (t.file == lost.file && t.sub == lost.sub) chip.put(t.file, t.sub, t.word() ^ 1, t.bytes.size());
    };
    EXPECT_NE(bring_up(), BringUp::kOk) << int{lost.file} << ' ' << lost.sub;
    EXPECT_EQ(radio.state(), State::kDown);
  }
}

TEST_F(Driver, SamplesTemperatureAndSupplyByTheirCalibration) {
  chip.otp[0x08] = 0x1234'56A9;  // 3.3 V
  chip.otp[0x09] = 0x1234'567D;  // 23 degrees C
  ready();
  radio.start_sampling();
  // In this order: the bias, the converter's bias, the outputs, the converter itself.
  expect_writes(
      {{0x28, 0x11, 0x80}, {0x28, 0x12, 0x0A}, {0x28, 0x12, 0x0F}, {0x2A, 0x00, 0}, {0x2A, 0x00, 1}});
  chip.put(0x2A, 0x03, 0xA9 - 52, 1);
  chip.put(0x2A, 0x04, 0x7D + 10, 1);
  chip.log.clear();
  const auto ambient = radio.finish_sampling();
  expect_writes({{0x2A, 0x00, 0}});
  ASSERT_TRUE(ambient);
  EXPECT_NEAR(ambient->supply_mv, 1000.0 * (3.3 - 52.0 / 173.0), 1.0);
  EXPECT_NEAR(ambient->temperature_cdegc, 100.0 * (23.0 + 11.4), 0.5);
}

// Without a calibration the typical readings are assumed.
TEST_F(Driver, SamplesWithoutACalibrationToo) {
  chip.otp[0x08] = 0;
  chip.otp[0x09] = 0xFFFF'FFFF;
  ready();
  radio.start_sampling();
  chip.put(0x2A, 0x03, 175, 1);
  chip.put(0x2A, 0x04, 120, 1);
  const auto ambient = radio.finish_sampling();
  ASSERT_TRUE(ambient);
  EXPECT_EQ(ambient->supply_mv, 3'300);
  EXPECT_EQ(ambient->temperature_cdegc, 2'300);
}

TEST_F(Driver, SamplingDisturbsNoReceptionAndNeedsAChip) {
  radio.start_sampling();
  EXPECT_TRUE(chip.log.empty());
  EXPECT_FALSE(radio.finish_sampling());
  ready();
  ASSERT_EQ(radio.receive_now(Ticks(1'000'000), std::nullopt), Start::kStarted);
  radio.start_sampling();
  EXPECT_TRUE(radio.finish_sampling());
  EXPECT_EQ(radio.state(), State::kReceiving);
}

TEST(LineOfSight, DependsOnThePowerOutsideTheFirstPath) {
  EXPECT_EQ(line_of_sight(std::nullopt, -8'000, 0), LineOfSight::kUnknown);
  EXPECT_EQ(line_of_sight(-8'000, std::nullopt, 0), LineOfSight::kUnknown);
  EXPECT_EQ(line_of_sight(-8'000, -8'000, 0), LineOfSight::kLikely);
  EXPECT_EQ(line_of_sight(-8'599, -8'000, 0), LineOfSight::kLikely);
  EXPECT_EQ(line_of_sight(-8'600, -8'000, 0), LineOfSight::kUncertain);
  EXPECT_EQ(line_of_sight(-9'000, -8'000, 0), LineOfSight::kUncertain);
  EXPECT_EQ(line_of_sight(-9'001, -8'000, 0), LineOfSight::kUnlikely);
}

TEST(LineOfSight, DependsOnTheDistanceOfTheStrongestPathFromTheFirst) {
  EXPECT_EQ(line_of_sight(-8'200, -8'000, 211), LineOfSight::kLikely);
  EXPECT_EQ(line_of_sight(-8'200, -8'000, 212), LineOfSight::kUncertain);
  EXPECT_EQ(line_of_sight(-8'200, -8'000, 384), LineOfSight::kUncertain);
  EXPECT_EQ(line_of_sight(-8'200, -8'000, 385), LineOfSight::kUnlikely);
  EXPECT_EQ(line_of_sight(-8'800, -8'000, 385), LineOfSight::kUnlikely);
  EXPECT_EQ(line_of_sight(-8'800, -8'000, 100), LineOfSight::kUncertain);
}

TEST_F(Driver, TransmitsAtATimestamp) {
  ready();
  const std::uint8_t frame[] = {0x41, 0x88, 0x01, 0xAA};
  const DeviceTime timestamp(0x12'3456'7800 + 16436);
  ASSERT_EQ(radio.transmit_at(timestamp, frame), Start::kStarted);
  expect_writes({{0x0A, 0, 0x12'3456'7800},
                 {0x08, 0, 0x0016C006},
                 {0x09, 0, 0xAA018841},
                 {0x36, 0, 0x20},
                 {0x0D, 0, 0x06}});
  EXPECT_EQ(radio.state(), State::kTransmitting);
  EXPECT_EQ(radio.take_event().kind, EventKind::kNone);

  chip.log.clear();
  chip.status |= 1U << 7;
  chip.put(0x17, 0, timestamp.count(), 5);
  EXPECT_TRUE(chip.interrupt());
  const Event event = radio.take_event();
  EXPECT_EQ(event.kind, EventKind::kTransmitted);
  EXPECT_EQ(event.timestamp, timestamp);
  EXPECT_FALSE(chip.interrupt());
  EXPECT_EQ(chip.written(0x36, 0), 0x00U);
  EXPECT_EQ(radio.state(), State::kIdle);
}

TEST_F(Driver, CompletesAFrameBeforeWritingIt) {
  ready();
  std::array<std::uint8_t, 4> frame = {0x41, 0x88, 0x01, 0x00};
  chip.log.clear();
  std::size_t transfers_before = 0;
  ASSERT_EQ(radio.load(DeviceTime(1 << 20), frame,
                       [&] {
                         transfers_before = chip.log.size();
                         frame.back() = 0xAA;
                       }),
            Start::kStarted);
  EXPECT_EQ(transfers_before, 2U);
  EXPECT_EQ(chip.written(0x09, 0), 0xAA018841U);
}

TEST_F(Driver, SendsALoadedFrameOnlyWhenLaunched) {
  ready();
  EXPECT_EQ(radio.launch(), Start::kNotIdle);
  const std::array<std::uint8_t, 4> frame = {0x41, 0x88, 0x01, 0xAA};
  chip.log.clear();
  ASSERT_EQ(radio.load(DeviceTime(1 << 20), frame, [] {}), Start::kStarted);
  EXPECT_EQ(radio.state(), State::kLoaded);
  expect_writes({{0x0A, 0, ((1 << 20) - 16'436)}, {0x08, 0, 0x0016C006}, {0x09, 0, 0xAA018841}});
  // The length register is the loaded frame's, and no other operation takes its place.
  radio.expect_length(10);
  EXPECT_EQ(chip.written(0x08, 0), 0x0016C006U);
  EXPECT_EQ(radio.receive_now(Ticks(1 << 16), std::nullopt), Start::kNotIdle);
  ASSERT_EQ(radio.launch(), Start::kStarted);
  EXPECT_EQ(chip.written(0x0D, 0), 0x06U);
  EXPECT_EQ(radio.state(), State::kTransmitting);
  radio.stop();
  ASSERT_EQ(radio.load(DeviceTime(1 << 20), frame, [] {}), Start::kStarted);
  radio.stop();
  EXPECT_EQ(radio.launch(), Start::kNotIdle);
}

TEST_F(Driver, WritesTheNextFramesLengthInAdvance) {
  ready();
  radio.expect_length(4);
  EXPECT_EQ(chip.written(0x08, 0), 0x0016C006U);
  // Also while listening; an unchanged length is not written again.
  ASSERT_EQ(radio.receive_now(Ticks(1 << 16), std::nullopt), Start::kStarted);
  radio.expect_length(10);
  EXPECT_EQ(chip.written(0x08, 0), 0x0016C00CU);
  chip.log.clear();
  radio.expect_length(10);
  EXPECT_TRUE(chip.log.empty());
  radio.stop();
  const std::uint8_t frame[] = {1, 2, 3, 4};
  ASSERT_EQ(radio.transmit_at(DeviceTime(1 << 20), frame), Start::kStarted);
  EXPECT_EQ(chip.written(0x08, 0), 0x0016C006U);
  // Not while a frame of another length is being transmitted.
  chip.log.clear();
  radio.expect_length(10);
  EXPECT_TRUE(chip.log.empty());
}

TEST_F(Driver, TheTransmitTimeWrapsWithTheCounter) {
  ready();
  const std::uint8_t frame[] = {1};
  ASSERT_EQ(radio.transmit_at(DeviceTime(52), frame), Start::kStarted);
  EXPECT_EQ(chip.written(0x0A, 0), (std::uint64_t{1} << 40) + 52 - 16436);
}

TEST_F(Driver, ALateTransmitIsCancelled) {
  for (const int bit : {27, 34}) {
    ready();
    chip.on_write = [&](const Transfer& t) {
      if (t.file == 0x0D && t.word() == 0x06) chip.status |= std::uint64_t{1} << bit;
    };
    const std::uint8_t frame[] = {1};
    EXPECT_EQ(radio.transmit_at(DeviceTime(1 << 20), frame), bit == 27 ? Start::kLate : Start::kTooClose);
    EXPECT_EQ(chip.written(0x0D, 0), 0x40U);
    EXPECT_EQ(chip.written(0x36, 0), 0x00U);
    EXPECT_EQ(radio.state(), State::kIdle);
    EXPECT_FALSE(chip.interrupt());
    chip.on_write = nullptr;
    EXPECT_EQ(radio.transmit_at(DeviceTime(1 << 20), frame), Start::kStarted);
    radio.stop();
  }
}

TEST_F(Driver, ReceivesFromAGivenTimeForAGivenDuration) {
  ready();
  ASSERT_EQ(radio.receive_at(DeviceTime(0x55'0000'1234), Ticks(19'660'801), Ticks(2'080'763)),
            Start::kStarted);
  expect_writes({{0x0C, 0, 301}, {0x27, 0x24, 4}, {0x0A, 0, 0x55'0000'1234}, {0x0D, 0, 0x300}});
  radio.stop();
  chip.log.clear();
  // The preamble time-out is written only where it changes.
  ASSERT_EQ(radio.receive_at(DeviceTime(0), Ticks(65'536), Ticks(2'080'768)), Start::kStarted);
  expect_writes({{0x0C, 0, 1}, {0x0A, 0, 0}, {0x0D, 0, 0x300}});
  radio.stop();
  chip.log.clear();
  ASSERT_EQ(radio.receive_now(Ticks(0x1'0000'0000'0000), std::nullopt), Start::kStarted);
  expect_writes({{0x0C, 0, 0xFFFF}, {0x27, 0x24, 0}, {0x0D, 0, 0x100}});
}

TEST_F(Driver, ALateReceiveIsCancelled) {
  ready();
  chip.on_write = [&](const Transfer& t) {
    if (t.file == 0x0D && t.word() == 0x300) chip.status |= std::uint64_t{1} << 27;
  };
  EXPECT_EQ(radio.receive_at(DeviceTime(0), Ticks(65'536), std::nullopt), Start::kLate);
  EXPECT_EQ(radio.state(), State::kIdle);
  EXPECT_FALSE(chip.interrupt());
}

void put_frame(FakeChip& chip, std::span<const std::uint8_t> frame, std::uint64_t timestamp) {
  chip.put(0x10, 0, (frame.size() + 2) | 118ULL << 20, 4);
  chip.put(0x11, frame);
  chip.put(0x15, 0, timestamp, 5);
  chip.put(0x15, 5, 0xB9C0, 2);
  chip.put(0x15, 7, 11'000, 2);
  chip.put(0x2E, 0x1000, 748, 2);
  chip.put(0x12, 0, 40, 2);
  chip.put(0x12, 2, 12'000, 2);
  chip.put(0x12, 4, 9'000, 2);
  chip.put(0x12, 6, 5'000, 2);
  chip.put(0x27, 0x28, 0x1F'FFF0, 3);
  chip.put(0x27, 0x2C, 118, 2);
  chip.status |= 1U << 14 | 1U << 10 | 1U << 13;
}

TEST_F(Driver, ReadsAFrameWithItsTimestampAndQuality) {
  ready();
  ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
  const std::vector<std::uint8_t> frame{9, 8, 7, 6, 5};
  put_frame(chip, frame, 0xFE'DCBA'9876);
  const Event event = radio.take_event();
  EXPECT_EQ(event.kind, EventKind::kReceived);
  EXPECT_EQ(event.timestamp, DeviceTime(0xFE'DCBA'9876));
  EXPECT_TRUE(event.timestamp_valid);
  EXPECT_EQ(std::vector<std::uint8_t>(event.frame.begin(), event.frame.end()), frame);
  const LinkQuality expected = link_quality({.amplitude1 = 11'000,
                                             .amplitude2 = 12'000,
                                             .amplitude3 = 9'000,
                                             .channel_power = 5'000,
                                             .noise = 40,
                                             .first_path_index_64ths = 0xB9C0,
                                             .peak_index = 748,
                                             .preamble_count = 113,
                                             .carrier_integral = -16});
  EXPECT_EQ(event.quality.receive_power, expected.receive_power);
  EXPECT_EQ(event.quality.first_path_power, expected.first_path_power);
  EXPECT_EQ(event.quality.clock_offset_ppb, expected.clock_offset_ppb);
  EXPECT_EQ(event.quality.peak_distance_64ths, expected.peak_distance_64ths);
  EXPECT_EQ(event.quality.noise, 40);
  EXPECT_EQ(radio.take_event().kind, EventKind::kNone);
}

TEST_F(Driver, WaitsForTheLeadingEdgeAndMarksATimestampWithoutOne) {
  ready();
  ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
  put_frame(chip, std::vector<std::uint8_t>{1}, 5);
  chip.status &= ~std::uint64_t{1U << 10};
  EXPECT_FALSE(radio.take_event().timestamp_valid);
  ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
  put_frame(chip, std::vector<std::uint8_t>{1}, 5);
  chip.status |= 1U << 18;
  EXPECT_FALSE(radio.take_event().timestamp_valid);
}

TEST_F(Driver, ImpossibleLengthsAreHarmless) {
  for (const std::uint64_t length : {0U, 1U, 2U, 127U, 128U, 1023U}) {
    ready();
    ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
    put_frame(chip, std::vector<std::uint8_t>{1}, 5);
    chip.put(0x10, 0, length, 4);
    const Event event = radio.take_event();
    EXPECT_EQ(event.kind, EventKind::kReceived);
    EXPECT_EQ(event.frame.size(), length < 2 ? 0 : std::min<std::uint64_t>(length - 2, kMaxFrameBytes));
  }
}

TEST_F(Driver, AfterAFailedReceptionTheReceiverIsReset) {
  const std::vector<std::pair<int, EventKind>> failures{
      {12, EventKind::kHeaderError},  {16, EventKind::kHeaderError},     {15, EventKind::kCheckError},
      {17, EventKind::kFrameTimeout}, {21, EventKind::kPreambleTimeout}, {26, EventKind::kSfdTimeout}};
  for (const auto& [bit, kind] : failures) {
    ready();
    ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
    chip.log.clear();
    chip.status |= std::uint64_t{1} << bit;
    EXPECT_TRUE(chip.interrupt()) << bit;
    EXPECT_EQ(radio.take_event().kind, kind) << bit;
    EXPECT_FALSE(chip.interrupt());
    const auto writes = chip.writes();
    ASSERT_GE(writes.size(), 3U);
    const Transfer& idle = writes[writes.size() - 3];
    const Transfer& on = writes[writes.size() - 2];
    const Transfer& off = writes.back();
    EXPECT_EQ(std::tuple(idle.file, idle.sub, idle.word()), std::tuple(0x0D, 0x00, 0x40U));
    EXPECT_EQ(std::tuple(on.file, on.sub, on.word()), std::tuple(0x36, 0x03, 0xE0U));
    EXPECT_EQ(std::tuple(off.file, off.sub, off.word()), std::tuple(0x36, 0x03, 0xF0U));
    EXPECT_EQ(radio.state(), State::kIdle);
  }
}

TEST_F(Driver, AnOperationUnderWayIsNotDisturbed) {
  ready();
  const std::uint8_t frame[] = {1};
  ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
  chip.log.clear();
  EXPECT_EQ(radio.transmit_at(DeviceTime(1 << 20), frame), Start::kNotIdle);
  EXPECT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kNotIdle);
  EXPECT_EQ(radio.receive_at(DeviceTime(0), Ticks(65'536), std::nullopt), Start::kNotIdle);
  EXPECT_TRUE(chip.log.empty());
  radio.stop();
  const std::vector<std::uint8_t> too_long(126, 0);
  EXPECT_EQ(radio.transmit_at(DeviceTime(1 << 20), too_long), Start::kTooLong);
  const std::vector<std::uint8_t> longest(125, 0);
  EXPECT_EQ(radio.transmit_at(DeviceTime(1 << 20), longest), Start::kStarted);
}

// Erratum SYSSTAT-1.
TEST_F(Driver, PllFlagsAreCountedAndChangeNothing) {
  std::uint32_t count = 0;
  for (const int bit : {24, 25}) {
    ready();
    ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
    chip.status |= std::uint64_t{1} << bit;
    EXPECT_FALSE(chip.interrupt());
    // The end of an operation leaves the flag for the count.
    radio.stop();
    EXPECT_EQ(radio.pll_flags(), count);
    ASSERT_EQ(radio.receive_now(Ticks(65'536), std::nullopt), Start::kStarted);
    put_frame(chip, std::vector<std::uint8_t>{1}, 5);
    EXPECT_EQ(radio.take_event().kind, EventKind::kReceived);
    EXPECT_EQ(radio.pll_flags(), ++count);
    EXPECT_EQ(radio.take_event().kind, EventKind::kNone);
    EXPECT_EQ(radio.pll_flags(), count);
    EXPECT_EQ(radio.state(), State::kIdle);
  }
}

TEST_F(Driver, TheCounterDecidesWhetherThePllIsLocked) {
  chip.shows_lock = false;
  chip.on_write = [&](const Transfer& t) {
    if (t.file == 0x0F) chip.status |= 1U << 25;
  };
  EXPECT_EQ(bring_up(), BringUp::kOk);
  EXPECT_LT(waited_us, 10'000U);
  chip.on_write = nullptr;
  chip.shows_lock = true;
  chip.locks = false;
  EXPECT_EQ(bring_up(), BringUp::kNoLock);
}

TEST_F(Driver, ARestartChecksTheChipWithoutAReset) {
  const auto restart = [this] { return radio.restart([this](std::uint32_t us) { chip.wait(us); }); };
  EXPECT_FALSE(restart());
  ready();
  resets = 0;
  ASSERT_EQ(radio.receive_now(Ticks(65'536), Ticks(2'080'763)), Start::kStarted);
  EXPECT_TRUE(restart());
  EXPECT_EQ(resets, 0);
  EXPECT_EQ(radio.state(), State::kIdle);
  // The registers of each operation are written again.
  chip.log.clear();
  ASSERT_EQ(radio.receive_now(Ticks(65'536), Ticks(2'080'763)), Start::kStarted);
  expect_writes({{0x0C, 0, 1}, {0x27, 0x24, 4}, {0x0D, 0, 0x100}});
  chip.locks = false;
  EXPECT_FALSE(restart());
  EXPECT_EQ(radio.state(), State::kDown);
  chip.locks = true;
  ready();
  chip.put(0x2E, 0x2804, 0, 2);
  EXPECT_FALSE(restart());
  ready();
  chip.absent = true;
  EXPECT_FALSE(restart());
}

TEST_F(Driver, AStrayInterruptIsClearedAndIsNoEvent) {
  ready();
  chip.status |= 1U << 14;
  EXPECT_TRUE(chip.interrupt());
  EXPECT_EQ(radio.take_event().kind, EventKind::kNone);
  EXPECT_FALSE(chip.interrupt());
}

// ---- quality ----------------------------------------------------------------------------------------------

TEST(ReceiveQuality, PowersFollowTheManualsFormulas) {
  const ReceiveQuality q{.amplitude1 = 11'000,
                         .amplitude2 = 12'000,
                         .amplitude3 = 9'000,
                         .channel_power = 5'000,
                         .preamble_count = 113};
  const double first = 10.0 * std::log10((11e3 * 11e3 + 12e3 * 12e3 + 9e3 * 9e3) / (113.0 * 113.0)) - 121.74;
  const double total = 10.0 * std::log10(5000.0 * 131072.0 / (113.0 * 113.0)) - 121.74;
  const LinkQuality link = link_quality(q);
  EXPECT_NEAR(power_cdbm(link.first_path_power).value_or(0), first * 100.0, 0.6);
  EXPECT_NEAR(power_cdbm(link.receive_power).value_or(0), total * 100.0, 0.6);
  EXPECT_FALSE(power_cdbm(link_quality({.preamble_count = 5}).first_path_power));
  EXPECT_FALSE(power_cdbm(link_quality({.amplitude1 = 5, .channel_power = 5}).first_path_power));
  EXPECT_FALSE(power_cdbm(link_quality({.amplitude1 = 5, .channel_power = 5}).receive_power));
}

TEST(ReceiveQuality, TheStrongestPathMayComeBeforeTheFirst) {
  const auto distance_64ths = [](std::uint16_t peak_index) {
    return link_quality({.first_path_index_64ths = 64 * 746 + 16, .peak_index = peak_index})
        .peak_distance_64ths;
  };
  EXPECT_EQ(distance_64ths(749), 176);
  EXPECT_EQ(distance_64ths(745), 80);
  EXPECT_EQ(distance_64ths(0xFFFF), 0xFFFF);
}

TEST(ReceiveQuality, ThePreambleCountLoses5SymbolsUnlessSaturated) {
  EXPECT_EQ(corrected_preamble_count(118, 118), 113);
  EXPECT_EQ(corrected_preamble_count(118, 117), 118);
  EXPECT_EQ(corrected_preamble_count(5, 5), 5);
  EXPECT_EQ(corrected_preamble_count(0, 0), 0);
}

TEST(ReceiveQuality, TheClockOffsetHasTheCarriersSlope) {
  EXPECT_EQ(clock_offset_ppb(0), 0);
  EXPECT_NEAR(clock_offset_ppb(-34'897), 20'000, 1);
  EXPECT_NEAR(clock_offset_ppb(1'048'575), -600'960, 10);
  EXPECT_EQ(clock_offset_ppb(-1'048'576), 600'959);
}

}  // namespace
}  // namespace groma::dw1000
