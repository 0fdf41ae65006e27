// SPDX-License-Identifier: Apache-2.0
// How many points the map has around a place, and how high they are:  first_cells X Y RADIUS, in metres.

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <shmmap/shmmap.hpp>

int main(int argc, char** argv) try {
  if (argc != 4) return std::fprintf(stderr, "usage: %s X Y RADIUS\n", argv[0]), 2;
  const shmmap::Circle around{std::atof(argv[1]), std::atof(argv[2]), std::atof(argv[3])};
  std::size_t points = 0;
  float lowest = std::numeric_limits<float>::infinity(), highest = -lowest;

  shmmap::Client client;
  const shmmap::Answer answer = client.area(around);
  for (const shmmap::CellPtr& cell : answer.cells) {
    const auto xyz = cell->column<float>("xyz");  // shared memory: nothing is copied
    points += xyz.rows();
    for (std::size_t row = 0; row < xyz.rows(); ++row) {
      lowest = std::min(lowest, xyz[row][2]);
      highest = std::max(highest, xyz[row][2]);
    }
  }
  std::printf("%zu points in %zu cells; %zu failed, %zu are still being loaded\n", points, answer.cells.size(),
              answer.failed.size(), answer.pending.size());
  if (points != 0)
    std::printf("z from %.2f to %.2f m\n", static_cast<double>(lowest), static_cast<double>(highest));
} catch (const shmmap::Error& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}
