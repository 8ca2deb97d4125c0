// Cuts the power at every flash operation of each scenario, with each kind of torn result and several seeds,
// in the manner of littlefs's tests.
#include <gtest/gtest.h>

#include <algorithm>
#include <functional>
#include <ostream>
#include <string>
#include <vector>

#include "firmware/core/storage/config_store.hpp"
#include "firmware/core/storage/counter.hpp"
#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/nor_flash.hpp"

namespace groma::storage {
namespace {

using sim::KeyedRandom;
using sim::NorFlash;
using Bytes = std::vector<std::uint8_t>;

static_assert(Flash<NorFlash>);

Bytes blob(std::size_t size, std::uint64_t seed) {
  Bytes bytes(size);
  for (std::size_t i = 0; i < size; ++i) {
    bytes[i] = static_cast<std::uint8_t>(KeyedRandom(seed).of(i).bits());
  }
  return bytes;
}

Bytes load(NorFlash& flash) {
  Bytes out(kMaxRecordBytes);
  out.resize(ConfigStore(flash).load(out));
  return out;
}

bool store(NorFlash& flash, const Bytes& bytes) {
  return ConfigStore(flash).store(bytes);
}

// Writes a page header and one record word by word in the layout of record_store.hpp.
void put_page(NorFlash& flash, std::size_t page, std::uint32_t sequence, std::uint32_t payload_word) {
  const auto start = static_cast<std::uint32_t>(page) * kPageBytes;
  ASSERT_TRUE(flash.erase(page));
  wire::Crc32 head;
  const std::uint32_t words[] = {0x4D4F5247, 1, sequence};
  for (std::uint32_t i = 0; i < 3; ++i) {
    head.add_word(words[i]);
    ASSERT_TRUE(flash.write(start + 4 * i, words[i]));
  }
  ASSERT_TRUE(flash.write(start + 12, head.value()));
  wire::Crc32 record;
  record.add_word(sequence);
  record.add_word(0x000401A5);
  record.add_word(payload_word);
  ASSERT_TRUE(flash.write(start + 16, 0x000401A5));
  ASSERT_TRUE(flash.write(start + 20, payload_word));
  ASSERT_TRUE(flash.write(start + 24, record.value()));
}

TEST(ConfigStore, ReturnsWhatWasStored) {
  NorFlash flash(kPages);
  EXPECT_TRUE(load(flash).empty());
  for (const std::size_t size : {1U, 2U, 3U, 4U, 5U, 255U, 256U, 1023U, 1024U, 7U}) {
    const Bytes bytes = blob(size, size);
    EXPECT_TRUE(store(flash, bytes)) << size;
    EXPECT_EQ(load(flash), bytes) << size;
  }
}

TEST(ConfigStore, ARecordThatIsTooLongIsRefusedAndNothingIsLost) {
  NorFlash flash(kPages);
  const Bytes bytes = blob(100, 1);
  ASSERT_TRUE(store(flash, bytes));
  EXPECT_FALSE(store(flash, blob(kMaxRecordBytes + 1, 2)));
  EXPECT_FALSE(store(flash, blob(5000, 2)));
  EXPECT_EQ(load(flash), bytes);
  std::array<std::uint8_t, 99> small{};
  EXPECT_EQ(ConfigStore(flash).load(small), 0U);
}

TEST(ConfigStore, AnEmptyBlobErases) {
  NorFlash flash(kPages);
  EXPECT_TRUE(store(flash, {}));
  EXPECT_EQ(flash.operations(), 0U) << "nothing was there to erase";
  ASSERT_TRUE(store(flash, blob(50, 1)));
  EXPECT_TRUE(store(flash, {}));
  EXPECT_TRUE(load(flash).empty());
  ASSERT_TRUE(store(flash, blob(60, 2)));
  EXPECT_EQ(load(flash), blob(60, 2));
}

TEST(ConfigStore, WritesNothingWhereNothingChanges) {
  NorFlash flash(kPages);
  ASSERT_TRUE(store(flash, blob(50, 1)));
  const std::uint64_t operations = flash.operations();
  EXPECT_TRUE(store(flash, blob(50, 1)));
  EXPECT_EQ(flash.operations(), operations);
}

TEST(ConfigStore, ErasesOncePerPageOfRecordsAndKeepsTheWriteLimits) {
  NorFlash flash(kPages);
  constexpr std::uint64_t kStores = 1'000;
  for (std::uint64_t i = 0; i < kStores; ++i) ASSERT_TRUE(store(flash, blob(200, i)));
  EXPECT_EQ(load(flash), blob(200, kStores - 1));
  // A page holds (4096 - 16) / 208 = 19 records.
  EXPECT_EQ(flash.erases(0), 27U);
  EXPECT_EQ(flash.erases(1), 26U);
  EXPECT_LE(flash.most_writes_in_a_block(), NorFlash::kBlockBytes / 4);
  EXPECT_LE(flash.most_writes_in_a_block(), NorFlash::kMaxWritesPerBlock);
}

TEST(ConfigStore, TheLayoutMatchesItsSpecification) {
  NorFlash flash(kPages);
  put_page(flash, 0, 7, 0x44332211);
  EXPECT_EQ(load(flash), (Bytes{0x11, 0x22, 0x33, 0x44}));
  put_page(flash, 1, 8, 0x88776655);
  EXPECT_EQ(load(flash), (Bytes{0x55, 0x66, 0x77, 0x88}));
  put_page(flash, 0, 9, 0xCCBBAA99);
  EXPECT_EQ(load(flash), (Bytes{0x99, 0xAA, 0xBB, 0xCC}));
  NorFlash written(kPages);
  ASSERT_TRUE(store(written, {0x11, 0x22, 0x33, 0x44}));
  NorFlash expected(kPages);
  put_page(expected, 0, 1, 0x44332211);
  for (std::uint32_t at = 0; at < kPages * kPageBytes; at += 4)
    EXPECT_EQ(written.read(at), expected.read(at)) << at;
}

TEST(ConfigStore, TheSequenceNumberMayWrap) {
  for (const std::uint32_t sequence : {0xFFFFFFFEU, 0xFFFFFFFFU, 0U, 0x7FFFFFFFU, 0x80000000U}) {
    NorFlash flash(kPages);
    put_page(flash, 0, sequence, 1);
    put_page(flash, 1, sequence + 1, 2);
    EXPECT_EQ(load(flash), (Bytes{2, 0, 0, 0})) << sequence;
    // Enough stores to fill four pages and to pass the wrap.
    for (std::uint64_t i = 0; i < 14; ++i) {
      ASSERT_TRUE(store(flash, blob(1000, i)));
      ASSERT_EQ(load(flash), blob(1000, i)) << sequence << ' ' << i;
    }
  }
}

TEST(ConfigStore, AnyFlippedBitOfTheNewestRecordReturnsThePreviousOne) {
  NorFlash flash(kPages);
  ASSERT_TRUE(store(flash, blob(12, 1)));
  const std::uint32_t from = 16 + 4 + 12 + 4;
  ASSERT_TRUE(store(flash, blob(12, 2)));
  for (std::uint32_t at = from; at < from + 20; at += 4) {
    for (unsigned bit = 0; bit < 32; ++bit) {
      NorFlash damaged = flash;
      const std::uint32_t without = flash.read(at) & ~(1U << bit);
      if (without == flash.read(at)) continue;
      ASSERT_TRUE(damaged.write(at, without));
      EXPECT_EQ(load(damaged), blob(12, 1)) << at << ' ' << bit;
      ASSERT_TRUE(store(damaged, blob(12, 3)));
      EXPECT_EQ(load(damaged), blob(12, 3)) << at << ' ' << bit;
    }
  }
}

TEST(ConfigStore, AnyFlippedBitOfAPageHeaderSelectsTheOtherPage) {
  NorFlash flash(kPages);
  put_page(flash, 0, 7, 1);
  put_page(flash, 1, 8, 2);
  for (std::uint32_t at = kPageBytes; at < kPageBytes + 16; at += 4) {
    for (unsigned bit = 0; bit < 32; ++bit) {
      NorFlash damaged = flash;
      if ((flash.read(at) >> bit & 1) == 0) continue;
      ASSERT_TRUE(damaged.write(at, ~(1U << bit)));
      EXPECT_EQ(load(damaged), (Bytes{1, 0, 0, 0})) << at << ' ' << bit;
    }
  }
}

// Flash of which some words no longer take writes, or the pages no longer erase.
class WornFlash {
 public:
  bool erase(std::size_t page) noexcept { return erases ? flash.erase(page) : lies; }
  bool write(std::uint32_t offset, std::uint32_t word) noexcept {
    if (std::find(worn.begin(), worn.end(), offset) != worn.end()) return lies;
    return flash.write(offset, word);
  }
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept { return flash.read(offset); }

