#include "host/daemon/file_writer.hpp"

#include <chrono>
#include <utility>

#include "host/io/error.hpp"
#include "host/io/output_file.hpp"

namespace groma::daemon {

bool FileWriter::busy() const {
  return error_.valid() && error_.wait_for(std::chrono::seconds(0)) != std::future_status::ready;
}

std::optional<std::string> FileWriter::finish() {
  return error_.valid() ? std::optional(error_.get()) : std::nullopt;
}

void FileWriter::start(std::filesystem::path path, std::string text) {
  error_ = std::async(std::launch::async, [path = std::move(path), text = std::move(text)] {
    try {
      io::write_file(path, text);
    } catch (const io::Error& error) {
      return std::string(error.what());
    }
    return std::string();
  });
}

}  // namespace groma::daemon
