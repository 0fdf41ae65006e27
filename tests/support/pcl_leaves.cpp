// SPDX-License-Identifier: Apache-2.0
// Leaves of the `ndt` layer beside leaves that PCL's voxel grid builds from the points of the same cells.
// Usage: pcl_leaves ENDPOINT X Y RADIUS LEAF; each line of stdin is answered by lines of JSON.
//   compare    a line for each cell: leaves of both, and the largest differences
//   clouds     a line for each cell: whether its message is to the byte what PCL reads from its file
//   time       one round: ms of processor time for the leaves of all cells; ms until a request for them, or
//   for
//              points, is answered; ms for PCL to read the points from the cells' files
// The last line of an answer is empty.

#include <pcl/console/print.h>
#include <pcl/filters/voxel_grid_covariance.h>
#include <pcl/io/pcd_io.h>
#include <pcl/point_types.h>

#include <Eigen/Dense>
#include <cstdio>
#include <ctime>
#include <iostream>
#include <shmmap/autoware.hpp>

#include "autoware_messages.hpp"

namespace {

/// Members as in Autoware's `pclomp::MultiVoxelGridCovariance<PointT>::Leaf`.
struct Leaf {
  int nr_points_ = 0;
  Eigen::Vector3d mean_ = Eigen::Vector3d::Zero();
  Eigen::VectorXf centroid_;
  Eigen::Matrix3d cov_ = Eigen::Matrix3d::Identity(), icov_ = Eigen::Matrix3d::Zero();
};

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

struct Grid : pcl::VoxelGridCovariance<pcl::PointXYZ> {
  Grid(const Cloud::Ptr& cloud, float leaf) {
    setLeafSize(leaf, leaf, leaf);
    setInputCloud(cloud);
  }
};

Cloud::Ptr cloud_of(const shmmap::Cell& cell) {
  const auto xyz = cell.column<float>("xyz");
  auto cloud = pcl::make_shared<Cloud>();
  cloud->reserve(xyz.rows());
  for (std::size_t row = 0; row < xyz.rows(); ++row)
    cloud->emplace_back(xyz[row][0], xyz[row][1], xyz[row][2]);
  return cloud;
}

/// The inverse covariance in Autoware's convention, (S + I) / (n - 1), out of PCL's S / (n - 1): the least
/// eigenvalues are raised as there.  Zero where Autoware refuses the voxel.
Eigen::Matrix3d inverse_of(const Eigen::Matrix3d& covariance, int points) {
  const Eigen::Matrix3d ours = covariance + Eigen::Matrix3d::Identity() / (points - 1);
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(ours);
  Eigen::Vector3d values = solver.eigenvalues();
  if (values[0] < 0 || values[1] < 0 || values[2] <= 0) return Eigen::Matrix3d::Zero();
  const double least = 0.01 * values[2];
  if (values[0] >= least) return ours.inverse();
  values[0] = least;
  values[1] = std::max(values[1], least);
  const Eigen::Matrix3d& vectors = solver.eigenvectors();
  return (vectors * values.asDiagonal() * vectors.transpose()).inverse();
}

void compare(const shmmap::Cell& points, const shmmap::Cell& ndt, float leaf) {
  Grid grid(cloud_of(points), leaf);
  grid.setCovEigValueInflationRatio(0.0);  // covariances as they are
  grid.filter(false);
  const auto ours = shmmap::ndt_leaves<Leaf>(ndt);
  std::size_t theirs = 0, counts = 0, refused = 0;
  double mean = 0, centroid = 0, inverse = 0;
  for (auto& [index, one] : grid.getLeaves()) {
    if (one.nr_points == -1)
      ++refused;
    else if (one.nr_points < 6)
      continue;
    if (theirs < ours.size() && one.nr_points != -1) {
      const Leaf& mine = ours[theirs];
      const Eigen::Matrix3d expected = inverse_of(one.cov_, one.nr_points);
      counts += mine.nr_points_ != one.nr_points;
      mean = std::max(mean, (mine.mean_ - one.mean_).cwiseAbs().maxCoeff());
      centroid =
          std::max(centroid, static_cast<double>((mine.centroid_.head<3>() - one.centroid.head<3>()).norm()));
      inverse =
          std::max(inverse, (mine.icov_ - expected).cwiseAbs().maxCoeff() / expected.cwiseAbs().maxCoeff());
    }
    ++theirs;
  }
  std::printf(
      "{\"id\": \"%s\", \"ours\": %zu, \"theirs\": %zu, \"refused\": %zu, \"counts\": %zu, \"mean\": %.3g, "
      "\"centroid\": %.3g, \"inverse\": %.3g}\n",
      ndt.id.c_str(), ours.size(), theirs, refused, counts, mean, centroid, inverse);
}

/// Autoware's loader reads a file by PCL, and passes on what comes of it.
void compare(const plain::Cell& cell) {
  const auto& ours = cell.pointcloud;
  pcl::PCLPointCloud2 theirs;
  const std::string id = shmmap::split_id(cell.cell_id).first;
  if (pcl::io::loadPCDFile(id, theirs) != 0) throw std::runtime_error(id);
  bool fields = ours.fields.size() == theirs.fields.size();
  for (std::size_t at = 0; fields && at < ours.fields.size(); ++at) {
    const auto& one = ours.fields[at];
    const auto& other = theirs.fields[at];
    fields = one.name == other.name && one.offset == other.offset && one.datatype == other.datatype &&
             one.count == other.count;
  }
  const bool layout = ours.height == theirs.height && ours.width == theirs.width &&
                      ours.point_step == theirs.point_step && ours.row_step == theirs.row_step &&
                      ours.is_bigendian == (theirs.is_bigendian != 0) &&
                      ours.is_dense == (theirs.is_dense != 0);
  std::printf("{\"id\": \"%s\", \"points\": %u, \"fields\": %d, \"layout\": %d, \"data\": %d}\n",
              id.c_str(), ours.width, fields, layout, ours.data == theirs.data);
}

double now(clockid_t clock) {
  timespec time{};
  clock_gettime(clock, &time);
  return static_cast<double>(time.tv_sec) * 1e3 + static_cast<double>(time.tv_nsec) * 1e-6;
}

}  // namespace

