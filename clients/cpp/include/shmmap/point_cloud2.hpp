// SPDX-License-Identifier: Apache-2.0
//
// A cell's points as a ROS message.  Includes no headers of ROS: any type with the members of
// `sensor_msgs/PointCloud2` works as a message.

#ifndef SHMMAP_POINT_CLOUD2_HPP
#define SHMMAP_POINT_CLOUD2_HPP

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

#include <shmmap/cell.hpp>
#include <shmmap/errors.hpp>

namespace shmmap {

namespace detail {

/// A field of `sensor_msgs/PointCloud2`, and its values in shared memory.
struct PointField {
  std::string name;
  std::uint8_t datatype = 0;
  std::uint32_t count = 1, offset = 0;
  const unsigned char* from = nullptr;
  std::size_t bytes = 0;  // of one point
};

/// Number of a dtype in `sensor_msgs/PointField`; 0 if it has none (64-bit integers, 16-bit floats).
inline std::uint8_t datatype_of(std::string_view dtype) {
  constexpr std::array<std::string_view, 8> known{"|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8"};
  for (std::size_t at = 0; at < known.size(); ++at)
    if (known[at] == dtype) return static_cast<std::uint8_t>(at + 1);
  return 0;
}

template <std::size_t bytes>
void spread(const unsigned char* from, std::size_t points, unsigned char* to, std::size_t step) {
  for (; points > 0; --points, from += bytes, to += step) std::memcpy(to, from, bytes);
}

/// Write one field's values into a block of points.
inline void spread(const PointField& field, std::size_t first, std::size_t points, unsigned char* to,
                   std::size_t step) {
  const unsigned char* from = field.from + first * field.bytes;
  to += first * step + field.offset;
  switch (field.bytes) {
    case 1: return spread<1>(from, points, to, step);
    case 2: return spread<2>(from, points, to, step);
    case 4: return spread<4>(from, points, to, step);
    case 8: return spread<8>(from, points, to, step);
    case 12: return spread<12>(from, points, to, step);
    default:
      for (; points > 0; --points, from += field.bytes, to += step) std::memcpy(to, from, field.bytes);
  }
}

/// Coordinates in the map's frame, rounded to 32 bits.
template <typename Value>
void to_map_frame(const Cell& cell, const Values<Value>& xyz, std::vector<float>& xyz32) {
  xyz32.resize(xyz.size());
  for (std::size_t at = 0; at < xyz.size(); ++at) {
    const double relative = xyz.data()[at];
    xyz32[at] = static_cast<float>(relative + cell.origin[at % 3]);
  }
}

/// The fields of a cell's points, x, y, z first, without gaps.  `xyz32` holds converted coordinates: PCL's points
/// have 32 bits, and coordinates of layers are relative to their origin.
inline std::vector<PointField> point_fields(const Cell& cell, std::vector<float>& xyz32) {
  std::vector<PointField> fields;
  std::size_t offset = 0;
  const auto add = [&](const std::string& name, std::uint8_t datatype, std::size_t count, const void* from,
                       std::size_t bytes) {
    fields.push_back({name, datatype, static_cast<std::uint32_t>(count), static_cast<std::uint32_t>(offset),
                      static_cast<const unsigned char*>(from), bytes});
    offset += bytes;
  };
  for (const Column& column : cell.columns) {
    const std::size_t rows = column.shape.front();
    std::uint64_t count = 1;
    for (std::size_t axis = 1; axis < column.shape.size(); ++axis) count *= column.shape[axis];
    if (rows != cell.rows) throw SegmentError("segment_corrupt", cell.id + ": its columns differ in length");
    if (column.name == "xyz") {
      if (count != 3) throw SegmentError("segment_corrupt", cell.id + ": a point has not three coordinates");
      const void* from = column.data;
      if (column.dtype != "<f4" && column.dtype != "<f8")
        throw BadRequest("bad_request", cell.id + ": its coordinates are " + column.dtype);
      if (column.dtype == "<f8") to_map_frame(cell, cell.column<double>("xyz"), xyz32);
      else if (cell.origin != std::array<double, 3>{}) to_map_frame(cell, cell.column<float>("xyz"), xyz32);
      if (!xyz32.empty()) from = xyz32.data();
      for (const char* name : {"x", "y", "z"}) add(name, datatype_of("<f4"), 1, nullptr, 4);
      fields[fields.size() - 3].from = static_cast<const unsigned char*>(from);
    } else if (const auto datatype = datatype_of(column.dtype); datatype != 0 && count != 0) {
      add(column.name, datatype, count, column.data,
          count * bytes_of(column.dtype));
    }
  }
  if (cell.rows > std::numeric_limits<std::uint32_t>::max() / std::max<std::size_t>(offset, 1))
    throw BadRequest("bad_request", cell.id + ": it has more points than a message can");
  return fields;
}

/// Fill a `sensor_msgs/PointCloud2` of any kind with a cell's points, as `pcl::io::loadPCDFile` does.
template <typename Cloud>
void fill(Cloud& cloud, const Cell& cell) {
  std::vector<float> xyz32;
  auto fields = point_fields(cell, xyz32);
  std::size_t step = 0;
  for (const auto& field : fields) {
    typename std::decay_t<decltype(cloud.fields)>::value_type one;
    one.name = field.name;
    one.offset = field.offset;
    one.datatype = field.datatype;
    one.count = field.count;
    cloud.fields.push_back(std::move(one));
    step += field.bytes;
  }
  // x, y, z are adjacent in both, and are copied as one
  fields.erase(
      std::remove_if(fields.begin(), fields.end(), [](const auto& one) { return one.from == nullptr; }),
      fields.end());
  for (auto& field : fields)
    if (field.name == "x") field.bytes = 12;
  const auto points = cell.rows;
  cloud.height = 1;
  cloud.width = static_cast<std::uint32_t>(points);
  cloud.point_step = static_cast<std::uint32_t>(step);
  cloud.row_step = static_cast<std::uint32_t>(points * step);
  cloud.is_bigendian = false;
  cloud.is_dense = true;
  cloud.data.resize(points * step);
  constexpr std::size_t block = 1024;  // points that stay in the cache until all their fields are written
  for (std::size_t first = 0; first < points; first += block)
    for (const auto& field : fields)
      spread(field, first, std::min(block, points - first), cloud.data.data(), step);
}

}  // namespace detail

/// Make a `sensor_msgs/PointCloud2` (of any generator) of a cell's points: x, y, z first, as float32 in the map's
/// frame, then every other column with a type in ROS (64-bit integers and 16-bit floats have none), without gaps.
/// The contents of the message are replaced; its stamp stays.
///
/// Throws NoColumn if the layer's rows are not points, BadRequest if they exceed the size of a message,
/// SegmentError if the columns are damaged.
template <typename Cloud>
void to_point_cloud2(const Cell& cell, Cloud& cloud) {
  static_cast<void>(cell.named("xyz"));  // throws if there is no such column
  cloud.fields.clear();
  detail::fill(cloud, cell);
  cloud.header.frame_id = cell.frame_id;
}

}  // namespace shmmap

#endif  // SHMMAP_POINT_CLOUD2_HPP
