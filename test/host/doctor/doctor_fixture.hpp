// groma as a process beside a gromad and a simulated site.
#pragma once

#include <atomic>
#include <chrono>
#include <string>
#include <thread>
#include <vector>

#include "host/link/listening_socket.hpp"
#include "test/host/daemon/gromad_fixture.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::daemon {

class DoctorTest : public GromadTest {
 protected:
  // With `more` at its end; the servers have ports that are free now.
  std::filesystem::path write_config(const std::string& calibration, const std::string& more = "") {
    std::string text = config_text(calibration);
    const std::string none = "port: 0";
    text.replace(text.find(none), none.size(), "port: " + std::to_string(stream_port_));
    return folder_.write("gromad.yaml", text + more);
  }
  // A program with the site going on until it ends.
  static groma::test::ChildResult run_beside(SimulatedSite& site, const std::vector<std::string>& arguments) {
    std::atomic<bool> done = false;
    std::thread clock([&] {
      while (!done) {
        site.step();
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
      }
    });
    groma::test::ChildResult result = groma::test::run_child(arguments);
    done = true;
    clock.join();
    return result;
  }

  static std::uint16_t free_port() {
    const link::ListeningSocket socket = link::listen_at("127.0.0.1", 0, SOCK_STREAM, 1);
    sockaddr_in address{};
    socklen_t size = sizeof(address);
    if (::getsockname(socket.fd.get(), reinterpret_cast<sockaddr*>(&address), &size) != 0) {
      throw std::runtime_error("getsockname");
    }
    return ntohs(address.sin_port);
  }

  std::uint16_t stream_port_ = free_port();
};

}  // namespace groma::daemon
