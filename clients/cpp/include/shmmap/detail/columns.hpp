// SPDX-License-Identifier: Apache-2.0
//
// The table of columns in a segment's header.

#ifndef SHMMAP_DETAIL_COLUMNS_HPP
#define SHMMAP_DETAIL_COLUMNS_HPP

#include <cstdint>
#include <string>
#include <utility>

#include <shmmap/cell.hpp>

namespace shmmap::detail {

/// Location of a segment, from its handle.
struct Handle {
  std::string id, layer, segment;
  std::uint64_t version = 0, offset = 0, bytes = 0;
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  bool stale = false;
};

[[noreturn]] inline void corrupt(const Handle& handle, const std::string& why) {
  throw SegmentError("segment_corrupt", handle.segment + " (" + handle.id + "): " + why);
}

inline std::string text_in(const unsigned char* header, std::uint64_t end, std::size_t at, const Handle& handle) {
  const std::uint64_t offset = read_at<std::uint32_t>(header, at), size = read_at<std::uint32_t>(header, at + 4);
  if (offset > end || size > end - offset) corrupt(handle, "a text of the header lies outside of it");
  return std::string(reinterpret_cast<const char*>(header) + offset, size);
}

/// Read the table of columns; each column is checked against the size of the segment.
inline void read_columns(Cell& cell, const Handle& handle, const unsigned char* segment, std::uint64_t header_bytes,
                         std::uint64_t total) {
  const std::uint64_t end = header_bytes - 72;
  const std::uint64_t count = read_at<std::uint32_t>(segment, 172), start = read_at<std::uint32_t>(segment, 176);
  const std::uint64_t row_bytes = read_at<std::uint32_t>(segment, 180);
  if (row_bytes < 128 || start > end || count > (end - start) / row_bytes) corrupt(handle, "no table of columns");
  cell.columns.reserve(count);
  for (std::uint64_t number = 0; number < count; ++number) {
    const unsigned char* row = segment + start + number * row_bytes;
    Column column;
    column.name = fixed_text(row, 40);
    column.dtype = fixed_text(row + 40, 8);
    column.unit = fixed_text(row + 48, 16);
    const auto dimensions = read_at<std::uint32_t>(row, 64);
    std::uint64_t bytes = bytes_of(column.dtype);
    if (bytes == 0 || dimensions < 1 || dimensions > 4) corrupt(handle, "column " + column.name + " has no type");
    for (std::uint32_t axis = 0; axis < dimensions; ++axis) {
      const auto side = read_at<std::uint64_t>(row, 72 + 8 * axis);
      if (side != 0 && bytes > total / side) corrupt(handle, "column " + column.name + " is too large");
      bytes *= side;
      column.shape.push_back(side);
    }
    const auto offset = read_at<std::uint64_t>(row, 104);
    column.nbytes = read_at<std::uint64_t>(row, 112);
    column.checksum = read_at<std::uint64_t>(row, 120);
    if (column.nbytes != bytes || offset % 64 != 0 || offset < header_bytes || offset > total ||
        bytes > total - offset)
      corrupt(handle, "column " + column.name + " lies outside of the segment");
    column.data = segment + offset;
    cell.columns.push_back(std::move(column));
  }
}

}  // namespace shmmap::detail

#endif  // SHMMAP_DETAIL_COLUMNS_HPP
