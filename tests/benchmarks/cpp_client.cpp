// SPDX-License-Identifier: Apache-2.0
// What the client in C++ costs, driven by lines: see tests/benchmarks/cpp_client.py.
//
//   connect ENDPOINT            hold MIN_X MIN_Y MAX_X MAX_Y     map these cells, and keep them; prints how many
//   request COUNT VERSIONS      that many differential requests for the box, with these versions held: nanoseconds of
//                               each, and of those that passed outside of send, poll and recv
//   attach                      release, and map all again: nanoseconds for each cell, from the answer's arrival on
//
// send, poll and recv are this program's own, in front of the C library's: so their time is known.

#include <poll.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <ctime>

namespace {

using Clock = std::chrono::steady_clock;
std::int64_t in_kernel = 0;
Clock::time_point answered;

std::int64_t since(Clock::time_point start) {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - start).count();
}

}  // namespace

extern "C" ssize_t send(int fd, const void* data, size_t size, int flags) {
  const auto start = Clock::now();
  const auto result = ::syscall(SYS_sendto, fd, data, size, flags, nullptr, 0);
  in_kernel += since(start);
  return result;
}

extern "C" ssize_t recv(int fd, void* data, size_t size, int flags) {
  const auto start = Clock::now();
  const auto result = ::syscall(SYS_recvfrom, fd, data, size, flags, nullptr, nullptr);
  in_kernel += since(start);
  return result;
}

extern "C" int poll(pollfd* files, nfds_t count, int timeout_ms) {
  const timespec timeout{timeout_ms / 1000, timeout_ms % 1000 * 1'000'000};
  const auto start = Clock::now();
  const auto result = ::syscall(SYS_ppoll, files, count, timeout_ms < 0 ? nullptr : &timeout, nullptr, 0);
  in_kernel += since(start);
  return static_cast<int>(result);
}

#define SHMMAP_FAILPOINT(label) \
  if (std::string_view(label) == "client.answer") answered = Clock::now()

#include <iostream>
#include <shmmap/shmmap.hpp>
#include <sstream>

int main() {
  std::unique_ptr<shmmap::Client> client;
  shmmap::Box box;
  shmmap::Answer held;
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream words(line);
    std::string what;
    words >> what;
    if (what == "connect") {
      std::string endpoint;
      words >> endpoint;
      client = std::make_unique<shmmap::Client>(shmmap::Options{endpoint, "benchmark", {}, 120.0});
    } else if (what == "hold") {
      words >> box.min_x >> box.min_y >> box.max_x >> box.max_y;
      held = client->area(box, {"points"}, 120.0);
      std::cout << held.cells.size() << " ";
    } else if (what == "box") {
      words >> box.min_x >> box.min_y >> box.max_x >> box.max_y;
    } else if (what == "request") {
      int count = 0;
      words >> count;
      std::vector<std::uint64_t> versions;
      for (std::uint64_t version = 0; words >> version;) versions.push_back(version);
      for (; count > 0; --count) {
        in_kernel = 0;
        const auto start = Clock::now();
        const auto answer = client->differential(box, {}, versions, {"points"}, 10.0);
        const auto all = since(start);
        std::cout << all << " " << all - in_kernel << " " << answer.cells.size() << " ";
      }
    } else if (what == "attach") {
      held = {};
      client->release();
      held = client->area(box, {"points"}, 120.0);
      const auto all = since(answered);
      std::cout << static_cast<double>(all) / static_cast<double>(held.cells.size()) << " ";
    }
    std::cout << std::endl;
  }
}
