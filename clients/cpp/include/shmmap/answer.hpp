// SPDX-License-Identifier: Apache-2.0
//
// What comes of a request.

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

/// A cell that could not be handed out, and why: `unknown_cell`, `load_failed`, `load_timeout`, `over_budget`,
/// `no_space`, `offline`; take any other code for `load_failed`.
struct Failure {
  std::string id, layer, code, message;
  std::optional<Box> box = std::nullopt;  ///< where the cell lies, if that is known
};

/// What came of a request.
struct Answer {
  std::vector<CellPtr> cells;
  std::vector<std::string> removed;                           ///< of what was held by id
  std::vector<std::uint64_t> removed_versions;                ///< of what was held packed
  std::vector<std::pair<std::string, std::string>> pending;   ///< id and layer of what is being loaded
  std::vector<Failure> failed;
  std::vector<std::string> layers;  ///< those asked for, in canonical form
  std::uint64_t epoch = 0, map_version = 0;
  bool covered = true;  ///< false: part of what was asked for is not known yet, ask again
  std::string reason;   ///< then `offline` where that cannot be reached at present, else empty
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
