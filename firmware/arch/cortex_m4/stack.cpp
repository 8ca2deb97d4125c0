#include "firmware/arch/cortex_m4/stack.hpp"

#include "firmware/arch/cortex_m4/memory.hpp"

namespace groma::cortex_m4 {

node::StackUse stack_use() noexcept {
  const volatile std::uint32_t* word = groma_stack_begin;
  while (word != groma_stack_end && *word == kStackPaint) ++word;
  const std::uint32_t end = address_of(groma_stack_end);
  return {.size_bytes = end - address_of(groma_stack_begin),
          .high_water_bytes = end - reinterpret_cast<std::uintptr_t>(word)};
}

}  // namespace groma::cortex_m4
