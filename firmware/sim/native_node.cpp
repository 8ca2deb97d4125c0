#include "firmware/sim/native_node.hpp"

#include <algorithm>
#include <limits>
#include <optional>
#include <string>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/node/node.hpp"
#include "firmware/core/storage/config_store.hpp"
#include "firmware/core/storage/counter.hpp"
#include "firmware/sim/aes.hpp"
#include "firmware/sim/nor_flash.hpp"

namespace groma::sim {

namespace {

constexpr SimTime kBootTime = 3 * kUnitsPerMillisecond;        // crystal and start-up code
constexpr SimTime kRadioResetTime = 2 * kUnitsPerMillisecond;  // from the reset line's release to SPI

static_assert(node::kMaxConfigBytes <= storage::kMaxRecordBytes);

SimTime from_us(double t_us) {
  return from_seconds(t_us * 1e-6);
}

// Takes as long as the nRF52832's ECB peripheral.
class TimedAes final : public security::BlockCipher {
 public:
  explicit TimedAes(SimTime& now) noexcept : now_(now) {}
  bool encrypt(const security::Key& key, security::Block& block) noexcept override {
    constexpr SimTime kBlockTime = 8 * kUnitsPerMicrosecond;  // 7.2 us, and polling
    now_ += kBlockTime;
    return aes_.encrypt(key, block);
  }

 private:
  SimTime& now_;
  Aes aes_;
};

// One node's hardware as its firmware sees it. Its time runs ahead of the network's by the work it does.
class NativePlatform {
 public:
  class Spi {
   public:
    explicit Spi(NativePlatform& platform) : platform_(platform) {}
    void write(std::span<const std::uint8_t> header, std::span<const std::uint8_t> out) noexcept {
      platform_.chip.write(platform_.spend(header.size() + out.size()), header, out, platform_.spi_hz_);
    }
    void read(std::span<const std::uint8_t> header, std::span<std::uint8_t> in) noexcept {
      platform_.chip.read(platform_.spend(header.size() + in.size()), header, in, platform_.spi_hz_);
    }
    void set_speed(dw1000::SpiSpeed speed) noexcept {
      const CpuSettings& cpu = platform_.spec_.cpu;
      platform_.spi_hz_ = speed == dw1000::SpiSpeed::kFast ? cpu.spi_fast_hz : cpu.spi_slow_hz;
    }
    void select(bool low) noexcept { platform_.chip.select(platform_.now, low); }

   private:
    NativePlatform& platform_;
  };
  using Radio = dw1000::Dw1000<Spi>;

  NativePlatform(const NodeSpec& spec, Medium& medium)
      : chip(spec.chip, medium),
        uart_out(spec.uart),
        uart_in(spec.uart),
        spec_(spec),
        clock_(spec.cpu_clock.value_or(spec.chip.clock)),
        transaction_time_(from_us(spec.cpu.spi_transaction_us)),
        spi_hz_(spec.cpu.spi_slow_hz),
        spi_(*this),
        flash_(storage::kPages),
        config_(flash_) {
    if (!config_.store(spec.stored_config)) {
      throw SimulationError("stored_config: at most " + std::to_string(storage::kMaxRecordBytes) + " bytes");
    }
  }

  // ---- interface to the firmware (firmware/core/node/platform.hpp) ---------------------------------------
  Spi& spi() noexcept { return spi_; }
  void reset_radio() noexcept {
    chip.reset(now);
    now += kRadioResetTime;
  }
  void delay_us(std::uint32_t duration_us) noexcept { now += SimTime{duration_us} * kUnitsPerMicrosecond; }
  std::uint64_t now_us() noexcept { return local_us(now) - boot_us_; }
  std::uint64_t radio_interrupt_us() noexcept { return local_us(interrupt_at) - boot_us_; }
  const char* configure_link(const groma_Config&) noexcept { return ""; }  // it has one link
  bool link_write(std::span<const std::uint8_t> frame) noexcept { return uart_out.write(now, frame); }
  bool link_answer(std::span<const std::uint8_t> frame) noexcept { return link_write(frame); }
  void count_link(groma_Counters&) noexcept {}
  bool store_config(std::span<const std::uint8_t> blob) noexcept {
    const SimTime busy_before = flash_.busy_time();
    const bool stored = config_.store(blob);
    now += flash_.busy_time() - busy_before;
    return stored;
  }
  std::size_t load_config(std::span<std::uint8_t> out) noexcept { return config_.load(out); }
  security::BlockCipher& cipher() noexcept { return cipher_; }
  void set_indicator(node::Indicator indicator) noexcept { indicator_ = indicator; }
  void restart() noexcept { restart_requested = true; }
  [[nodiscard]] node::ResetReason reset_reason() const noexcept { return reset_reason_; }
  [[nodiscard]] std::optional<node::Fault> last_fault() const noexcept { return std::nullopt; }
  [[nodiscard]] std::uint32_t boot_count() const noexcept { return boot_count_; }
  void proof_of_life() noexcept {}
  [[nodiscard]] node::StackUse stack_use() const noexcept { return {}; }