int main(int count, char** words) {
  if (count != 6) return 2;
  pcl::console::setVerbosityLevel(pcl::console::L_ERROR);
  const float leaf = std::stof(words[5]);
  auto request = std::make_shared<plain::Request>();
  request->area = {std::stof(words[2]), std::stof(words[3]), std::stof(words[4])};
  shmmap::LoaderOptions options;
  options.client.endpoint = words[1];
  options.log = [](const std::string& message) { std::cerr << message << "\n"; };
  const shmmap::NdtLeaves<Leaf> warm(static_cast<double>(leaf), options);
  const shmmap::PcdLoader<plain::Service> loader(options);
  options.wait = 120.0;  // the layer may have to be computed, and its kernel to be compiled
  if (!shmmap::NdtLeaves<Leaf>(static_cast<double>(leaf), options)(request)) return 1;

  shmmap::Client client(options.client);
  const shmmap::Square area = shmmap::detail::area_of(*request);
  const auto points = client.area(area, {"points"}, 120.0).cells;
  const auto ndt = client.area(area, {std::string("ndt(leaf=") + words[5] + ")"}, 120.0).cells;
  std::vector<Cloud::Ptr> clouds;
  for (const auto& cell : points) clouds.push_back(cloud_of(*cell));
  for (std::string what; std::getline(std::cin, what);) {
    if (what == "compare") {
      for (std::size_t at = 0; at < ndt.size(); ++at) compare(*points.at(at), *ndt[at], leaf);
    } else if (what == "clouds") {
      const auto response = loader(request);
      for (const auto& cell : response->new_pointcloud_with_ids) compare(cell);
    } else {
      std::size_t rows = 0, bytes = 0, grids = 0;
      double begin = now(CLOCK_THREAD_CPUTIME_ID);
      {
        std::vector<std::vector<Leaf>> all;
        all.reserve(ndt.size());
        for (const auto& cell : ndt) all.push_back(shmmap::ndt_leaves<Leaf>(*cell));
        const double took = now(CLOCK_THREAD_CPUTIME_ID) - begin;
        for (const auto& one : all) rows += one.size();
        std::printf("{\"cells\": %zu, \"leaves\": %zu, \"ours_ms\": %.6f", all.size(), rows, took);
      }
      begin = now(CLOCK_THREAD_CPUTIME_ID);
      for (const auto& cloud : clouds) {
        Grid grid(cloud, leaf);
        grid.filter(false);
        grids += grid.getLeaves().size();
      }
      std::printf(", \"pcl_ms\": %.6f, \"pcl_voxels\": %zu", now(CLOCK_THREAD_CPUTIME_ID) - begin, grids);
      begin = now(CLOCK_MONOTONIC);
      const auto update = warm(request);  // the node says that it holds nothing: everything comes
      std::printf(", \"leaves_ms\": %.6f, \"grids\": %zu", now(CLOCK_MONOTONIC) - begin,
                  update ? update->grids_to_add.size() : 0);
      begin = now(CLOCK_MONOTONIC);
      auto response = loader(request);
      std::printf(", \"points_ms\": %.6f, \"clouds\": %zu", now(CLOCK_MONOTONIC) - begin,
                  response ? response->new_pointcloud_with_ids.size() : 0);
      response.reset();
      begin = now(CLOCK_MONOTONIC);
      {
        std::vector<pcl::PCLPointCloud2> read(points.size());
        for (std::size_t at = 0; at < read.size(); ++at)
          if (pcl::io::loadPCDFile(points[at]->id, read[at]) != 0) return 1;
        std::printf(", \"files_ms\": %.6f", now(CLOCK_MONOTONIC) - begin);
      }
      for (const auto& cell : ndt)
        bytes += static_cast<std::size_t>(cell->rows) * (3 + 6) * 8 + cell->rows * 4;
      std::printf(", \"bytes\": %zu}\n", bytes);
    }
    std::cout << std::endl;
  }
}
