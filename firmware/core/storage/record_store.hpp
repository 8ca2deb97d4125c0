// Small records that survive resets and power cuts, in two pages of flash: the newest record of each key.
//
//   page    0  "GROM"      u32 0x4D4F5247
//           4  u32         format version
//           8  u32         sequence number, one more than the other page's when this one took over; may wrap
//          12  u32         CRC-32 of the 12 bytes before
//          16  records, one after the other
//
//   record  0  u8 0xA5, u8 key, u16 length of the payload
//           4  payload, padded with zeros to a multiple of 4
//           .  u32         CRC-32 of the page's sequence number and of all bytes of the record before it
//
// All numbers are little-endian. The active page is the valid page with the newer sequence number. The value
// of a key is its last record there, before the first invalid record. An empty record deletes its key.
//
// A record is appended to the active page while there is blank room. Otherwise the other page is erased and
// gets the newest record of each other key, then the new record, and its header last, which activates it.
// Until then the active page is not changed, so a power cut at any instant leaves either the old state or the
// new. Each word is written once between two erases.
//
// Nothing is cached in RAM: each call reads the flash again, about 8 KiB at most.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/storage/flash.hpp"
#include "proto/crc32.hpp"

namespace groma::storage {

enum class Key : std::uint8_t { kConfig = 1, kCounter = 2 };
inline constexpr std::array kKeys{Key::kConfig, Key::kCounter};

inline constexpr std::size_t kMaxRecordBytes = 1024;

inline constexpr std::uint32_t kPageMagic = 0x4D4F5247;
inline constexpr std::uint32_t kFormatVersion = 1;
inline constexpr std::uint32_t kRecordMark = 0xA5;

template <Flash F>
class RecordStore {
 public:
  explicit constexpr RecordStore(F& flash) noexcept : flash_(flash) {}

  // Copies the newest record's payload to the start of `out` and returns its length; 0: there is none, or it
  // does not fit.
  [[nodiscard]] std::size_t load(Key key, std::span<std::uint8_t> out) const noexcept {
    const std::optional<Record> record = newest(key);
    if (!record || record->bytes > out.size()) return 0;
    for (std::uint32_t i = 0; i < record->bytes; ++i) out[i] = byte_of(*record, i);
    return record->bytes;
  }

  // Replaces the record of `key`; an empty payload deletes it. Returns true if the record is in flash and was
  // read back. Returns false if it is too long or the flash failed; the old record then stays valid. Takes an
  // erase (see flash.hpp) if the page is full.
  [[nodiscard]] bool store(Key key, std::span<const std::uint8_t> payload) noexcept {
    if (payload.size() > kMaxRecordBytes) return false;
    if (holds(key, payload)) return true;
    return (append(key, payload) || move(key, payload)) && holds(key, payload);
  }

 private:
  static constexpr std::uint32_t kHeadBytes = 16;
  static constexpr std::uint32_t record_bytes(std::uint32_t payload_bytes) noexcept {
    return 4 + (payload_bytes + 3) / 4 * 4 + 4;
  }
  static_assert(kHeadBytes + kKeys.size() * record_bytes(kMaxRecordBytes) <= kPageBytes,
                "the longest record of each key fits a fresh page");

  struct Record {
    Key key{};
    std::uint32_t bytes = 0;    // of the payload
    std::uint32_t payload = 0;  // offset of the payload
    std::uint32_t end = 0;
  };
  struct Page {
    std::size_t index = 0;
    std::uint32_t sequence = 0;
  };

  [[nodiscard]] static constexpr std::uint32_t start_of(std::size_t page) noexcept {
    return static_cast<std::uint32_t>(page) * kPageBytes;
  }

  // ---- reading -------------------------------------------------------------------------------------------

  [[nodiscard]] std::optional<Page> page(std::size_t index) const noexcept {
    const std::uint32_t start = start_of(index);
    const std::uint32_t sequence = flash_.read(start + 8);
    if (flash_.read(start) != kPageMagic || flash_.read(start + 4) != kFormatVersion ||
        flash_.read(start + 12) != head_check(sequence)) {
      return std::nullopt;
    }
    return Page{.index = index, .sequence = sequence};
  }

  [[nodiscard]] std::optional<Page> page_in_force() const noexcept {
    const std::optional<Page> first = page(0);
    const std::optional<Page> second = page(1);
    if (!first || !second) return first ? first : second;
    return static_cast<std::int32_t>(second->sequence - first->sequence) > 0 ? second : first;
  }

  [[nodiscard]] std::optional<Record> record_at(std::uint32_t offset, const Page& page) const noexcept {
    const std::uint32_t page_end = start_of(page.index) + kPageBytes;
    if (offset + record_bytes(0) > page_end) return std::nullopt;
    const std::uint32_t head = flash_.read(offset);
    const std::uint32_t bytes = head >> 16;
    if ((head & 0xFF) != kRecordMark || bytes > kMaxRecordBytes || offset + record_bytes(bytes) > page_end) {
      return std::nullopt;
    }
    const std::uint32_t check_at = offset + record_bytes(bytes) - 4;
    wire::Crc32 crc;
    crc.add_word(page.sequence);
    for (std::uint32_t at = offset; at < check_at; at += 4) crc.add_word(flash_.read(at));
    if (flash_.read(check_at) != crc.value()) return std::nullopt;
    return Record{.key = static_cast<Key>((head >> 8) & 0xFF),
                  .bytes = bytes,
                  .payload = offset + 4,
                  .end = check_at + 4};
  }

