// The three functions that compilers call implicitly. Those of the small C library copy byte by byte; a tag
// that reports a thousand ranges a second would spend a tenth of its time there. The processor can access
// words at any address.
#include <cstddef>
#include <cstdint>

namespace {

using Word = std::uint32_t;

[[nodiscard]] Word load(const std::uint8_t* from) noexcept {
  Word word;
  __builtin_memcpy(&word, from, sizeof(word));
  return word;
}

void store(std::uint8_t* to, Word word) noexcept {
  __builtin_memcpy(to, &word, sizeof(word));
  // Otherwise the compiler would recognize the loop as memcpy or memset and call the function recursively.
  asm volatile("" ::: "memory");
}

void store(std::uint8_t* to, std::uint8_t byte) noexcept {
  *to = byte;
  asm volatile("" ::: "memory");
}

}  // namespace

extern "C" {

void* memcpy(void* to, const void* from, std::size_t size) {
  auto* out = static_cast<std::uint8_t*>(to);
  const auto* in = static_cast<const std::uint8_t*>(from);
  for (; size >= 4 * sizeof(Word);
       size -= 4 * sizeof(Word), in += 4 * sizeof(Word), out += 4 * sizeof(Word)) {
    const Word a = load(in);
    const Word b = load(in + sizeof(Word));
    const Word c = load(in + 2 * sizeof(Word));
    const Word d = load(in + 3 * sizeof(Word));
    store(out, a);
    store(out + sizeof(Word), b);
    store(out + 2 * sizeof(Word), c);
    store(out + 3 * sizeof(Word), d);
  }
  for (; size >= sizeof(Word); size -= sizeof(Word), in += sizeof(Word), out += sizeof(Word))
    store(out, load(in));
  for (; size != 0; --size) store(out++, *in++);
  return to;
}

void* memmove(void* to, const void* from, std::size_t size) {
  auto* out = static_cast<std::uint8_t*>(to);
  const auto* in = static_cast<const std::uint8_t*>(from);
  if (out <= in || out >= in + size) return memcpy(to, from, size);
  for (; size >= sizeof(Word); size -= sizeof(Word)) {
    store(out + size - sizeof(Word), load(in + size - sizeof(Word)));
  }
  for (; size != 0; --size) store(out + size - 1, in[size - 1]);
  return to;
}

void* memset(void* to, int value, std::size_t size) {
  auto* out = static_cast<std::uint8_t*>(to);
  const Word word = (static_cast<Word>(value) & 0xFFU) * 0x0101'0101U;
  for (; size >= 4 * sizeof(Word); size -= 4 * sizeof(Word), out += 4 * sizeof(Word)) {
    store(out, word);
    store(out + sizeof(Word), word);
    store(out + 2 * sizeof(Word), word);
    store(out + 3 * sizeof(Word), word);
  }
  for (; size >= sizeof(Word); size -= sizeof(Word), out += sizeof(Word)) store(out, word);
  for (; size != 0; --size) store(out++, static_cast<std::uint8_t>(value));
  return to;
}
}
