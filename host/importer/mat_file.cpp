#include "host/importer/mat_file.hpp"

#include <fmt/format.h>
#include <matio.h>

#include <cstdint>
#include <memory>

#include "host/io/error.hpp"
#include "host/io/input_file.hpp"

namespace groma::importer {

namespace {

using MatFile = std::unique_ptr<mat_t, decltype([](mat_t* file) { Mat_Close(file); })>;
using MatArray = std::unique_ptr<matvar_t, decltype([](matvar_t* array) { Mat_VarFree(array); })>;

std::string names_in(mat_t& file) {
  std::string names;
  while (const MatArray array{Mat_VarReadNextInfo(&file)})
    names += fmt::format("{}{}", names.empty() ? "" : ", ", io::escaped(array->name ? array->name : "?"));
  return names;
}

template <typename Number>
std::string format_matrix(const matvar_t& array) {
  std::string text;
  const std::size_t rows = array.dims[0];
  const std::size_t columns = array.dims[1];
  const auto* const numbers = static_cast<const Number*>(array.data);  // column by column
  for (std::size_t row = 0; row < rows; ++row)
    for (std::size_t column = 0; column < columns; ++column)
      text += fmt::format("{}{}", numbers[row + rows * column], column + 1 == columns ? '\n' : ' ');
  return text;
}

// Empty: it is no matrix of real numbers.
std::string format_matrix_of_any(const matvar_t& array) {
  if (array.rank != 2 || array.isComplex != 0 || array.data == nullptr) return {};
  switch (array.class_type) {
    case MAT_C_DOUBLE:
      return format_matrix<double>(array);
    case MAT_C_SINGLE:
      return format_matrix<float>(array);
    case MAT_C_INT8:
      return format_matrix<std::int8_t>(array);
    case MAT_C_UINT8:
      return format_matrix<std::uint8_t>(array);
    case MAT_C_INT16:
      return format_matrix<std::int16_t>(array);
    case MAT_C_UINT16:
      return format_matrix<std::uint16_t>(array);
    case MAT_C_INT32:
      return format_matrix<std::int32_t>(array);
    case MAT_C_UINT32:
      return format_matrix<std::uint32_t>(array);
    case MAT_C_INT64:
      return format_matrix<std::int64_t>(array);
    case MAT_C_UINT64:
      return format_matrix<std::uint64_t>(array);
    default:
      return {};
  }
}

}  // namespace

std::string read_mat_array(const std::filesystem::path& path, const std::string& name) {
  static_cast<void>(io::read_file(path));  // its errors are those of any file
  const MatFile file(Mat_Open(path.c_str(), MAT_ACC_RDONLY));
  if (!file) throw io::DataError({path}, "is no MAT file", "give a file that MATLAB has saved");
  const MatArray array(Mat_VarRead(file.get(), name.c_str()));
  if (!array) {
    Mat_Rewind(file.get());
    throw io::DataError({path}, fmt::format("has no array {}", name),
                        fmt::format("its arrays are {}", names_in(*file)));
  }
  std::string text = format_matrix_of_any(*array);
  if (text.empty())
    throw io::DataError({path}, fmt::format("its array {} is no matrix of real numbers", name),
                        "name another array in the map");
  return text;
}

}  // namespace groma::importer
