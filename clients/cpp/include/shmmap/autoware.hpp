// SPDX-License-Identifier: Apache-2.0
//
// shmmap in Autoware's nodes: replaces the scan matcher's requests to the map loader's service.
//
//     using Service = autoware_map_msgs::srv::GetDifferentialPointCloudMap;
//     shmmap::PcdLoader<Service> loader;                  // is a `PcdLoaderFunction`
//     auto response = loader(request);                    // cells to add, ids to remove; or nullptr
//
//     shmmap::NdtLeaves<Leaf> leaves(2.0);                // the same with precomputed voxels
//     if (auto found = leaves(request)) use(found->grids_to_add, found->ids_to_remove);
//
// Includes no headers of ROS, PCL or Eigen: any types with members of these names work as messages and leaves.
//
// Autoware's `cached_ids` name the cells of a node, but not their versions.  So these objects remember the
// version of each cell that they returned, and return a changed cell again under its id.  Use one object for
// each holder of cells, and apply every result completely.  Copies share one state and one connection, and
// several threads may use them: a second call waits for the end of the first.
//
// These objects never throw.  A call waits for cells, because a node with none or a part of them sends its next
// request only 20 m further on.  It waits `LoaderOptions::wait` seconds for cells being loaded or for a daemon,
// and `Options::timeout` seconds more if the daemon does not answer at all.

#ifndef SHMMAP_AUTOWARE_HPP
#define SHMMAP_AUTOWARE_HPP

#include <functional>
#include <limits>
#include <locale>
#include <mutex>
#include <set>
#include <shmmap/point_cloud2.hpp>
#include <shmmap/shmmap.hpp>
#include <sstream>

namespace shmmap {

/// Options of requests for cells.
struct LoaderOptions {
  Options client = {};  ///< how to find the daemon
  double wait = 10.0;   ///< seconds, at most 3600; see above
  /// Called in the caller's thread with a line about cells that could not be loaded.
  std::function<void(const std::string&)> log = {};
  /// Called ten times a second while a call waits; if it returns false, the call ends with the cells so far.
  /// In a node: `[] { return rclcpp::ok(); }`, so that no request delays its shutdown.
  std::function<bool()> keep_waiting = {};
};

namespace detail {

/// Changes for a node that holds cells.
template <typename Made>
struct Difference {
  std::map<std::string, Made> added;  ///< by id, which is the order of Autoware's loader
  std::vector<std::string> removed;   ///< in the order of the held ids; none of `added`
  std::string frame_id;
};

/// Remembers the versions of the cells that a caller holds by id, and requests missing ones.
class HeldCells {
 public:
  HeldCells(LoaderOptions options, std::string layer)
      : options_(std::move(options)), layer_(std::move(layer)) {
    if (options_.keep_waiting) options_.client.keep_waiting = options_.keep_waiting;
  }

  /// Cells of an area that `cached` lacks, each converted by `make` from the mapped cell, and ids to remove.
  /// No value, with unchanged state, if cells are missing and no new one has arrived.  Each mapped cell is
  /// released after its conversion, so that an area may be larger than the daemon's memory.
  template <typename Make, typename Made = std::invoke_result_t<const Make&, const Cell&>>
  std::optional<Difference<Made>> difference(const Area& area, const std::vector<std::string>& cached,
                                             const Make& make) {
    const std::lock_guard<std::mutex> one_at_a_time(mutex_);
    Difference<Made> found;
    std::map<std::string, std::uint64_t> held;  // cells of `cached` with known versions, and new cells
    std::set<std::string> gone, missing;
    bool covered = false;
    std::string trouble;
    for (const auto& id : cached)
      if (const auto known = versions_.find(id); known != versions_.end()) held.insert(*known);
    try {
      const auto until = Clock::now() + std::chrono::duration_cast<Clock::duration>(Seconds(options_.wait));
      for (bool again = true; again;) {
        const auto answer = asked(area, held, until);
        found.frame_id = client_->frame_id();
        covered = answer.covered;
        missing.clear();
        trouble.clear();
        const auto lacks = [&](const std::string& id, const std::string& why) {
          missing.insert(id);
          if (trouble.empty()) trouble = why;
        };
        for (const auto& id : answer.removed) {
          held.erase(id);
          found.added.erase(id);
          gone.insert(id);
        }
        for (const auto& cell : answer.cells) {
          try {
            found.added.insert_or_assign(cell->id, make(*cell));
            held[cell->id] = cell->version;
            gone.erase(cell->id);
          } catch (const Error& error) {  // the other cells are still usable
            lacks(cell->id, error.what());
          }
        }
        bool no_room = false;
        for (const auto& failure : answer.failed) {
          lacks(failure.id, failure.id + ": " + failure.message + " (" + failure.code + ")");
          no_room = no_room || failure.code == "over_budget" || failure.code == "no_space";
        }
        for (const auto& [id, layer] : answer.pending) lacks(id, id + ": it is still being loaded");
        // released cells make room; and requests do not wait for a map that is not known yet
        again = (!covered || !answer.pending.empty() || (no_room && !answer.cells.empty())) &&
                Clock::now() < until && is_wanted();
        if (again && answer.cells.empty()) ::poll(nullptr, 0, 20);
      }
      if (!covered && trouble.empty()) trouble = "not all of the map is known yet";
      if (missing.size() > 1) trouble += "; cells missing in all: " + std::to_string(missing.size());
    } catch (const std::exception& error) {  // keep the cells before the error
      client_.reset();
      covered = false;
      trouble = error.what();
    }
    if (!trouble.empty()) say(trouble);
    if (!trouble.empty() && found.added.empty()) return std::nullopt;
    std::set<std::string> seen;
    for (const auto& id : cached) {
      // a cell without known version was not requested: it is replaced, or not in the area
      const bool is_foreign = versions_.count(id) == 0 && covered && missing.count(id) == 0;
      if (found.added.count(id) == 0 && (is_foreign || gone.count(id) != 0) && seen.insert(id).second)
        found.removed.push_back(id);
    }
    versions_ = std::move(held);
    return found;
  }