  NorFlash flash{kPages};
  std::vector<std::uint32_t> worn;
  bool erases = true;
  bool lies = false;  // reports success all the same
};

TEST(ConfigStore, AWornWordIsDetectedAndTheOtherPageUsed) {
  for (const bool lies : {false, true}) {
    WornFlash worn;
    worn.lies = lies;
    ConfigStore config(worn);
    ASSERT_TRUE(config.store(blob(100, 1)));
    worn.worn = {16 + 108 + 40};
    EXPECT_TRUE(config.store(blob(100, 2)));
    EXPECT_EQ(load(worn.flash), blob(100, 2));
    EXPECT_EQ(worn.flash.erases(1), 1U);
    // Now both pages are worn.
    worn.worn.push_back(kPageBytes + 16 + 108 + 40);
    EXPECT_FALSE(config.store(blob(500, 3)));
    EXPECT_EQ(load(worn.flash), blob(100, 2));
  }
}

TEST(ConfigStore, APageThatIsNotErasedIsNotWritten) {
  for (const bool lies : {false, true}) {
    WornFlash worn;
    worn.lies = lies;
    ConfigStore config(worn);
    for (std::uint64_t i = 0; i < 20; ++i) ASSERT_TRUE(config.store(blob(300, i)));
    worn.erases = false;
    Bytes kept = blob(300, 19);
    std::size_t refused = 0;
    for (std::uint64_t i = 100; i < 130; ++i) {
      const bool stored = config.store(blob(300, i));
      if (stored) kept = blob(300, i);
      refused += stored ? 0 : 1;
      ASSERT_EQ(load(worn.flash), kept);
    }
    EXPECT_GT(refused, 15U);
    EXPECT_EQ(worn.flash.overwrites(), 0U);
  }
}

// ---- power cuts -----------------------------------------------------------------------------------------

// `before` prepares the flash; the power is cut while `next` is being stored.
struct Scenario {
  std::string name;
  std::function<void(NorFlash&)> before;
  Bytes next;

