// Compiled as for the target, without exceptions, RTTI or a hosted library, so that nothing creeps into the
// core that the board's toolchain would not take. A node is instantiated on hardware that does nothing.
#include "firmware/core/node/can_link.hpp"
#include "firmware/core/node/node.hpp"
#include "firmware/core/storage/config_store.hpp"
#include "firmware/core/storage/counter.hpp"

namespace groma::node {
namespace {

class NoSpi {
 public:
  void write(std::span<const std::uint8_t>, std::span<const std::uint8_t>) noexcept {}
  void read(std::span<const std::uint8_t>, std::span<std::uint8_t>) noexcept {}
  void set_speed(dw1000::SpiSpeed) noexcept {}
};

class NoCanSpi {
 public:
  void transfer(std::span<std::uint8_t>) noexcept {}
};

class NoCipher final : public security::BlockCipher {
 public:
  bool encrypt(const security::Key&, security::Block&) noexcept override { return false; }
};

class NoHardware {
 public:
  NoSpi& spi() noexcept { return spi_; }
  void reset_radio() noexcept {}
  void delay_us(std::uint32_t) noexcept {}
  std::uint64_t now_us() noexcept { return 0; }
  bool link_write(std::span<const std::uint8_t>) noexcept { return false; }
  const char* configure_link(const groma_Config&) noexcept { return ""; }
  bool link_answer(std::span<const std::uint8_t>) noexcept { return false; }
  void count_link(groma_Counters&) noexcept {}
  bool store_config(std::span<const std::uint8_t>) noexcept { return false; }
  std::size_t load_config(std::span<std::uint8_t>) noexcept { return 0; }
  security::BlockCipher& cipher() noexcept { return cipher_; }
  void set_indicator(Indicator) noexcept {}
  void restart() noexcept {}
  ResetReason reset_reason() noexcept { return ResetReason::kPowerOn; }
  std::optional<Fault> last_fault() noexcept { return std::nullopt; }
  std::uint32_t boot_count() noexcept { return 0; }
  void proof_of_life() noexcept {}
  StackUse stack_use() noexcept { return {}; }

 private:
  NoSpi spi_;
  NoCipher cipher_;
};

class NoFlash {
 public:
  bool erase(std::size_t) noexcept { return false; }
  bool write(std::uint32_t, std::uint32_t) noexcept { return false; }
  [[nodiscard]] std::uint32_t read(std::uint32_t) const noexcept { return storage::kErasedWord; }
};

static_assert(dw1000::Spi<NoSpi>);
static_assert(ChoosesLink<NoHardware>);
static_assert(mcp2518fd::Spi<NoCanSpi>);

}  // namespace

template class Node<NoHardware>;
template class CanLink<NoCanSpi>;

// 24 KiB of RAM are the image's budget, stack and drivers included.
static_assert(sizeof(Node<NoHardware>) <= 16'384);
static_assert(sizeof(CanLink<NoCanSpi>) <= 1'700);

}  // namespace groma::node

template class groma::storage::ConfigStore<groma::node::NoFlash>;
template class groma::storage::Counter<groma::node::NoFlash>;
