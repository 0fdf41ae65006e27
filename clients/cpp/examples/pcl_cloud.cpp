// SPDX-License-Identifier: Apache-2.0
// The points around a place as a cloud of PCL's: one copy, out of shared memory.
//
//   cd clients/cpp
//   g++ -O2 -Iinclude $(pkg-config --cflags pcl_common) examples/pcl_cloud.cpp -o pcl_cloud -lpcl_common
//   ./pcl_cloud 160 160 50        # X Y RADIUS, metres, in the map's frame

#include <pcl/common/common.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>

#include <cstdio>
#include <shmmap/shmmap.hpp>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

/// Copy the points of all cells.  PCL's points have 16 bytes, those in shared memory 12: a cloud cannot be a
/// view.
Cloud::Ptr cloud_of(const std::vector<shmmap::CellPtr>& cells) {
  std::size_t points = 0;
  for (const auto& cell : cells) points += static_cast<std::size_t>(cell->rows);
  auto cloud = pcl::make_shared<Cloud>();
  cloud->resize(points);
  auto to = cloud->begin();
  for (const auto& cell : cells) {
    const auto xyz = cell->column<float>("xyz");
    for (std::size_t row = 0; row < xyz.rows(); ++row, ++to)
      std::memcpy(to->data, xyz[row], 3 * sizeof(float));
    cloud->header.frame_id = cell->frame_id;
  }
  return cloud;
}

int main(int count, char** words) {
  if (count != 4) {
    std::fprintf(stderr, "usage: pcl_cloud X Y RADIUS\n");
    return 2;
  }
  try {
    shmmap::Client client;  // finds the daemon as `shmmap status` does
    const shmmap::Circle around{std::stod(words[1]), std::stod(words[2]), std::stod(words[3])};
    const auto answer = client.area(around);
    for (const auto& failure : answer.failed)
      std::fprintf(stderr, "%s: %s\n", failure.id.c_str(), failure.message.c_str());
    for (const auto& [id, layer] : answer.pending)
      std::fprintf(stderr, "%s: still being loaded\n", id.c_str());
    const auto cloud = cloud_of(answer.cells);
    std::printf("%zu cells, %zu points in frame %s\n", answer.cells.size(), cloud->size(),
                cloud->header.frame_id.c_str());
    if (!cloud->empty()) {
      pcl::PointXYZ low, high;
      pcl::getMinMax3D(*cloud, low, high);
      std::printf("from %.9g %.9g %.9g to %.9g %.9g %.9g\n", low.x, low.y, low.z, high.x, high.y, high.z);
    }
    return answer.failed.empty() && answer.pending.empty() ? 0 : 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "pcl_cloud: %s\n", error.what());
    return 1;
  }
}