  // ---- interface to NativeNode ---------------------------------------------------------------------------
  void boot(SimTime t, node::ResetReason reason) {
    now = t;
    boot_us_ = local_us(t);
    reset_reason_ = reason;
    restart_requested = false;
    spi_hz_ = spec_.cpu.spi_slow_hz;
    const SimTime busy_before = flash_.busy_time();
    boot_count_ = storage::Counter(flash_).open_block();
    now += flash_.busy_time() - busy_before;
  }
  // When the processor's clock reaches t_us.
  [[nodiscard]] SimTime time_of_us(std::uint64_t t_us) const {
    constexpr std::uint64_t kLast =
        static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max() / kUnitsPerMicrosecond / 2);
    if (t_us > kLast) return kNever;
    return clock_.time_of_local(static_cast<std::int64_t>(t_us + boot_us_) * kUnitsPerMicrosecond);
  }

  Dw1000Chip chip;
  UartLine uart_out;
  UartLine uart_in;
  SimTime now = 0;  // the node's local time: its processor is busy until then
  bool restart_requested = false;
  SimTime interrupt_at = kNever;  // when the radio's interrupt line rose; kNever: it is low

 private:
  SimTime spend(std::size_t bytes) noexcept {
    now += transaction_time_ + static_cast<SimTime>(bytes) * 8 * kUnitsPerSecond / spi_hz_;
    return now;
  }
  [[nodiscard]] std::uint64_t local_us(SimTime t) const noexcept {
    return static_cast<std::uint64_t>(clock_.local_units(t) / kUnitsPerMicrosecond);
  }

  NodeSpec spec_;
  NodeClock clock_;
  SimTime transaction_time_;
  std::uint32_t spi_hz_;
  Spi spi_;
  NorFlash flash_;
  TimedAes cipher_{now};
  storage::ConfigStore<NorFlash> config_;
  node::Indicator indicator_ = node::Indicator::kUnconfigured;
  node::ResetReason reset_reason_ = node::ResetReason::kPowerOn;
  std::uint64_t boot_us_ = 0;
  std::uint32_t boot_count_ = 0;
};

static_assert(node::Platform<NativePlatform>);

class NativeNode final : public NodeHost {
 public:
  NativeNode(const NodeSpec& spec, Medium& medium)
      : platform_(spec, medium), interrupt_time_(from_us(spec.cpu.interrupt_us)), boots_at_(spec.power_on) {}

  [[nodiscard]] Dw1000Chip& chip() noexcept override { return platform_.chip; }
  [[nodiscard]] UartLine& uart_out() noexcept override { return platform_.uart_out; }
  [[nodiscard]] UartLine& uart_in() noexcept override { return platform_.uart_in; }

  [[nodiscard]] SimTime next_work() override {
    if (!firmware_) return boots_at_;
    SimTime work = std::min(timer_at_, platform_.uart_in.next_byte());
    if (platform_.chip.irq()) work = std::min(work, platform_.chip.now());
    return work == kNever ? kNever : std::max(work, platform_.now);
  }

  void run(SimTime now) override {
    if (!firmware_) {
      if (now >= boots_at_) boot(now);
      return;
    }
    platform_.chip.advance(now);
    if (platform_.chip.irq()) platform_.interrupt_at = std::min(platform_.interrupt_at, now);
    if (platform_.now > now) return;
    if (platform_.chip.irq()) {
      platform_.now = now + interrupt_time_;
      firmware_->on_radio_interrupt();
      platform_.interrupt_at = kNever;
    } else if (timer_at_ <= now) {
      platform_.now = now + interrupt_time_;
      firmware_->on_timer();
    } else if (platform_.uart_in.next_byte() <= now) {
      received_.clear();
      platform_.uart_in.take(now, received_);
      bytes_.clear();
      for (const TimedByte& byte : received_) bytes_.push_back(byte.value);
      platform_.now = now + interrupt_time_;
      firmware_->on_link_bytes(bytes_);
    } else {
      return;
    }
    after_work();
  }

  void set_power(bool on, SimTime now) override {
    if (on == (firmware_.has_value() || boots_at_ != kNever)) return;
    if (on) {
      boots_at_ = now;
      return;
    }
    firmware_.reset();
    boots_at_ = kNever;
    platform_.chip.set_power(false, now);
    platform_.uart_out.clear(now);
    platform_.uart_in.clear(now);
  }

 private:
  void boot(SimTime now) {
    // If the radio chip is already powered, only the processor restarts.
    platform_.boot(now + kBootTime, restarting_ ? node::ResetReason::kSoftware : node::ResetReason::kPowerOn);
    restarting_ = false;
    boots_at_ = kNever;
    platform_.chip.set_power(true, now);
    firmware_.emplace(platform_, node::Build{.version = "simulated", .git_hash = 0});
    firmware_->start();
    after_work();
  }

  void after_work() {
    if (platform_.restart_requested) {
      firmware_.reset();
      restarting_ = true;
      boots_at_ = platform_.now;
      return;
    }
    timer_at_ = platform_.time_of_us(firmware_->next_deadline_us());
  }

  NativePlatform platform_;
  std::optional<node::Node<NativePlatform>> firmware_;
  SimTime interrupt_time_;
  SimTime boots_at_;
  bool restarting_ = false;
  SimTime timer_at_ = kNever;
  std::vector<TimedByte> received_;
  std::vector<std::uint8_t> bytes_;
};

}  // namespace

std::unique_ptr<NodeHost> make_native_node(const NodeSpec& spec, Medium& medium) {
  return std::make_unique<NativeNode>(spec, medium);
}

std::size_t Network::add_native(const NodeSpec& spec) {
  return add(make_native_node(spec, medium_));
}

}  // namespace groma::sim
