// SPDX-License-Identifier: Apache-2.0
// Times pcl::VoxelGridCovariance's statistics, on command, so that rounds can be interleaved with others.
//
// Each line on stdin is "LEAF FILE...": FILEs of raw float32 x, y, z.  The answer is one line with the
// seconds of CPU time that the statistics of all of them took (no search tree), and the number of voxels.

#include <ctime>
#include <fstream>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include <pcl/console/print.h>
#include <pcl/filters/voxel_grid_covariance.h>
#include <pcl/point_types.h>

static double cpu() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main() {
  pcl::console::setVerbosityLevel(pcl::console::L_ERROR);
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream words(line);
    float leaf;
    words >> leaf;
    std::vector<pcl::PointCloud<pcl::PointXYZ>::Ptr> clouds;
    for (std::string path; words >> path;) {
      std::ifstream file(path, std::ios::binary);
      auto cloud = pcl::make_shared<pcl::PointCloud<pcl::PointXYZ>>();
      float xyz[3];
      while (file.read(reinterpret_cast<char*>(xyz), sizeof xyz)) cloud->emplace_back(xyz[0], xyz[1], xyz[2]);
      clouds.push_back(cloud);
    }
    std::size_t voxels = 0;
    double took = 0;
    for (const auto& cloud : clouds) {
      const double start = cpu();
      pcl::VoxelGridCovariance<pcl::PointXYZ> grid;
      grid.setLeafSize(leaf, leaf, leaf);
      grid.setInputCloud(cloud);
      grid.filter(false);
      took += cpu() - start;
      voxels += grid.getLeaves().size();
    }
    std::cout << took << ' ' << voxels << std::endl;
  }
  return 0;
}
