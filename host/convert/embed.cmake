# Writes the bytes of the file ${descriptors} into ${source}, as the function protobuf_schemas().
file(READ ${descriptors} bytes HEX)
string(REGEX REPLACE "(................................)" "\\1\n" bytes "${bytes}")
string(REGEX REPLACE "([0-9a-f][0-9a-f])" "\\\\x\\1" bytes "${bytes}")
string(REPLACE "\n" "\"\n    \"" bytes "${bytes}")
file(
  WRITE ${source}
  "#include \"host/convert/schemas.hpp\"

namespace groma::convert {

std::string_view protobuf_schemas() {
  static constexpr char kBytes[] =
    \"${bytes}\";
  return {kBytes, sizeof kBytes - 1};
}

}  // namespace groma::convert
"
)
