// SPDX-License-Identifier: Apache-2.0
// Times octomap::OcTree::insertPointCloud, scan by scan, so that it can take turns with others.
//
// The argument is 1 to have points of one voxel taken together (discretize), else 0.  Lines on stdin are
// "new RESOLUTION", for a new tree, and "insert MAX_RANGE X Y Z FILE", with a file of raw float32 x, y, z in
// the map's frame and the sensor's position there.  The answer to each is the seconds of CPU time it took.

#include <octomap/OcTree.h>

#include <ctime>
#include <fstream>
#include <iostream>
#include <memory>
#include <sstream>
#include <string>

static double cpu() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main(int, char** arguments) {
  const bool discretize = std::string(arguments[1]) == "1";
  std::unique_ptr<octomap::OcTree> tree;
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream words(line);
    std::string what, path;
    double number, took = 0;
    words >> what >> number;
    if (what == "new") {
      tree.reset(new octomap::OcTree(number));
      tree->setProbHit(0.7);
      tree->setProbMiss(0.4);
      tree->setClampingThresMin(0.12);
      tree->setClampingThresMax(0.97);
    } else {
      float x, y, z, point[3];
      words >> x >> y >> z >> path;
      octomap::Pointcloud scan;
      std::ifstream file(path, std::ios::binary);
      while (file.read(reinterpret_cast<char*>(point), sizeof point)) scan.push_back(point[0], point[1], point[2]);
      const double begin = cpu();
      tree->insertPointCloud(scan, octomap::point3d(x, y, z), number, false, discretize);
      took = cpu() - begin;
    }
    std::cout << took << std::endl;
  }
  return 0;
}