  /// Log an error; an exception of the caller's log function does not end its node.
  void say(const std::string& message) const noexcept {
    try {
      if (options_.log) options_.log("shmmap: " + message);
    } catch (...) {  // NOLINT(bugprone-empty-catch): there is no other log
    }
  }

 private:
  [[nodiscard]] bool is_wanted() const { return !options_.keep_waiting || options_.keep_waiting(); }

  Answer asked(const Area& area, const std::map<std::string, std::uint64_t>& held, Clock::time_point until) {
    while (!client_) {
      try {
        client_.emplace(options_.client);
      } catch (const Unreachable& error) {
        if (error.code() == "no_permission" || Clock::now() >= until || !is_wanted()) throw;
        ::poll(nullptr, 0, 20);  // a starting daemon sends no notification
      }
    }
    std::vector<Held> have;
    have.reserve(held.size());
    for (const auto& [id, version] : held) have.push_back({id, version});
    const auto left = std::chrono::duration_cast<Seconds>(until - Clock::now()).count();
    return client_->differential(area, have, {}, {layer_}, std::max(0.0, left));
  }

  LoaderOptions options_;
  const std::string layer_;
  std::mutex mutex_;
  std::optional<Client> client_;
  std::map<std::string, std::uint64_t> versions_;
};

/// The square of Autoware's area, from any message type.
template <typename Request>
Square area_of(const Request& request) {
  return {static_cast<double>(request.area.center_x), static_cast<double>(request.area.center_y),
          static_cast<double>(request.area.radius)};
}

template <typename Request>
std::vector<std::string> ids_of(const Request& request) {
  return {request.cached_ids.begin(), request.cached_ids.end()};
}

}  // namespace detail

// --- points ----------------------------------------------------------------------------------------------

/// Answers `GetDifferentialPointCloudMap` requests, as a `PcdLoaderFunction` of Autoware.
///
/// `Service` is `autoware_map_msgs::srv::GetDifferentialPointCloudMap`, or anything that has a `Request` and
/// a `Response` of that shape.
template <typename Service>
class PcdLoader {
 public:
  using Response = typename Service::Response;

  explicit PcdLoader(LoaderOptions options = {})
      : cells_(std::make_shared<detail::HeldCells>(std::move(options), "points")) {}

  /// Cells of the area that the node lacks in the present version, and ids to remove; nullptr if they could not
  /// be fetched.  Cells are in the order of ids, with points as from Autoware's loader; `header.frame_id` is the
  /// map's, stamps are 0.  `request` is any kind of pointer.
  template <typename RequestPointer>
  std::shared_ptr<Response> operator()(const RequestPointer& request) const noexcept {
    try {
      using CellMessage = typename decltype(Response::new_pointcloud_with_ids)::value_type;
      auto found =
          cells_->difference(detail::area_of(*request), detail::ids_of(*request), [](const Cell& cell) {
            CellMessage message;
            message.cell_id = cell.id;
            detail::fill(message.pointcloud, cell);
            auto& box = message.metadata;
            box.min_x = static_cast<decltype(box.min_x)>(cell.min_x);
            box.min_y = static_cast<decltype(box.min_y)>(cell.min_y);
            box.max_x = static_cast<decltype(box.max_x)>(cell.max_x);
            box.max_y = static_cast<decltype(box.max_y)>(cell.max_y);
            return message;
          });
      if (!found) return nullptr;
      auto response = std::make_shared<Response>();
      response->header.frame_id = found->frame_id;
      for (auto& [id, message] : found->added)
        response->new_pointcloud_with_ids.push_back(std::move(message));
      for (auto& id : found->removed) response->ids_to_remove.push_back(std::move(id));
      return response;
    } catch (const std::exception& error) {
      cells_->say(error.what());
      return nullptr;
    }
  }

