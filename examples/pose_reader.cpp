// Prints the poses that gromad serves.
//   pose_reader [PORT] [COUNT]      (4721; 0: until the stream ends)
#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <string>

#include <nlohmann/json.hpp>

int main(int argc, char** argv) {
  const int port = argc > 1 ? std::stoi(argv[1]) : 4721;
  long left = argc > 2 ? std::stol(argv[2]) : 0;
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<std::uint16_t>(port));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  const int stream = socket(AF_INET, SOCK_STREAM, 0);
  if (connect(stream, reinterpret_cast<sockaddr*>(&address), sizeof address) != 0) {
    std::perror("pose_reader: cannot reach gromad");
    return 1;
  }
  std::FILE* lines = fdopen(stream, "r");
  char* line = nullptr;
  std::size_t size = 0;
  while (getline(&line, &size, lines) > 0) {
    const auto message = nlohmann::json::parse(line);
    if (message["class"] != "POSE") continue;  // VERSION, STATUS, CALIBRATION: see docs/reference/gromad.md
    // Use a pose in state TRACKING. Its covariance is 6 x 6, row by row: x, y, z, roll, pitch, yaw (m, rad).
    const auto& covariance = message["covariance"];
    std::printf("%.3f s  %-10s x %.3f m  y %.3f m  yaw %.3f rad  variances %.2g m2  %.2g m2\n",
                message["t_s"].get<double>(), message["state"].get<std::string>().c_str(),
                message["x_m"].get<double>(), message["y_m"].get<double>(), message["yaw_rad"].get<double>(),
                covariance[0].get<double>(), covariance[7].get<double>());
    if (--left == 0) return 0;
  }
  std::fputs("pose_reader: the stream ended\n", stderr);
  return left > 0 ? 1 : 0;
}
