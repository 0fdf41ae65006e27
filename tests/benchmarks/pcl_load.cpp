// SPDX-License-Identifier: Apache-2.0
// Times pcl::io::loadPCDFile over lists of files, on command, so that rounds can be interleaved with others.
//
// Each line on stdin is "blob LIST" or "xyzi LIST", LIST a file with one path per line; the answer is one
// line with the seconds that loading all of them took, and the number of points.

#include <chrono>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

#include <pcl/PCLPointCloud2.h>
#include <pcl/console/print.h>
#include <pcl/io/pcd_io.h>
#include <pcl/point_types.h>

int main() {
  pcl::console::setVerbosityLevel(pcl::console::L_ERROR);
  std::string kind, list;
  while (std::cin >> kind >> list) {
    std::vector<std::string> paths;
    std::ifstream file(list);
    for (std::string path; std::getline(file, path);) paths.push_back(path);
    std::size_t points = 0;
    const auto start = std::chrono::steady_clock::now();
    for (const auto& path : paths) {
      if (kind == "blob") {
        pcl::PCLPointCloud2 cloud;
        if (pcl::io::loadPCDFile(path, cloud) != 0) return 1;
        points += static_cast<std::size_t>(cloud.width) * cloud.height;
      } else {
        pcl::PointCloud<pcl::PointXYZI> cloud;
        if (pcl::io::loadPCDFile(path, cloud) != 0) return 1;
        points += cloud.size();
      }
    }
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - start;
    std::cout << took.count() << ' ' << points << std::endl;
  }
  return 0;
}
