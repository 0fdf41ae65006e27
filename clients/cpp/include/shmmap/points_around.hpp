// SPDX-License-Identifier: Apache-2.0
//
// The map's points near a position, in place in shared memory.

#ifndef SHMMAP_POINTS_AROUND_HPP
#define SHMMAP_POINTS_AROUND_HPP

#include <cstddef>
#include <vector>

#include <shmmap/areas.hpp>
#include <shmmap/cell.hpp>

namespace shmmap {

/// A cell of a window that touches a circle.
struct NearCell {
  CellPtr cell;
  bool whole = false;  ///< its box, and so all its points, are within the circle
};

/// Cells that touch a circle, and their points within it; nothing is copied, and no point is read before `count`
/// or `for_each`.
struct PointsAround {
  double x = 0.0, y = 0.0, radius = 0.0;
  std::vector<NearCell> cells;
  /// Whether these are all cells of the map in the circle: see `Window::covers`.
  bool covered = false;

  /// Call `take(cell, row)` for each point in the circle, including its border; all points of a cell
  /// within the circle are taken.  Throws NoColumn if the layer's rows are not points.
  template <typename Take>
  void for_each(const Take& take) const {
    for (const auto& one : cells) {
      const Column& xyz = one.cell->named("xyz");
      if (xyz.dtype == "<f8") visit(one, one.cell->column<double>("xyz"), take);
      else visit(one, one.cell->column<float>("xyz"), take);
    }
  }

  /// Number of points in the circle.
  [[nodiscard]] std::size_t count() const {
    std::size_t found = 0;
    for_each([&found](const Cell&, std::size_t) { ++found; });
    return found;
  }

 private:
  template <typename T, typename Take>
  void visit(const NearCell& one, const Values<T>& xyz, const Take& take) const {
    const double center_x = x - one.cell->origin[0], center_y = y - one.cell->origin[1];
    for (std::size_t row = 0; row < xyz.rows(); ++row) {
      const double dx = static_cast<double>(xyz[row][0]) - center_x, dy = static_cast<double>(xyz[row][1]) - center_y;
      if (one.whole || dx * dx + dy * dy <= radius * radius) take(*one.cell, row);
    }
  }
};

}  // namespace shmmap

#endif  // SHMMAP_POINTS_AROUND_HPP
