// SPDX-License-Identifier: Apache-2.0
// What Autoware's scan matcher does with its `PcdLoaderFunction`, a line at a time; words are separated by
// tabs.
//
//   loader ENDPOINT WAIT TIMEOUT [MAX_BYTES [plain]]
//                                     a new PcdLoader, a new NdtLeaves; the node holds what it held
//   update X Y RADIUS                 as the node's `update_ndt`: ids held, then add, then remove
//   held                              ids and checksums of points that the node holds: of cells that came under
//                                     one id the first, as in Autoware's compare filter
//   ask X Y RADIUS IDS                with these ids, separated by ";"; what comes is not taken over
//   service X Y RADIUS IDS            the same as a service asks
//   name ID VERSION, split NAME       names of cells, and what they stand for
//   const X Y RADIUS                  as `update`, by a function that returns a pointer to const
//   grids X Y RADIUS                  as `update`, with voxels; `leaves` prints what is held
//   forget                            the node begins again, as on a rebuild
//   refused                           leaves of a cell that has a voxel without an inverse covariance
//   crooked                           of one whose columns do not belong together
//
// The answer ends with a line "end".  With SHMMAP_GENERATED the types are ROS 2's, else they are written out
// here.

#include <cstdio>
#include <iostream>
#include <shmmap/autoware.hpp>

#ifdef SHMMAP_GENERATED
#include <autoware_map_msgs/srv/get_differential_point_cloud_map.hpp>

using Service = autoware_map_msgs::srv::GetDifferentialPointCloudMap;
#else
#include "autoware_messages.hpp"

using plain::Service;
#endif

namespace {

using Request = Service::Request;
using Response = Service::Response;

/// Autoware's leaf, without Eigen.
struct Leaf {
  struct Matrix {
    std::array<double, 9> values{};
    double& operator()(int row, int column) { return values[static_cast<std::size_t>(3 * row + column)]; }
  };
  struct Vector {
    std::array<double, 3> values{};
    double& operator[](int axis) { return values[static_cast<std::size_t>(axis)]; }
  };
  struct Centroid {
    std::vector<float> values;
    void resize(int size) { values.resize(static_cast<std::size_t>(size)); }
    float& operator[](int axis) { return values[static_cast<std::size_t>(axis)]; }
  };
  int nr_points_ = 0;
  Vector mean_;
  Centroid centroid_;
  Matrix icov_;
};

std::function<std::shared_ptr<Response>(const std::shared_ptr<Request>&)> loader;
std::function<std::shared_ptr<const Response>(const std::shared_ptr<Request>&)> loader_of_const;
std::unique_ptr<shmmap::NdtLeaves<Leaf>> leaves;
std::function<std::shared_ptr<Response>(const std::shared_ptr<Request>&)> service;
std::map<std::string, std::uint32_t> clouds;  // checksums by id
std::map<std::string, std::vector<Leaf>> grids;

void make(const std::vector<std::string>& words) {
  shmmap::LoaderOptions options;
  options.client.endpoint = words.at(1);
  options.client.name = "node";
  options.wait = std::stod(words.at(2));
  options.client.timeout = std::stod(words.at(3));
  options.log = [](const std::string& message) {
    std::cout << "log\t" << message << "\n";
    throw std::runtime_error("logging may fail");
  };
  if (words.size() > 4) options.max_bytes = std::stoull(words[4]);
  options.plain_ids = words.size() > 5 && words[5] == "plain";
  const shmmap::PcdLoader<Service> made(options);
  loader = made;
  loader_of_const = made;
  service = [services = shmmap::MapServices(options)](const std::shared_ptr<Request>& request) {
    shmmap::Shortfall lacks;
    auto response = services.answer<Service>(*request, lacks);
    if (!lacks.why.empty()) std::cout << "log\t" << lacks.why << "\n";
    return response;
  };
  leaves = std::make_unique<shmmap::NdtLeaves<Leaf>>(2.0, options);
}

std::shared_ptr<Request> request_for(const std::vector<std::string>& words,
                                     const std::vector<std::string>& held) {
  auto request = std::make_shared<Request>();
  request->area.center_x = std::stof(words.at(1));
  request->area.center_y = std::stof(words.at(2));
  request->area.radius = std::stof(words.at(3));
  request->cached_ids = held;
  return request;
}

template <typename Cloud>
std::uint32_t checksum(const Cloud& cloud) {
  return shmmap::detail::crc32(cloud.data.data(), cloud.data.size());
}

void print(const Response& response) {
  const auto& header = response.header;
  std::cout << "header\t" << header.frame_id << "\t" << header.stamp.sec << "\t" << header.stamp.nanosec
            << "\n";
  for (const auto& cell : response.new_pointcloud_with_ids) {
    const auto& cloud = cell.pointcloud;
    const auto& box = cell.metadata;
    std::cout << "cell\t" << cell.cell_id << "\t" << box.min_x << " " << box.min_y << " " << box.max_x << " "
              << box.max_y << "\t" << cloud.height << " " << cloud.width << " " << cloud.point_step << " "
              << cloud.row_step << " " << cloud.is_bigendian << cloud.is_dense << cloud.header.frame_id
              << "\t";
    for (const auto& field : cloud.fields)
      std::cout << field.name << ":" << field.offset << ":" << unsigned{field.datatype} << ":" << field.count
                << " ";
    std::cout << "\t" << checksum(cloud) << "\n";
  }
  for (const auto& id : response.ids_to_remove) std::cout << "remove\t" << id << "\n";
}

/// Take over what came: add first, remove after.
template <typename Pointer>
void take(const Pointer& response) {
  if (!response) {
    std::cout << "nullptr\n";
    return;
  }
  print(*response);
  for (const auto& cell : response->new_pointcloud_with_ids)
    clouds.insert({cell.cell_id, checksum(cell.pointcloud)});
  for (const auto& id : response->ids_to_remove) clouds.erase(id);
}

void take_grids(const std::shared_ptr<Request>& request) {
  auto update = (*leaves)(request);
  if (!update) {
    std::cout << "nothing\n";
    return;
  }
  for (auto& grid : update->grids_to_add) {
    std::cout << "grid\t" << grid.cell_id << "\t" << grid.leaves.size() << "\n";
    grids[grid.cell_id] = std::move(grid.leaves);
  }
  for (const auto& id : update->ids_to_remove) {
    std::cout << "remove\t" << id << "\n";
    grids.erase(id);
  }
}

void print_leaves() {
  for (auto& [id, voxels] : grids) {
    std::string bytes;
    for (auto& leaf : voxels) {
      bytes.append(reinterpret_cast<const char*>(&leaf.nr_points_), sizeof leaf.nr_points_);
      bytes.append(reinterpret_cast<const char*>(&leaf.mean_), sizeof leaf.mean_);
      bytes.append(reinterpret_cast<const char*>(leaf.centroid_.values.data()), 4 * sizeof(float));
      bytes.append(reinterpret_cast<const char*>(&leaf.icov_), sizeof leaf.icov_);
    }
    const auto* data = reinterpret_cast<const unsigned char*>(bytes.data());
    std::cout << id << "\t" << voxels.size() << "\t" << shmmap::detail::crc32(data, bytes.size()) << "\n";
  }
}

/// A cell of two voxels, made by hand.
shmmap::Cell two_voxels(const std::array<double, 6>& mean, const std::array<double, 12>& inverse,
                        const std::array<std::uint32_t, 2>& count) {
  shmmap::Cell cell;
  cell.id = "made by hand";
  cell.origin = {1000.0, 0.0, 0.0};
  cell.columns.push_back({"mean", "<f8", "m", {2, 3}, mean.data(), 48, 0});
  cell.columns.push_back({"inverse_covariance", "<f8", "1/m^2", {2, 6}, inverse.data(), 96, 0});
  cell.columns.push_back({"count", "<u4", "", {2}, count.data(), 8, 0});
  return cell;
}

void print_made(bool crooked) {
  const std::array<double, 6> mean{1, 2, 3, 4, 5, 6};
  const std::array<double, 12> inverse{1, 2, 3, 4, 5, 6};
  const std::array<std::uint32_t, 2> count{7, 8};
  auto cell = two_voxels(mean, inverse, count);
  if (crooked) {
    cell.columns.back().shape = {1};
    cell.columns.back().nbytes = 4;
  }
  try {
    for (auto& leaf : shmmap::ndt_leaves<Leaf>(cell)) {
      std::cout << leaf.nr_points_;
      for (const double value : leaf.mean_.values) std::cout << " " << value;
      for (const float value : leaf.centroid_.values) std::cout << " " << value;
      for (const double value : leaf.icov_.values) std::cout << " " << value;
      std::cout << "\n";
    }
  } catch (const shmmap::Error& error) {
    std::cout << error.code() << "\n";
  }
}

std::vector<std::string> split(const std::string& text, char at) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, at);) parts.push_back(part);
  return parts;
}

