// The .proto files of the folder schemas, compiled.
#pragma once

#include <string_view>

namespace groma::convert {

// A google.protobuf.FileDescriptorSet with all of them, encoded. The build generates it (protoc).
[[nodiscard]] std::string_view protobuf_schemas();

}  // namespace groma::convert
