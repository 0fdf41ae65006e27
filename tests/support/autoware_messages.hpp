// SPDX-License-Identifier: Apache-2.0
// Autoware's services for cells of the map, with members named as ROS 2's generator names them, without ROS.

#ifndef TESTS_SUPPORT_AUTOWARE_MESSAGES_HPP
#define TESTS_SUPPORT_AUTOWARE_MESSAGES_HPP

#include <cstdint>
#include <string>
#include <vector>

namespace plain {

struct Header {
  struct {
    std::int32_t sec = 0;
    std::uint32_t nanosec = 0;
  } stamp;
  std::string frame_id;
};
struct Field {
  std::string name;
  std::uint32_t offset = 0;
  std::uint8_t datatype = 0;
  std::uint32_t count = 0;
};
struct Cloud {
  Header header;
  std::uint32_t height = 0, width = 0;
  std::vector<Field> fields;
  bool is_bigendian = false;
  std::uint32_t point_step = 0, row_step = 0;
  std::vector<std::uint8_t> data;
  bool is_dense = false;
};
struct Cell {
  std::string cell_id;
  Cloud pointcloud;
  struct {
    float min_x = 0, min_y = 0, max_x = 0, max_y = 0;
  } metadata;
};
struct Request {
  struct {
    float center_x = 0, center_y = 0, radius = 0;
  } area;
  std::vector<std::string> cached_ids;
};
struct Response {
  Header header;
  std::vector<Cell> new_pointcloud_with_ids;
  std::vector<std::string> ids_to_remove;
};
struct Service {
  using Request = plain::Request;
  using Response = plain::Response;
};

/// Its `GetPartialPointCloudMap`.
struct Partial {
  struct Request {
    decltype(plain::Request::area) area;
  };
  struct Response {
    Header header;
    std::vector<Cell> new_pointcloud_with_ids;
  };
};

/// Its `GetSelectedPointCloudMap`.
struct Selected {
  struct Request {
    std::vector<std::string> cell_ids;
  };
  using Response = Partial::Response;
};

}  // namespace plain

#endif  // TESTS_SUPPORT_AUTOWARE_MESSAGES_HPP
