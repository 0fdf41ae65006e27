// SPDX-License-Identifier: Apache-2.0
// A scan matcher's map along a drive: voxels around the vehicle as leaves of Autoware's shape, computed once
// per machine.  What comes is added first, and what is left behind removed after, as Autoware's map update
// does it.
//
//   cd clients/cpp
//   g++ -O2 -Iinclude $(pkg-config --cflags eigen3) examples/ndt_leaves.cpp -o ndt_leaves
//   ./ndt_leaves 100 240 160 50   # drives along x from 100 m to 240 m at y = 160 m; 50 m around the vehicle

#include <Eigen/Core>
#include <cstdio>
#include <shmmap/autoware.hpp>

/// As `pclomp::MultiVoxelGridCovariance<PointT>::Leaf`.
struct Leaf {
  int nr_points_ = 0;
  Eigen::Vector3d mean_ = Eigen::Vector3d::Zero();
  Eigen::VectorXf centroid_;
  Eigen::Matrix3d icov_ = Eigen::Matrix3d::Zero();
};

/// As `autoware_map_msgs::srv::GetDifferentialPointCloudMap::Request`.
struct Request {
  struct {
    float center_x = 0.0F, center_y = 0.0F, radius = 0.0F;
  } area;
  std::vector<std::string> cached_ids;
};

int main(int count, char** words) {
  if (count != 5) {
    std::fprintf(stderr, "usage: ndt_leaves FROM_X TO_X Y RADIUS\n");
    return 2;
  }
  const float from = std::stof(words[1]), to = std::stof(words[2]), step = 20.0F;
  shmmap::LoaderOptions options;
  options.wait = 60.0;  // the first request for a kind of layer on a machine compiles its kernel
  options.log = [](const std::string& message) { std::fprintf(stderr, "%s\n", message.c_str()); };
  const shmmap::NdtLeaves<Leaf> leaves(2.0, options);
  std::map<std::string, std::vector<Leaf>> grids;
  for (float x = from; x <= to; x += step) {
    Request request;
    request.area = {x, std::stof(words[3]), std::stof(words[4])};
    for (const auto& [id, grid] : grids) request.cached_ids.push_back(id);
    auto update = leaves(&request);
    if (!update) return 1;
    for (auto& grid : update->grids_to_add) grids[grid.cell_id] = std::move(grid.leaves);
    for (const auto& id : update->ids_to_remove) grids.erase(id);
    std::size_t voxels = 0, points = 0;
    for (const auto& [id, grid] : grids) {
      voxels += grid.size();
      for (const Leaf& leaf : grid) points += static_cast<std::size_t>(std::max(leaf.nr_points_, 0));
    }
    std::printf("x %g: %zu added, %zu removed; %zu cells, %zu voxels of %zu points\n", static_cast<double>(x),
                update->grids_to_add.size(), update->ids_to_remove.size(), grids.size(), voxels, points);
  }
}