 private:
  std::shared_ptr<detail::HeldCells> cells_;
};

// --- voxels ----------------------------------------------------------------------------------------------

/// The voxels of a cell's `ndt` layer as Autoware's `MultiVoxelGridCovariance::Leaf`, or anything with
/// members `nr_points_`, `mean_`, `centroid_` and `icov_` of the same meaning.
///
/// Voxels are in Autoware's order (x fastest, then y, then z), of at least 6 points each, unless the layer's
/// `min_points` says otherwise.  A voxel whose covariance has no inverse has zeros in `icov_` and -1 points.
/// `centroid_` is `mean_` rounded to float32, where Autoware sums in float32: far from the map's origin its
/// sum is centimetres off.  Covariances are not filled in, because only their inverses are read.
template <typename Leaf>
std::vector<Leaf> ndt_leaves(const Cell& cell) {
  const auto mean = cell.column<double>("mean"), inverse = cell.column<double>("inverse_covariance");
  const auto count = cell.column<std::uint32_t>("count");
  const std::size_t rows = mean.rows();
  if (inverse.rows() != rows || count.rows() != rows ||
      (rows != 0 && (mean.width() != 3 || inverse.width() != 6)))
    throw SegmentError("segment_corrupt", cell.id + " (" + cell.layer + "): its columns are no voxels");
  std::vector<Leaf> leaves(rows);
  for (std::size_t row = 0; row < rows; ++row) {
    Leaf& leaf = leaves[row];
    const double *at = mean[row], *of = inverse[row];  // xx, xy, xz, yy, yz, zz
    leaf.centroid_.resize(4);
    for (int axis = 0; axis < 3; ++axis) {
      leaf.mean_[axis] = at[axis] + cell.origin[static_cast<std::size_t>(axis)];
      leaf.centroid_[axis] = static_cast<float>(leaf.mean_[axis]);
    }
    leaf.centroid_[3] = 0.0F;
    leaf.icov_(0, 0) = of[0];
    leaf.icov_(0, 1) = leaf.icov_(1, 0) = of[1];
    leaf.icov_(0, 2) = leaf.icov_(2, 0) = of[2];
    leaf.icov_(1, 1) = of[3];
    leaf.icov_(1, 2) = leaf.icov_(2, 1) = of[4];
    leaf.icov_(2, 2) = of[5];
    const bool refused = of[0] == 0.0 && of[3] == 0.0 && of[5] == 0.0;
    leaf.nr_points_ = refused ? -1 : static_cast<int>(*count[row]);
  }
  return leaves;
}

/// Like `PcdLoader`, but with voxels instead of points, which need not be computed.
template <typename Leaf>
class NdtLeaves {
 public:
  struct Grid {
    std::string cell_id;
    std::vector<Leaf> leaves;
  };
  struct Update {
    std::vector<Grid> grids_to_add;
    std::vector<std::string> ids_to_remove;
  };

  /// `resolution`: edge of a voxel in metres, the node's `ndt.resolution`.
  explicit NdtLeaves(double resolution = 2.0, LoaderOptions options = {})
      : cells_(std::make_shared<detail::HeldCells>(std::move(options), layer(resolution))) {}

  /// Like `PcdLoader`; no value if the cells could not be fetched.
  template <typename RequestPointer>
  std::optional<Update> operator()(const RequestPointer& request) const noexcept {
    try {
      auto found = cells_->difference(detail::area_of(*request), detail::ids_of(*request), ndt_leaves<Leaf>);
      if (!found) return std::nullopt;
      Update update;
      update.ids_to_remove = std::move(found->removed);
      update.grids_to_add.reserve(found->added.size());
      for (auto& [id, leaves] : found->added) update.grids_to_add.push_back({id, std::move(leaves)});
      return update;
    } catch (const std::exception& error) {
      cells_->say(error.what());
      return std::nullopt;
    }
  }

 private:
  static std::string layer(double resolution) {
    std::ostringstream spec;
    spec.imbue(std::locale::classic());  // a decimal point in any locale
    spec.precision(17);
    spec << "ndt(leaf=" << resolution << ")";
    return spec.str();
  }

  std::shared_ptr<detail::HeldCells> cells_;
};

}  // namespace shmmap

#endif  // SHMMAP_AUTOWARE_HPP
