"""Mutations of the chip's code: each leaves out what a quirk of the silicon requires; see scripts/mutations."""

ECB = "firmware/soc/nrf52832/ecb.cpp"
SPIM = "firmware/soc/nrf52832/spim.cpp"
PLATFORM = "firmware/soc/nrf52832/platform.cpp"
CPU = "firmware/soc/nrf52832/cpu.hpp"
CLOCK = "firmware/soc/nrf52832/clock.cpp"

# name, source, text, its replacement, the test of sim_emulated_node_test that is to notice
MUTATIONS = [
    ("SPI: asleep during a transfer", SPIM,
     "  while (registers_[spim::kEventEnd] == 0) {\n  }\n",
     "  while (registers_[spim::kEventEnd] == 0) {\n"
     "    asm volatile(\"cpsid i\\n dsb\\n wfi\\n nop\\n nop\\n nop\\n nop\\n cpsie i\" ::: \"memory\");\n  }\n",
     "ShippedSilicon.StaysAwakeDuringSpiTransfers"),
    ("SPI: clock without its input buffer", SPIM,
     "pin::configure(pins_.clock, gpio::kOutputWithInput);",
     "pin::configure(pins_.clock, gpio::kOutput);",
     "ShippedSilicon.ConnectsTheInputBufferOfBothSpiClocks"),
    ("UART: asleep at the start of a message", PLATFORM,
     "  if (uart_.starting()) return;\n",
     "",
     "ShippedSilicon.StaysAwakeAtTheStartOfMessages"),
    ("ECB: asleep while a block is encrypted", ECB,
     "  while (state_ == State::kBusy) {\n",
     "  while (state_ == State::kBusy) {\n"
     "    asm volatile(\"cpsid i\\n dsb\\n wfi\\n nop\\n nop\\n nop\\n nop\\n cpsie i\" ::: \"memory\");\n",
     "ShippedSilicon.StaysAwakeWhileBlocksAreEncrypted"),
    ("sleep: three NOPs after the wake-up", CPU,
     "wfi\\n nop\\n nop\\n nop\\n nop",
     "wfi\\n nop\\n nop\\n nop",
     "ShippedSilicon.WritesNoMemoryJustAfterItsWakeUps"),
    ("sleep: interrupts not masked", PLATFORM,
     "  const InterruptLock lock;\n  if (uart_.starting()",
     "  if (uart_.starting()",
     "ShippedSilicon.WritesNoMemoryJustAfterItsWakeUps"),
    ("clock: slow clock started at once after a reset", CLOCK,
     "kAfterReset_us = 400",
     "kAfterReset_us = 100",
     "ShippedSilicon.WaitsAfterAResetBeforeItStartsItsSlowClock"),
]
