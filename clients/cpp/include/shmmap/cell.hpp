// SPDX-License-Identifier: Apache-2.0
//
// One layer of one map cell, in shared memory.

#ifndef SHMMAP_CELL_HPP
#define SHMMAP_CELL_HPP

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <shmmap/detail/segments.hpp>
#include <shmmap/errors.hpp>

namespace shmmap {

/// One column in shared memory: `dtype` as numpy writes it, row-major, the first dimension is rows.
struct Column {
  std::string name, dtype, unit;
  std::vector<std::uint64_t> shape;
  const void* data = nullptr;
  std::uint64_t nbytes = 0;
  std::uint64_t checksum = 0;
};

/// The values of a column, valid as long as their cell.
template <typename T>
class Values {
 public:
  Values(const T* data, std::size_t rows, std::size_t width) : data_(data), rows_(rows), width_(width) {}
  [[nodiscard]] const T* data() const noexcept { return data_; }
  /// Number of rows: points, voxels or fields.
  [[nodiscard]] std::size_t rows() const noexcept { return rows_; }
  /// Number of values in a row: 3 for `xyz`.
  [[nodiscard]] std::size_t width() const noexcept { return width_; }
  [[nodiscard]] std::size_t size() const noexcept { return rows_ * width_; }
  [[nodiscard]] const T* begin() const noexcept { return data_; }
  [[nodiscard]] const T* end() const noexcept { return data_ + size(); }
  /// The values of one row.
  const T* operator[](std::size_t row) const noexcept { return data_ + row * width_; }

 private:
  const T* data_;
  std::size_t rows_, width_;
};

/// The lattice of a computed layer's rows: edges in metres (infinite: not divided along that axis), index of the
/// first voxel of the occupied box, and number of voxels of this box along x, y, z.
struct Lattice {
  std::array<double, 3> leaf{};
  std::array<std::int64_t, 3> first{};
  std::array<std::uint64_t, 3> shape{};
};

/// One layer of one map cell, mapped for reading.
class Cell {
 public:
  std::string id;  ///< complete, as Autoware's `cell_id`
  std::string layer;
  std::uint64_t version = 0;  ///< identifies the bytes together with the layer, also across restarts
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  double z_min = 0.0, z_max = 0.0;  ///< of its points; NaN without points
  bool stale = false;               ///< the map has a newer version that could not be loaded yet
  std::uint64_t rows = 0;
  std::uint64_t source_points = 0, dropped_points = 0;
  std::array<double, 3> origin{};  ///< to add to the coordinates
  std::string frame_id;
  std::optional<Lattice> lattice;
  std::vector<Column> columns;

  /// A column by name; throws NoColumn, and BadRequest if its values have another type.
  template <typename T>
  [[nodiscard]] Values<T> column(std::string_view name) const {
    const Column& found = this->named(name);
    if (found.dtype != detail::dtype_of<T>())
      throw BadRequest("bad_request", id + ": the values of " + found.name + " are " + found.dtype + ", not " +
                                          std::string(detail::dtype_of<T>()));
    const std::uint64_t count = found.shape.front();
    const std::uint64_t values = found.nbytes / sizeof(T);
    return Values<T>(static_cast<const T*>(found.data), count,
                     count != 0 ? values / count : 0);
  }

  /// A column by name, with any type of values; throws NoColumn.
  [[nodiscard]] const Column& named(std::string_view name) const {
    for (const Column& one : columns)
      if (one.name == name) return one;
    std::string there;
    for (const Column& one : columns) there += (there.empty() ? "" : ", ") + one.name;
    throw NoColumn("no_column", id + " (" + layer + ") has no column " + std::string(name), "there are: " + there);
  }

 private:
  friend class Client;
  std::shared_ptr<const detail::Mapping> mapping_;
};

using CellPtr = std::shared_ptr<const Cell>;

}  // namespace shmmap

#endif  // SHMMAP_CELL_HPP
