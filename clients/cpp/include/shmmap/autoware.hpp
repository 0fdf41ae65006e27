// SPDX-License-Identifier: Apache-2.0
//
// shmmap in Autoware's nodes: replaces the scan matcher's requests to the map loader's service.
//
//     using Service = autoware_map_msgs::srv::GetDifferentialPointCloudMap;
//     shmmap::PcdLoader<Service> loader;                  // is a `PcdLoaderFunction`
//     auto response = loader(request);                    // cells to add, ids to remove; or nullptr
//
//     shmmap::MapServices services;                       // for a node that serves the map: all three services
//     auto response = services.answer<Service>(*request, lacks);
//
//     shmmap::NdtLeaves<Leaf> leaves(2.0);                // the same with precomputed voxels
//     if (auto found = leaves(request)) use(found->grids_to_add, found->ids_to_remove);
//
// Includes no headers of ROS, PCL or Eigen: any types with members of these names work as messages and leaves.
//
// Autoware's `cached_ids` name the cells of a node, but not their versions.  So these objects give out the version
// with the id, `<id>@<16 hexadecimal digits>`, which Autoware's nodes keep and repeat as they keep any id.  A
// changed cell comes under its new name, and its old name is among the ids to remove.  Nothing is remembered of
// nodes: any number of them may share one object, and restarts of any part cost nothing.  Copies share one
// connection, and several threads may use them: a second call waits for the end of the first.
//
// These objects never throw.  A call waits for cells, because a node with none or a part of them sends its next
// request only 20 m further on.  It waits `LoaderOptions::wait` seconds for cells being loaded or for a daemon,
// and `Options::timeout` seconds more if the daemon does not answer at all.

#ifndef SHMMAP_AUTOWARE_HPP
#define SHMMAP_AUTOWARE_HPP

#include <locale>
#include <shmmap/detail/map_requests.hpp>
#include <shmmap/point_cloud2.hpp>
#include <shmmap/shmmap.hpp>
#include <sstream>

namespace shmmap {

namespace detail {

/// The square of Autoware's area, from any message type.
template <typename Request>
Square area_of(const Request& request) {
  return {static_cast<double>(request.area.center_x), static_cast<double>(request.area.center_y),
          static_cast<double>(request.area.radius)};
}

template <typename Request, typename = void>
inline constexpr bool has_cached_ids = false;
template <typename Request>
inline constexpr bool has_cached_ids<Request, std::void_t<decltype(Request::cached_ids)>> = true;
template <typename Request, typename = void>
inline constexpr bool names_cells = false;
template <typename Request>
inline constexpr bool names_cells<Request, std::void_t<decltype(Request::cell_ids)>> = true;
template <typename Response, typename = void>
inline constexpr bool removes_ids = false;
template <typename Response>
inline constexpr bool removes_ids<Response, std::void_t<decltype(Response::ids_to_remove)>> = true;

/// Names that the requester has; none if it cannot say.
template <typename Request>
std::vector<std::string> ids_of(const Request& request) {
  if constexpr (has_cached_ids<Request>) return {request.cached_ids.begin(), request.cached_ids.end()};
  return {};
}

template <typename Response>
using CellMessage = typename decltype(Response::new_pointcloud_with_ids)::value_type;

/// A cell as `PointCloudMapCellWithID`.
template <typename Message>
Message message_of(const std::string& name, const Cell& cell) {
  Message message;
  message.cell_id = name;
  fill(message.pointcloud, cell);
  auto& box = message.metadata;
  box.min_x = static_cast<decltype(box.min_x)>(cell.min_x);
  box.min_y = static_cast<decltype(box.min_y)>(cell.min_y);
  box.max_x = static_cast<decltype(box.max_x)>(cell.max_x);
  box.max_y = static_cast<decltype(box.max_y)>(cell.max_y);
  return message;
}

template <typename Response>
Response response_of(Difference<CellMessage<Response>>&& found) {
  Response response;
  response.header.frame_id = found.frame_id;
  for (auto& [id, message] : found.added) response.new_pointcloud_with_ids.push_back(std::move(message));
  if constexpr (removes_ids<Response>)
    for (auto& name : found.removed) response.ids_to_remove.push_back(std::move(name));
  return response;
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
      : requests_(std::make_shared<detail::MapRequests>(std::move(options), "points")) {}

  /// Cells of the area that the node lacks in the present version, and names to remove; nullptr if something is
  /// missing and nothing new has come.  Cells are in the order of ids, with points as from Autoware's loader;
  /// `header.frame_id` is the map's, stamps are 0.  `request` is any kind of pointer.
  template <typename RequestPointer>
  std::shared_ptr<Response> operator()(const RequestPointer& request) const noexcept {
    try {
      auto found = requests_->difference(detail::area_of(*request), detail::ids_of(*request),
                                         detail::message_of<detail::CellMessage<Response>>);
      if (!found.trouble.empty()) requests_->say(found.trouble);
      if (found.added.empty() && !found.complete) return nullptr;
      return std::make_shared<Response>(detail::response_of<Response>(std::move(found)));
    } catch (const std::exception& error) {
      requests_->say(error.what());
      return nullptr;
    }
  }

 private:
  std::shared_ptr<detail::MapRequests> requests_;
};

/// What a service's answer lacks.
struct Shortfall {
  std::string why;        ///< a line for a log; empty: nothing is missing
  std::size_t cells = 0;  ///< number of missing cells, as far as they are known
  bool reached = false;   ///< a daemon is there
};

/// Answers all three of Autoware's map services, as its map loader does, for a node that serves them.  Differences: a
/// cell that cannot be loaded is left out, where Autoware sends it empty; a changed cell comes again; a name that a
/// request repeats is not removed for that reason.
///
/// Requesters take an empty answer for an empty map or for "no change".  So there is none while no daemon answers, or
/// while all that could be sent has no room in memory; call again then.  Nothing is logged.
class MapServices {
 public:
  /// The time of `options.wait` begins when a daemon is there.
  explicit MapServices(LoaderOptions options = {})
      : max_bytes_(options.max_bytes),
        requests_(std::make_shared<detail::MapRequests>(std::move(options), "points")) {}

