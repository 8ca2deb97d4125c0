// The image: runs one node on this board.
#include "firmware/board/dwm1001/board.hpp"
#include "firmware/board/dwm1001/clock.hpp"
#include "firmware/board/dwm1001/nrf52832.hpp"
#include "firmware/core/node/image_identity.hpp"
#include "firmware/core/node/node.hpp"
#include "generated/groma_version.hpp"

namespace {

using groma::dwm1001::Board;
using groma::node::Build;
using groma::node::Node;

constinit Board board;

// For tools that flash the image: see image_identity.hpp.
[[gnu::used, gnu::section(".identity")]] constexpr groma::node::ImageIdentity kIdentity(groma::kVersion,
                                                                                        groma::kGitHash);

}  // namespace

// Interrupt handlers only record events and wake the processor; main() does the work.
extern "C" {

void uarte0_entry() {
  board.uart().on_interrupt();
}

void ecb_entry() {
  board.ecb().on_interrupt();
}

// The events themselves need no record: the lines' levels are read before each sleep.
void gpiote_entry() {
  namespace gpiote = groma::nrf52832::gpiote;
  if (gpiote::kBlock[gpiote::kEventIn] != 0) groma::dwm1001::clock::mark();
  groma::nrf52832::clear_event(gpiote::kBlock[gpiote::kEventIn]);
  groma::nrf52832::clear_event(gpiote::kBlock[gpiote::kEventIn + 4]);
}
}

int main() {
  board.start();
  static Node<Board> node(board, Build{.version = groma::kVersion, .git_hash = groma::kGitHash});
  node.start();
  for (;;) {
    if (board.radio_interrupt()) node.on_radio_interrupt();
    const std::uint64_t now_us = board.now_us();
    if (now_us >= node.next_deadline_us()) {
      node.on_timer();
      // A report is made in several steps; the radio is polled between them.
      if (board.radio_interrupt()) continue;
    }
    if (const auto bytes = board.uart().received(now_us); !bytes.empty()) {
      board.set_command_over_can(false);
      node.on_link_bytes(bytes);
      board.uart().release(bytes.size());
      continue;
    }
    const auto from_can = [](std::span<const std::uint8_t> in) {
      board.set_command_over_can(true);
      node.on_link_bytes(in);
    };
    if (board.can().service(now_us, node.quiet_until_us(), from_can)) continue;
    board.update_leds(now_us);
    board.sleep_until(node.next_deadline_us());
  }
}
