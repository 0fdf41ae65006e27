// SPDX-License-Identifier: Apache-2.0
//
// Requested areas, and the pose of the client.  Metres in the frame of the map.

#ifndef SHMMAP_AREAS_HPP
#define SHMMAP_AREAS_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <variant>
#include <vector>

#include <shmmap/errors.hpp>

namespace shmmap {

/// Lowest and highest z of an area, metres; it includes cells whose bounds are not known yet.
struct ZRange {
  double min = 0.0, max = 0.0;
};

/// Cells whose nearest point is within `radius` of (x, y).
struct Circle {
  double x = 0.0, y = 0.0, radius = 0.0;
  std::optional<ZRange> z = std::nullopt;
};

/// Autoware's test: the cell's box grown by `radius` contains (x, y).
struct Square {
  double x = 0.0, y = 0.0, radius = 0.0;
  std::optional<ZRange> z = std::nullopt;
};

/// Cells that touch the rectangle.
struct Box {
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  std::optional<ZRange> z = std::nullopt;
};

using Area = std::variant<Circle, Square, Box>;

/// Pose and motion of the client, by which the daemon decides what to prefetch, and what to keep in memory
/// longest.  Metres, m/s (both 0: the daemon learns them from the poses), radians.
struct Intent {
  double x = 0.0, y = 0.0, vx = 0.0, vy = 0.0;
  std::optional<double> heading = std::nullopt;
  /// The polyline ahead, required with every pose; above 512 points, 512 equally spaced ones are sent.
  std::vector<std::array<double, 2>> route = {};
};

namespace detail {

/// Sides of a rectangle.
struct Sides {
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
};

/// A number rounded as in a message of Autoware.
inline double as_float(double value) { return static_cast<double>(static_cast<float>(value)); }

/// The smallest rectangle around an area; for a square, with the rounding of Autoware's float messages.
inline Sides bounds(const Area& area) {
  if (const auto* box = std::get_if<Box>(&area)) return {box->min_x, box->min_y, box->max_x, box->max_y};
  const auto around = [](double x, double y, double radius) {
    return Sides{x - radius, y - radius, x + radius, y + radius};
  };
  if (const auto* circle = std::get_if<Circle>(&area)) return around(circle->x, circle->y, circle->radius);
  const auto& square = std::get<Square>(area);
  return around(as_float(square.x), as_float(square.y), as_float(square.radius));
}

inline double distance_to(const Sides& box, double x, double y) {
  return std::hypot(std::max({box.min_x - x, x - box.max_x, 0.0}), std::max({box.min_y - y, y - box.max_y, 0.0}));
}

inline double farthest_in(const Sides& box, double x, double y) {
  return std::hypot(std::max(std::abs(box.min_x - x), std::abs(box.max_x - x)),
                    std::max(std::abs(box.min_y - y), std::abs(box.max_y - y)));
}

inline bool lies_in(const Sides& inner, const Sides& outer) {
  return outer.min_x <= inner.min_x && outer.min_y <= inner.min_y && inner.max_x <= outer.max_x &&
         inner.max_y <= outer.max_y;
}

/// Whether a circle is certainly within an area.
inline bool contains_circle(const Area& area, double x, double y, double radius) {
  if (const auto* circle = std::get_if<Circle>(&area))
    return std::hypot(x - circle->x, y - circle->y) + radius <= circle->radius;
  const Sides sides = bounds(area);
  if (std::holds_alternative<Square>(area)) {  // margin for the rounding of a box
    const auto most = static_cast<float>(std::max({std::abs(sides.min_x), std::abs(sides.min_y),
                                                   std::abs(sides.max_x), std::abs(sides.max_y)}));
    radius += static_cast<double>(std::nextafter(most, std::numeric_limits<float>::infinity()) - most);
  }
  return lies_in({x - radius, y - radius, x + radius, y + radius}, sides);
}

/// Whether a cell's box belongs to an area: the daemon's own test.
inline bool overlaps(const Area& area, const Sides& cell) {
  if (const auto* circle = std::get_if<Circle>(&area)) {
    const double dx = std::max({cell.min_x - circle->x, circle->x - cell.max_x, 0.0});
    const double dy = std::max({cell.min_y - circle->y, circle->y - cell.max_y, 0.0});
    return dx * dx + dy * dy <= circle->radius * circle->radius;
  }
  if (const auto* box = std::get_if<Box>(&area))
    return cell.min_x <= box->max_x && cell.max_x >= box->min_x && cell.min_y <= box->max_y &&
           cell.max_y >= box->min_y;
  const auto& square = std::get<Square>(area);
  const double x = as_float(square.x), y = as_float(square.y), radius = as_float(square.radius);
  return as_float(cell.min_x) - radius <= x && x <= as_float(cell.max_x) + radius &&
         as_float(cell.min_y) - radius <= y && y <= as_float(cell.max_y) + radius;
}

/// A route of at most 512 points: unchanged, or equally spaced points along it, including its ends.
inline std::vector<std::array<double, 2>> thinned(std::vector<std::array<double, 2>> route) {
  constexpr std::size_t max_places = 512;
  constexpr double farthest_m = 1e8;  // larger distances are clamped to this, as in the daemon
  if (route.size() <= max_places) return route;
  std::vector<double> along(route.size(), 0.0);
  for (auto& place : route)
    for (auto& side : place) side = std::clamp(side, -farthest_m, farthest_m);
  for (std::size_t at = 1; at < route.size(); ++at)
    along[at] = along[at - 1] + std::hypot(route[at][0] - route[at - 1][0], route[at][1] - route[at - 1][1]);
  if (along.back() == 0.0) return {route.front()};
  std::vector<std::array<double, 2>> found;
  for (std::size_t number = 0, at = 0; number + 1 < max_places; ++number) {
    const double here = static_cast<double>(number) * (along.back() / static_cast<double>(max_places - 1));
    while (at + 2 < route.size() && along[at + 1] <= here) ++at;
    const double step = along[at + 1] - along[at], share = step > 0.0 ? std::min((here - along[at]) / step, 1.0) : 0.0;
    found.push_back({route[at][0] + share * (route[at + 1][0] - route[at][0]),
                     route[at][1] + share * (route[at + 1][1] - route[at][1])});
  }
  found.push_back(route.back());
  return found;
}

inline void check_circle(double x, double y, double radius) {
  if (!std::isfinite(x) || !std::isfinite(y) || !std::isfinite(radius) || radius < 0.0)
    throw BadRequest("bad_request", "a circle has a finite centre, and a radius that is not below zero");
}

}  // namespace detail

}  // namespace shmmap

#endif  // SHMMAP_AREAS_HPP
