// Reader of a linked 32-bit little-endian ELF file for ARM: sections, symbols, loaded bytes.
#pragma once

#include <elf.h>

#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace groma::test {

class ElfFile {
 public:
  struct Section {
    std::uint32_t address = 0;
    std::uint32_t bytes = 0;
    bool in_memory = false;    // occupies memory while the program runs
    bool has_content = false;  // has bytes in the file
  };

  // Throws std::runtime_error if it is not such a file.
  explicit ElfFile(const std::filesystem::path& path) {
    std::ifstream file(path, std::ios::binary);
    std::ostringstream content;
    content << file.rdbuf();
    bytes_ = content.str();
    const auto header = at<Elf32_Ehdr>(0);
    if (std::memcmp(header.e_ident, ELFMAG, SELFMAG) != 0 || header.e_ident[EI_CLASS] != ELFCLASS32 ||
        header.e_machine != EM_ARM) {
      throw std::runtime_error(path.string() + ": not a 32-bit ELF file for ARM");
    }
    entry_ = header.e_entry;
    std::vector<Elf32_Shdr> sections;
    for (std::uint32_t i = 0; i < header.e_shnum; ++i) {
      sections.push_back(at<Elf32_Shdr>(header.e_shoff + i * header.e_shentsize));
    }
    const Elf32_Shdr& names = sections.at(header.e_shstrndx);
    for (const Elf32_Shdr& section : sections) {
      sections_[text(names.sh_offset + section.sh_name)] = {
          .address = section.sh_addr,
          .bytes = section.sh_size,
          .in_memory = (section.sh_flags & SHF_ALLOC) != 0,
          .has_content = section.sh_type != SHT_NOBITS && section.sh_type != SHT_NULL};
      if (section.sh_type == SHT_SYMTAB) read_symbols(section, sections.at(section.sh_link));
    }
    for (std::uint32_t i = 0; i < header.e_phnum; ++i) {
      const auto segment = at<Elf32_Phdr>(header.e_phoff + i * header.e_phentsize);
      if (segment.p_type == PT_LOAD) load(segment, sections);
    }
  }

  [[nodiscard]] const std::map<std::string, Section>& sections() const { return sections_; }
  // An empty Section if there is none with this name.
  [[nodiscard]] Section section(const std::string& name) const {
    const auto found = sections_.find(name);
    return found == sections_.end() ? Section{} : found->second;
  }
  // Defined symbols: name to value.
  [[nodiscard]] const std::map<std::string, std::uint32_t>& symbols() const { return symbols_; }
  [[nodiscard]] std::uint32_t symbol(const std::string& name) const { return symbols_.at(name); }
  // The bytes that a flashing tool writes, by address.
  [[nodiscard]] const std::map<std::uint32_t, std::uint8_t>& loaded() const { return loaded_; }
  [[nodiscard]] std::uint32_t loaded_word(std::uint32_t address) const {
    std::uint32_t word = 0;
    for (std::uint32_t i = 0; i < 4; ++i) word |= std::uint32_t{loaded_.at(address + i)} << (8 * i);
    return word;
  }
  [[nodiscard]] std::uint32_t entry() const { return entry_; }

 private:
  template <class T>
  [[nodiscard]] T at(std::size_t offset) const {
    if (offset + sizeof(T) > bytes_.size()) throw std::runtime_error("an ELF file that is cut short");
    T value{};
    std::memcpy(&value, bytes_.data() + offset, sizeof(T));
    return value;
  }
  [[nodiscard]] std::string text(std::size_t offset) const {
    return offset < bytes_.size() ? std::string(bytes_.data() + offset) : std::string();
  }
  // Loads the sections in the segment; gaps between them are skipped.
  void load(const Elf32_Phdr& segment, const std::vector<Elf32_Shdr>& sections) {
    for (const Elf32_Shdr& section : sections) {
      const bool inside = section.sh_offset >= segment.p_offset &&
                          section.sh_offset + section.sh_size <= segment.p_offset + segment.p_filesz;
      if (!inside || section.sh_type == SHT_NOBITS || (section.sh_flags & SHF_ALLOC) == 0) continue;
      const std::uint32_t address = segment.p_paddr + section.sh_offset - segment.p_offset;
      for (std::uint32_t k = 0; k < section.sh_size; ++k) {
        loaded_[address + k] = at<std::uint8_t>(section.sh_offset + k);
      }
    }
  }
  void read_symbols(const Elf32_Shdr& table, const Elf32_Shdr& names) {
    for (std::uint32_t i = 0; i < table.sh_size / table.sh_entsize; ++i) {
      const auto symbol = at<Elf32_Sym>(table.sh_offset + i * table.sh_entsize);
      if (symbol.st_shndx != SHN_UNDEF) symbols_[text(names.sh_offset + symbol.st_name)] = symbol.st_value;
    }
  }

  std::string bytes_;
  std::uint32_t entry_ = 0;
  std::map<std::string, Section> sections_;
  std::map<std::string, std::uint32_t> symbols_;
  std::map<std::uint32_t, std::uint8_t> loaded_;
};

}  // namespace groma::test