  friend std::ostream& operator<<(std::ostream& out, const Scenario& scenario) {
    return out << scenario.name;
  }
};

std::vector<Scenario> scenarios() {
  const auto stores = [](std::size_t count, std::size_t size) {
    return [=](NorFlash& flash) {
      for (std::size_t i = 0; i < count; ++i) ASSERT_TRUE(store(flash, blob(size, 100 + i)));
    };
  };
  const auto with_counter = [](std::size_t stores_before, std::size_t size) {
    return [=](NorFlash& flash) {
      for (std::size_t i = 0; i < stores_before; ++i) {
        ASSERT_TRUE(store(flash, blob(size, 200 + i)));
        ASSERT_TRUE(Counter(flash).next());
      }
    };
  };
  return {
      {"the first of all", stores(0, 0), blob(60, 1)},
      {"one more", stores(1, 60), blob(60, 1)},
      {"into a full page", stores(19, 200), blob(200, 1)},
      {"into a page that is exactly full", stores(15, 264), blob(200, 1)},
      {"back to the first page", stores(38, 200), blob(200, 1)},
      {"the longest", stores(3, 1024), blob(1024, 1)},
      {"the shortest", stores(1, 60), blob(1, 1)},
      {"factory reset", stores(2, 60), {}},
      {"factory reset of a full page", stores(19, 200), {}},
      {"after a factory reset",
       [](NorFlash& flash) {
         ASSERT_TRUE(store(flash, blob(60, 2)));
         ASSERT_TRUE(store(flash, {}));
       },
       blob(60, 1)},
      {"beside a counter", with_counter(2, 200), blob(200, 1)},
      {"beside a counter into a full page", with_counter(18, 200), blob(200, 1)},
      {"factory reset beside a counter of a full page", with_counter(18, 200), {}},
      {"over the sequence number's wrap",
       [](NorFlash& flash) {
         put_page(flash, 0, 0xFFFFFFFE, 1);
         put_page(flash, 1, 0xFFFFFFFF, 2);
         for (std::uint64_t i = 0; i < 3; ++i) ASSERT_TRUE(store(flash, blob(1000, 300 + i)));
       },
       blob(1000, 1)},
  };
}

// The counter's next value, read from a copy with its power on.
std::uint64_t counter_after(NorFlash flash) {
  flash.power_on();
  return Counter(flash).next().value_or(0);
}

// Cuts the power at each operation of `work` in each way, then restores it and calls check(flash, done,
// where).
void cut_everywhere(const NorFlash& start, const std::function<bool(NorFlash&)>& work,
                    const std::function<void(NorFlash&, bool, const std::string&)>& check) {
  NorFlash whole = start;
  ASSERT_TRUE(work(whole));
  const std::uint64_t operations = whole.operations() - start.operations();
  ASSERT_GT(operations, 0U);
  for (std::uint64_t operation = 0; operation < operations; ++operation) {
    for (const NorFlash::Tear tear : NorFlash::kTears) {
      for (std::uint64_t seed = 0; seed < 2; ++seed) {
        NorFlash flash = start;
        flash.cut_power_at(operation, tear, seed);
        const bool done = work(flash);
        EXPECT_FALSE(flash.powered());
        flash.power_on();
        check(flash, done,
              "operation " + std::to_string(operation) + " of " + std::to_string(operations) + ", tear " +
                  std::to_string(static_cast<int>(tear)) + ", seed " + std::to_string(seed));
        if (::testing::Test::HasFailure()) return;
      }
    }
  }
}

class PowerCut : public ::testing::TestWithParam<Scenario> {};

TEST_P(PowerCut, LeavesTheOldOrTheNewRecordAndTheCounterUnchanged) {
  NorFlash start(kPages);
  GetParam().before(start);
  const Bytes old = load(start);
  const Bytes& next = GetParam().next;
  const std::uint64_t counter = counter_after(start);
  std::size_t olds = 0;
  std::size_t news = 0;
  cut_everywhere(
      start, [&](NorFlash& flash) { return store(flash, next); },
      [&](NorFlash& flash, bool done, const std::string& where) {
        const Bytes left = load(flash);
        ASSERT_TRUE(left == old || left == next) << where;
        ASSERT_TRUE(!done || left == next) << where;
        ++(left == next ? news : olds);
        ASSERT_EQ(counter_after(flash), counter) << where;
        // The store still works.
        ASSERT_TRUE(store(flash, blob(300, 77))) << where;
        ASSERT_EQ(load(flash), blob(300, 77)) << where;
        ASSERT_EQ(flash.overwrites(), 0U) << where;
        ASSERT_EQ(counter_after(flash), counter) << where;
      });
  EXPECT_GT(olds, 0U);
  EXPECT_GT(news, 0U);
}

// Cuts the power again on the flash left by a first cut: half-erased pages, torn records followed by others
// that have to move.
TEST_P(PowerCut, TwiceInARowIsSurvived) {
  NorFlash start(kPages);
  GetParam().before(start);
  const Bytes old = load(start);
  const Bytes& first = GetParam().next;
  const Bytes second = blob(40, 9);
  // A sample of the first cuts, including late operations: all of them would take too long.
  NorFlash whole = start;
  ASSERT_TRUE(store(whole, first));
  const std::uint64_t operations = whole.operations() - start.operations();
  for (std::uint64_t operation = operations % 7; operation < operations; operation += 1 + operations / 7) {
    for (const NorFlash::Tear tear : NorFlash::kTears) {
      NorFlash between = start;
      between.cut_power_at(operation, tear, 5);
      (void)store(between, first);
      between.power_on();
      const Bytes kept = load(between);
      ASSERT_TRUE(kept == old || kept == first);
      cut_everywhere(
          between, [&](NorFlash& flash) { return store(flash, second); },
          [&](NorFlash& flash, bool done, const std::string& where) {
            const Bytes left = load(flash);
            ASSERT_TRUE(left == second || (!done && left == kept))
                << where << " after operation " << operation << ", tear " << static_cast<int>(tear);
          });
      if (HasFatalFailure() || HasNonfatalFailure()) return;
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Storage, PowerCut, ::testing::ValuesIn(scenarios()), [](const auto& test) {
  std::string name = test.param.name;
  std::replace_if(
      name.begin(), name.end(), [](char c) { return c == ' ' || c == '\''; }, '_');
  return name;
});

TEST(PowerCutFuzz, RandomCutsLeaveTheOldOrTheNewRecordAndNoCounterRepeats) {
  for (std::uint64_t seed = 1; seed <= 40; ++seed) {
    KeyedRandom random(seed);
    NorFlash flash(kPages);
    Bytes config;
    std::uint64_t given = 0;  // above all counter values so far
    for (std::uint64_t step = 0; step < 400; ++step) {
      const KeyedRandom draw = random.of(step);
      if (draw.of(0).uniform() < 0.5) {
        const auto tear = NorFlash::kTears[draw.of(1).bits() % std::size(NorFlash::kTears)];
        flash.cut_power_at(draw.of(2).bits() % 120, tear, draw.of(3).bits());
      }
      if (draw.of(4).uniform() < 0.6) {
        const bool reset = draw.of(5).uniform() < 0.1;
        const Bytes next =
            reset ? Bytes{} : blob(static_cast<std::size_t>(1 + draw.of(6).bits() % 400), draw.of(7).bits());
        const bool done = store(flash, next);
        ASSERT_TRUE(done || !flash.powered()) << seed << ' ' << step;
        flash.power_on();
        const Bytes left = load(flash);
        ASSERT_TRUE(left == next || (!done && left == config)) << seed << ' ' << step;
        config = left;
      } else {
        Counter counter(flash);
        const auto value = counter.next();
        ASSERT_TRUE(value || !flash.powered()) << seed << ' ' << step;
        if (value) {
          ASSERT_GE(*value, given) << seed << ' ' << step;
          given = *value + 1;
        }
        flash.power_on();
        ASSERT_EQ(load(flash), config) << seed << ' ' << step;
      }
    }
    EXPECT_GT(flash.erases(0), 2U);
    EXPECT_LE(flash.most_writes_in_a_block(), NorFlash::kMaxWritesPerBlock);
  }
}

// ---- the counter ----------------------------------------------------------------------------------------

TEST(Counter, CountsWithinABlockAndReservesTheNext) {
  NorFlash flash(kPages);
  Counter counter(flash);
  ASSERT_EQ(counter.next(), 0U);
  const std::uint64_t operations = flash.operations();
  for (std::uint64_t i = 1; i < Counter<NorFlash>::kBlock; ++i) ASSERT_EQ(counter.next(), i);
  EXPECT_EQ(flash.operations(), operations);
  EXPECT_EQ(counter.next(), Counter<NorFlash>::kBlock);
  EXPECT_GT(flash.operations(), operations);
}

TEST(Counter, TheBlockNumberCountsTheBoots) {
  NorFlash flash(kPages);
  for (std::uint32_t boot = 1; boot <= 5; ++boot) {
    Counter counter(flash);
    EXPECT_EQ(counter.open_block(), boot);
    EXPECT_EQ(counter.next(), (boot - 1) * Counter<NorFlash>::kBlock);
  }
  flash.cut_power_at(0, NorFlash::Tear::kHalf, 0);
  EXPECT_EQ(Counter(flash).open_block(), 0U);
}

TEST(Counter, StartsEachBootWithANewBlock) {
  NorFlash flash(kPages);
  ASSERT_TRUE(store(flash, blob(100, 1)));
  for (std::uint64_t boot = 0; boot < 1'000; ++boot) {
    Counter counter(flash);
    ASSERT_EQ(counter.next(), boot * Counter<NorFlash>::kBlock);
    ASSERT_EQ(counter.next(), boot * Counter<NorFlash>::kBlock + 1);
  }
  EXPECT_EQ(load(flash), blob(100, 1));
  // About 250 boots per erase.
  EXPECT_LE(flash.erases(0) + flash.erases(1), 6U);
}

TEST(Counter, NeverRepeatsAfterAPowerCut) {
  for (const std::size_t boots : {0U, 1U, 248U, 251U, 252U}) {
    NorFlash start(kPages);
    ASSERT_TRUE(store(start, blob(30, 1)));
    for (std::size_t i = 0; i < boots; ++i) ASSERT_TRUE(Counter(start).next());
    cut_everywhere(
        start, [](NorFlash& flash) { return Counter(flash).next().has_value(); },
        [&](NorFlash& flash, bool done, const std::string& where) {
          ASSERT_GE(Counter(flash).next().value_or(0), (boots + (done ? 1 : 0)) * Counter<NorFlash>::kBlock)
              << where;
          ASSERT_EQ(load(flash), blob(30, 1)) << where;
        });
  }
}

TEST(Counter, ReturnsNothingIfItCannotReserve) {
  NorFlash flash(kPages);
  flash.cut_power_at(3, NorFlash::Tear::kHalf, 0);
  Counter counter(flash);
  EXPECT_FALSE(counter.next());
  EXPECT_FALSE(counter.next());
}

}  // namespace
}  // namespace groma::storage