  /// The answer to a request: `Service` is one of `autoware_map_msgs::srv`, `GetPartialPointCloudMap`,
  /// `GetDifferentialPointCloudMap` or `GetSelectedPointCloudMap`, or has a `Request` and a `Response` of such a
  /// shape.  What cannot be loaded is left out, and in `lacks`.  nullptr: call again; `lacks` says why.
  template <typename Service>
  std::shared_ptr<typename Service::Response> answer(const typename Service::Request& request,
                                                     Shortfall& lacks) const noexcept {
    using Response = typename Service::Response;
    try {
      constexpr auto make = detail::message_of<detail::CellMessage<Response>>;
      if constexpr (detail::names_cells<typename Service::Request>) {
        std::vector<std::string> ids(request.cell_ids.begin(), request.cell_ids.end());
        auto found = requests_->selected(ids, make);
        return answer_of<Response>(found, lacks, [&](Response& response) {
          std::uint64_t bytes = 0;  // cells that a request repeats count again
          for (const auto& id : ids) {
            const auto cell = found.added.find(id);
            if (cell == found.added.end()) continue;
            bytes += cell->second.pointcloud.data.size();
            if (bytes <= max_bytes_) response.new_pointcloud_with_ids.push_back(cell->second);
            else ++lacks.cells, lacks.why = "the cells of a request are too much for one answer: ask for fewer at once";
          }
        });
      } else {
        auto found = requests_->difference(detail::area_of(request), detail::ids_of(request), make,
                                           detail::Asker::service);
        return answer_of<Response>(found, lacks, [&](Response& response) {
          response = detail::response_of<Response>(std::move(found));
        });
      }
    } catch (const std::exception& error) {
      lacks = {error.what()};
      return nullptr;
    }
  }

 private:
  template <typename Response, typename Made, typename Fill>
  static std::shared_ptr<Response> answer_of(detail::Difference<Made>& found, Shortfall& lacks, const Fill& fill) {
    lacks = {std::move(found.trouble), found.missing, found.reached};
    if (!found.answered) return nullptr;
    auto response = std::make_shared<Response>();
    fill(*response);
    response->header.frame_id = found.frame_id;
    return response;
  }

  std::uint64_t max_bytes_;
  std::shared_ptr<detail::MapRequests> requests_;
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

/// Like `PcdLoader`, but with voxels instead of points, which need not be computed.  A cell's name has the version of
/// its voxels.
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
      : requests_(std::make_shared<detail::MapRequests>(std::move(options), layer(resolution))) {}

  /// Like `PcdLoader`; no value if something is missing and nothing new has come.
  template <typename RequestPointer>
  std::optional<Update> operator()(const RequestPointer& request) const noexcept {
    try {
      auto found = requests_->difference(detail::area_of(*request), detail::ids_of(*request),
                                         [](const std::string& name, const Cell& cell) {
                                           return Grid{name, ndt_leaves<Leaf>(cell)};
                                         });
      if (!found.trouble.empty()) requests_->say(found.trouble);
      if (found.added.empty() && !found.complete) return std::nullopt;
      Update update;
      update.ids_to_remove = std::move(found.removed);
      update.grids_to_add.reserve(found.added.size());
      for (auto& [id, grid] : found.added) update.grids_to_add.push_back(std::move(grid));
      return update;
    } catch (const std::exception& error) {
      requests_->say(error.what());
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

  std::shared_ptr<detail::MapRequests> requests_;
};

}  // namespace shmmap

#endif  // SHMMAP_AUTOWARE_HPP
