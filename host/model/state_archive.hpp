// The state of an estimator as bytes, for the same build of the program only: a class lists the members that
// change, once for both directions.
//
//   void archive(model::StateArchive& state) { state(t_s_, core_, waiting_); }
//
//   std::string bytes;
//   model::StateArchive(bytes).operator()(filter);              // writes
//   model::StateArchive(std::string_view(bytes))(other_filter);  // reads
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <string>
#include <string_view>
#include <type_traits>

namespace groma::model {

class StateArchive {
 public:
  // The bytes are not a state of this build, or not a whole one.
  struct Mismatch : std::exception {};

  // Appends to `out`.
  explicit StateArchive(std::string& out) noexcept : out_(&out) {}
  // Reads. A number of elements that a mismatch makes absurd is found before anything is allocated for them.
  explicit StateArchive(std::string_view in) noexcept : in_(in) {}

  [[nodiscard]] bool reads() const noexcept { return out_ == nullptr; }
  // All was read.
  [[nodiscard]] bool at_end() const noexcept { return in_.empty(); }

  // Objects with archive(), strings, vectors, matrices of dynamic size, and flat objects: those that own no
  // memory and hold no pointer, which are copied byte by byte. Throws Mismatch when it reads.
  template <class... Objects>
  void operator()(Objects&... objects) {
    (transfer(objects), ...);
  }

 private:
  template <class Object>
  static constexpr bool kIsFlat = std::is_trivially_destructible_v<Object> && !std::is_pointer_v<Object> &&
                                  !std::is_same_v<Object, std::string_view>;

  template <class Object>
  void transfer(Object& object) {
    if constexpr (requires { object.archive(*this); }) {
      object.archive(*this);
    } else if constexpr (kIsFlat<Object>) {
      transfer_bytes(&object, sizeof(Object));
    } else if constexpr (requires { object.rows(); }) {
      transfer_matrix(object);
    } else {
      transfer_list(object);
    }
  }

  template <class Matrix>
  void transfer_matrix(Matrix& matrix) {
    const auto rows = transfer_count(static_cast<std::size_t>(matrix.rows()), 1);
    const auto columns = transfer_count(static_cast<std::size_t>(matrix.cols()), 1);
    if (reads() && rows * columns > in_.size()) throw Mismatch();
    if (reads()) matrix.resize(static_cast<std::ptrdiff_t>(rows), static_cast<std::ptrdiff_t>(columns));
    transfer_bytes(matrix.data(), sizeof(*matrix.data()) * rows * columns);
  }

  template <class List>
  void transfer_list(List& list) {
    using Element = typename List::value_type;
    const std::size_t count = transfer_count(list.size(), kIsFlat<Element> ? sizeof(Element) : 1);
    if (reads()) list.resize(count);
    if constexpr (kIsFlat<Element>) {
      transfer_bytes(list.data(), sizeof(Element) * count);
    } else {
      for (Element& element : list) transfer(element);
    }
  }

  // element_size: of one element at least.
  [[nodiscard]] std::size_t transfer_count(std::size_t count, std::size_t element_size) {
    std::uint64_t value = count;
    transfer_bytes(&value, sizeof(value));
    if (reads() && value > in_.size() / element_size) throw Mismatch();
    return static_cast<std::size_t>(value);
  }

  // The size goes along, so that members of other sizes are found.
  void transfer_bytes(void* data, std::size_t size) {
    std::uint64_t stored = size;
    if (!reads()) {
      out_->append(reinterpret_cast<const char*>(&stored), sizeof(stored));
      out_->append(static_cast<const char*>(data), size);
      return;
    }
    take(&stored, sizeof(stored));
    if (stored != size) throw Mismatch();
    take(data, size);
  }

  void take(void* data, std::size_t size) {
    if (in_.size() < size) throw Mismatch();
    if (size > 0) std::memcpy(data, in_.data(), size);
    in_.remove_prefix(size);
  }

  std::string* out_ = nullptr;
  std::string_view in_;
};

}  // namespace groma::model