  // Calls f(record) for each valid record; returns the offset of the first invalid one, or of the blank room.
  template <class Function>
  std::uint32_t each_record(const Page& page, Function&& f) const noexcept {
    std::uint32_t offset = start_of(page.index) + kHeadBytes;
    while (const std::optional<Record> record = record_at(offset, page)) {
      f(*record);
      offset = record->end;
    }
    return offset;
  }

  [[nodiscard]] std::optional<Record> newest(Key key) const noexcept {
    std::optional<Record> newest;
    if (const std::optional<Page> page = page_in_force()) {
      each_record(*page, [&](const Record& record) {
        if (record.key == key) newest = record;
      });
    }
    return newest;
  }

  [[nodiscard]] std::uint8_t byte_of(const Record& record, std::uint32_t index) const noexcept {
    return static_cast<std::uint8_t>(flash_.read(record.payload + index / 4 * 4) >> (index % 4 * 8));
  }

  [[nodiscard]] bool holds(Key key, std::span<const std::uint8_t> payload) const noexcept {
    const std::optional<Record> record = newest(key);
    if ((record ? record->bytes : 0) != payload.size()) return false;
    for (std::uint32_t i = 0; i < payload.size(); ++i) {
      if (byte_of(*record, i) != payload[i]) return false;
    }
    return true;
  }

  [[nodiscard]] bool blank(std::uint32_t from, std::uint32_t to) const noexcept {
    for (std::uint32_t at = from; at < to; at += 4) {
      if (flash_.read(at) != kErasedWord) return false;
    }
    return true;
  }

  // ---- writing -------------------------------------------------------------------------------------------

  // Writes words in order and verifies each; writes no more after a failure.
  class Writer {
   public:
    Writer(F& flash, std::uint32_t offset) noexcept : flash_(flash), offset_(offset) {}

    void put(std::uint32_t word) noexcept {
      good_ = good_ && flash_.write(offset_, word) && flash_.read(offset_) == word;
      offset_ += 4;
    }
    [[nodiscard]] bool good() const noexcept { return good_; }
    [[nodiscard]] std::uint32_t offset() const noexcept { return offset_; }

   private:
    F& flash_;
    std::uint32_t offset_;
    bool good_ = true;
  };

  template <class ByteAt>
  static void put_record(Writer& writer, std::uint32_t sequence, Key key, std::uint32_t bytes,
                         ByteAt&& byte_at) noexcept {
    wire::Crc32 crc;
    crc.add_word(sequence);
    const auto put = [&](std::uint32_t word) {
      crc.add_word(word);
      writer.put(word);
    };
    put(kRecordMark | static_cast<std::uint32_t>(key) << 8 | bytes << 16);
    for (std::uint32_t i = 0; i < bytes; i += 4) {
      std::uint32_t word = 0;
      for (std::uint32_t k = i; k < i + 4 && k < bytes; ++k) {
        word |= static_cast<std::uint32_t>(byte_at(k)) << (k % 4 * 8);
      }
      put(word);
    }
    writer.put(crc.value());
  }

  bool append(Key key, std::span<const std::uint8_t> payload) noexcept {
    const std::optional<Page> page = page_in_force();
    if (!page) return false;
    const std::uint32_t offset = each_record(*page, [](const Record&) {});
    const auto bytes = static_cast<std::uint32_t>(payload.size());
    const std::uint32_t end = offset + record_bytes(bytes);
    if (end > start_of(page->index) + kPageBytes || !blank(offset, end)) return false;
    Writer writer(flash_, offset);
    put_record(writer, page->sequence, key, bytes, [&](std::uint32_t i) { return payload[i]; });
    return writer.good();
  }

  // Writes to the inactive page, after erasing it.
  bool move(Key key, std::span<const std::uint8_t> payload) noexcept {
    const std::optional<Page> from = page_in_force();
    const std::size_t to = from ? 1 - from->index : 0;
    const std::uint32_t sequence = from ? from->sequence + 1 : 1;
    const std::uint32_t start = start_of(to);
    if (!flash_.erase(to) || !blank(start, start + kPageBytes)) return false;
    Writer writer(flash_, start + kHeadBytes);
    for (const Key other : kKeys) {
      if (other == key) continue;
      if (const std::optional<Record> kept = newest(other)) {
        put_record(writer, sequence, other, kept->bytes, [&](std::uint32_t i) { return byte_of(*kept, i); });
      }
    }
    put_record(writer, sequence, key, static_cast<std::uint32_t>(payload.size()),
               [&](std::uint32_t i) { return payload[i]; });
    return writer.good() && put_head(start, sequence);
  }

  [[nodiscard]] static std::uint32_t head_check(std::uint32_t sequence) noexcept {
    wire::Crc32 crc;
    for (const std::uint32_t word : {kPageMagic, kFormatVersion, sequence}) crc.add_word(word);
    return crc.value();
  }

  bool put_head(std::uint32_t start, std::uint32_t sequence) noexcept {
    Writer writer(flash_, start);
    for (const std::uint32_t word : {kPageMagic, kFormatVersion, sequence, head_check(sequence)})
      writer.put(word);
    return writer.good();
  }

  F& flash_;
};

}  // namespace groma::storage
