// The symbols of the linker script (image.ld).
#pragma once

#include <cstdint>

extern "C" {
// NOLINTBEGIN(readability-identifier-naming)
extern std::uint32_t groma_stack_begin[];
extern std::uint32_t groma_stack_end[];
extern std::uint32_t groma_fault_stack_end[];
extern std::uint32_t groma_data_begin[];
extern std::uint32_t groma_data_end[];
extern const std::uint32_t groma_data_load[];
extern std::uint32_t groma_bss_begin[];
extern std::uint32_t groma_bss_end[];
extern const std::uint8_t groma_text_begin[];
extern const std::uint8_t groma_text_end[];
extern void (*const groma_constructors_begin[])();
extern void (*const groma_constructors_end[])();
// NOLINTEND(readability-identifier-naming)
}

namespace groma::cortex_m4 {

// The pattern that start-up fills the stack with.
inline constexpr std::uint32_t kStackPaint = 0xC5C5'C5C5;

[[nodiscard]] inline std::uint32_t address_of(const void* p) noexcept {
  return reinterpret_cast<std::uintptr_t>(p);
}

}  // namespace groma::cortex_m4
