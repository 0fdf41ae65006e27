// SPDX-License-Identifier: Apache-2.0
//
// The cells around a vehicle that drives through the demo's town, kept current.

#include <cstdio>
#include <shmmap/shmmap.hpp>

int main() try {
  shmmap::Window window(shmmap::Client{}, {50.0, {"points"}});
  for (double x = 100.0; x <= 220.0; x += 20.0) {
    const shmmap::WindowUpdate update = window.move_to({x, 160.0, 10.0});  // there, going 10 m/s along x
    const shmmap::PointsAround near = window.points_around(x, 160.0, 20.0);
    std::printf("x %.0f m: %zu cells new, %zu gone, %zu points within 20 m%s\n", x, update.added.size(),
                update.removed.size(), near.count(), near.covered ? "" : ", not all that there are");
  }
} catch (const shmmap::Error& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}
