// SPDX-License-Identifier: Apache-2.0
// The area search of Autoware's map loader, for comparison: a linear pass over a std::map of cells
// with cylinder_and_box_overlap_exists (autoware_map_loader, utils.cpp), on a square grid of cells.
//
//   autoware_area_search SIDE RADIUS QUERIES  ->  median microseconds, mean cells found, resident kB
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <random>
#include <string>
#include <vector>

struct Box { float min_x, min_y, max_x, max_y; };

static bool overlaps(double x, double y, double r, const Box & b)
{
  if (b.min_x - r <= x && x <= b.max_x + r && b.min_y - r <= y && y <= b.max_y + r) return true;
  const bool corner = std::hypot(x - b.min_x, y - b.min_y) <= r || std::hypot(x - b.min_x, y - b.max_y) <= r ||
                      std::hypot(x - b.max_x, y - b.max_y) <= r || std::hypot(x - b.max_x, y - b.min_y) <= r;
  return corner;
}

static long resident_kb()
{
  char line[256];
  long kb = 0;
  if (FILE * f = std::fopen("/proc/self/status", "r")) {
    while (std::fgets(line, sizeof line, f))
      if (!std::strncmp(line, "VmRSS:", 6)) kb = std::atol(line + 6);
    std::fclose(f);
  }
  return kb;
}

int main(int argc, char ** argv)
{
  if (argc != 4) return 2;
  const int side = std::atoi(argv[1]), queries = std::atoi(argv[3]);
  const float radius = std::atof(argv[2]);
  std::map<std::string, Box> cells;
  for (int x = 0; x < side; ++x)
    for (int y = 0; y < side; ++y) {
      const int cx = x * 20, cy = y * 20;
      cells["/maps/city/pointcloud_map.pcd/city_" + std::to_string(cx) + "_" + std::to_string(cy) + ".pcd"] =
        Box{float(cx), float(cy), float(cx + 20), float(cy + 20)};
    }
  std::mt19937 random(1);
  std::uniform_real_distribution<float> place(0.2f * side * 20, 0.8f * side * 20);
  std::vector<double> micros;
  size_t found = 0;
  for (int q = 0; q < queries; ++q) {
    const float x = place(random), y = place(random);
    const auto start = std::chrono::steady_clock::now();
    std::vector<std::string> ids;
    for (const auto & cell : cells)
      if (overlaps(x, y, radius, cell.second)) ids.push_back(cell.first);
    micros.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start).count());
    found += ids.size();
  }
  std::nth_element(micros.begin(), micros.begin() + queries / 2, micros.end());
  std::printf("%.3f %.1f %ld\n", micros[queries / 2], double(found) / queries, resident_kb());
}
