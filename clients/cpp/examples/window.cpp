// SPDX-License-Identifier: Apache-2.0
//
// The cells around a vehicle that drives through the demo's town, kept current.

#include <chrono>
#include <cstdio>
#include <shmmap/shmmap.hpp>
#include <thread>

int main() try {
  shmmap::Window window(shmmap::Options{}, {50.0, {"points"}});
  if (!window.wait_until_complete({100.0, 160.0}, 10.0)) std::printf("not all is here yet\n");  // the vehicle stands
  for (double x = 100.0; x <= 220.0; x += 0.1) {  // a control loop: here 100 times a second, at 10 m/s along x
    try {
      const shmmap::WindowUpdate update = window.move_to({x, 160.0, 10.0}, 0.005);  // waits 5 ms at most
      if (update.any())
        std::printf("x %.1f m: %zu cells new, %zu gone\n", x, update.added.size(), update.removed.size());
    } catch (const shmmap::Unreachable& error) {  // the window keeps what it has, and finds the daemon again
      std::fprintf(stderr, "%s\n", error.what());
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  const shmmap::PointsAround near = window.points_around(220.0, 160.0, 20.0);
  std::printf("%zu points within 20 m%s\n", near.count(), near.covered ? "" : ", not all that there are");
} catch (const shmmap::Error& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}