template <typename Value>
std::vector<std::string> keys(const std::map<std::string, Value>& from) {
  std::vector<std::string> found;
  for (const auto& [key, value] : from) found.push_back(key);
  return found;
}

void obey(const std::vector<std::string>& words) {
  const auto& what = words.at(0);
  if (what == "loader") {
    make(words);
  } else if (what == "update") {
    take(loader(request_for(words, keys(clouds))));
  } else if (what == "const") {
    take(loader_of_const(request_for(words, keys(clouds))));
  } else if (what == "held") {
    for (const auto& [id, crc] : clouds) std::cout << id << "\t" << crc << "\n";
  } else if (what == "name") {
    std::cout << shmmap::versioned_id(words.at(1), std::stoull(words.at(2))) << "\n";
  } else if (what == "split") {
    const auto [id, version] = shmmap::split_id(words.at(1));
    std::cout << id << "\t" << (version ? std::to_string(*version) : "none") << "\n";
  } else if (what == "ask" || what == "service") {
    const auto request = request_for(words, words.size() > 4 ? split(words[4], ';') : std::vector<std::string>());
    const auto response = what == "ask" ? loader(request) : service(request);
    if (response)
      print(*response);
    else
      std::cout << "nullptr\n";
  } else if (what == "grids") {
    take_grids(request_for(words, keys(grids)));
  } else if (what == "leaves") {
    print_leaves();
  } else if (what == "refused" || what == "crooked") {
    print_made(what == "crooked");
  } else if (what == "forget") {
    clouds.clear();
    grids.clear();
  } else {
    std::cout << "unknown\t" << what << "\n";
  }
}

}  // namespace

int main() {
  for (std::string line; std::getline(std::cin, line);) {
    obey(split(line, '\t'));
    std::cout << "end" << std::endl;
  }
}
