// SPDX-License-Identifier: Apache-2.0
//
// Results of a request.

#ifndef SHMMAP_ANSWER_HPP
#define SHMMAP_ANSWER_HPP

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <shmmap/areas.hpp>
#include <shmmap/cell.hpp>

namespace shmmap {

/// A cell that the daemon could not provide, and why: `unknown_cell`, `load_failed`, `load_timeout`, `over_budget`,
/// `no_space`, `offline`; treat any other code as `load_failed`.
struct Failure {
  std::string id, layer, code, message;
  std::optional<Box> box = std::nullopt;  ///< of the cell, if known
  std::size_t holders = 0;                ///< of `over_budget`: users of the memory; none: it never fits
};

/// Result of a request for cells.
struct Answer {
  std::vector<CellPtr> cells;
  std::vector<std::string> removed;                           ///< ids that the client should drop
  std::vector<std::uint64_t> removed_versions;                ///< packed versions that the client should drop
  std::vector<std::pair<std::string, std::string>> pending;   ///< id and layer of cells being loaded
  std::vector<Failure> failed;
  std::vector<std::string> layers;  ///< requested layers, in canonical form
  std::uint64_t epoch = 0, map_version = 0;
  bool covered = true;  ///< false: part of the area is not known yet, ask again
  std::string reason;   ///< then `offline` if that part cannot be reached now, else empty
};

/// What a client has: the cell's id and its version (none: the current one), of these layers; no layers means all
/// that it asks for.
struct Held {
  std::string id;
  std::optional<std::uint64_t> version = std::nullopt;
  std::vector<std::string> layers = {};
};

/// One cell of the map, whether it is in memory or not.
struct MapCell {
  std::string id;
  std::uint64_t version = 0;  ///< of its `points`
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  std::uint64_t source_bytes = 0;
  std::optional<double> z_min = std::nullopt, z_max = std::nullopt;  ///< known once it was loaded
};

/// What the map consists of.
struct MapListing {
  std::vector<MapCell> cells;
  std::uint64_t epoch = 0, map_version = 0;
};

}  // namespace shmmap

#endif  // SHMMAP_ANSWER_HPP
