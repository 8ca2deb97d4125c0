// The image: runs one node on the board.
#include "firmware/core/node/image_identity.hpp"
#include "firmware/core/node/node.hpp"
#include "firmware/soc/nrf52832/clock.hpp"
#include "firmware/soc/nrf52832/platform.hpp"
#include "firmware/soc/nrf52832/registers.hpp"
#include "generated/groma_version.hpp"

namespace {

using groma::node::Build;
using groma::node::Node;
using groma::nrf52832::Platform;

constinit Platform platform;

// For tools that flash the image: see image_identity.hpp.
[[gnu::used, gnu::section(".identity")]] constexpr groma::node::ImageIdentity kIdentity(groma::kVersion,
                                                                                        groma::kGitHash,
                                                                                        GROMA_BOARD);
static_assert(sizeof(GROMA_BOARD) <= sizeof(groma::node::ImageIdentity::board),
              "the folder of the board needs a shorter name");

}  // namespace

// Interrupt handlers only record events and wake the processor; main() does the work.
extern "C" {

void uarte0_entry() {
  platform.uart().on_interrupt();
}

void ecb_entry() {
  platform.ecb().on_interrupt();
}

// The events themselves need no record: the lines' levels are read before each sleep.
void gpiote_entry() {
  namespace gpiote = groma::nrf52832::gpiote;
  if (gpiote::kBlock[gpiote::kEventIn] != 0) groma::nrf52832::clock::mark();
  groma::nrf52832::clear_event(gpiote::kBlock[gpiote::kEventIn]);
  groma::nrf52832::clear_event(gpiote::kBlock[gpiote::kEventIn + 4]);
}
}

int main() {
  platform.start();
  static Node<Platform> node(platform, Build{.version = groma::kVersion, .git_hash = groma::kGitHash});
  node.start();
  for (;;) {
    if (platform.radio_interrupt()) node.on_radio_interrupt();
    const std::uint64_t now_us = platform.now_us();
    if (now_us >= node.next_deadline_us()) {
      node.on_timer();
      // A report is made in several steps; the radio is polled between them.
      if (platform.radio_interrupt()) continue;
    }
    if (const auto bytes = platform.uart().received(now_us); !bytes.empty()) {
      platform.set_command_over_can(false);
      node.on_link_bytes(bytes);
      platform.uart().release(bytes.size());
      continue;
    }
    const auto from_can = [](std::span<const std::uint8_t> in) {
      platform.set_command_over_can(true);
      node.on_link_bytes(in);
    };
    if (platform.can().service(now_us, node.quiet_until_us(), from_can)) continue;
    platform.update_leds(now_us);
    platform.sleep_until(node.next_deadline_us());
  }
}
