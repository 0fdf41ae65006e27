// SPDX-License-Identifier: Apache-2.0
//
// shmmap in Autoware's nodes: what its scan matcher asks of the map loader's service, without the service.
//
//     using Service = autoware_map_msgs::srv::GetDifferentialPointCloudMap;
//     shmmap::PcdLoader<Service> loader;                  // is a `PcdLoaderFunction`
//     auto response = loader(request);                    // cells to add, ids to remove; or nullptr
//
//     shmmap::NdtLeaves<Leaf> leaves(2.0);                // the same with voxels, which are computed already
//     if (auto found = leaves(request)) use(found->grids_to_add, found->ids_to_remove);
//
// Nothing of ROS, PCL or Eigen is included: messages and leaves are whatever has members of these names.
//
// Autoware's `cached_ids` say which cells a node has, and not in which version.  So these objects remember
// the version of each cell that they handed out, and a cell that has changed in the map comes again under its
// id.  Hence: one object for each thing that keeps cells, and what it returns must be taken over as a whole.
// Copies share one memory and one connection.  A node's one thread may use them as well as several: a second
// call waits for the first one to end.
//
// They never throw.  Cells are waited for, because a node that was given nothing, or a part, asks again only
// 20 m further on: `LoaderOptions::wait` seconds for cells that are being loaded, or until there is a daemon;
// and `Options::patience` seconds more if it does not answer at all.

#ifndef SHMMAP_AUTOWARE_HPP
#define SHMMAP_AUTOWARE_HPP

#include <functional>
#include <limits>
#include <locale>
#include <mutex>
#include <set>
#include <shmmap/shmmap.hpp>
#include <sstream>

namespace shmmap {

/// How cells are asked for.
struct LoaderOptions {
  Options client = {};  ///< how the daemon is found
  double wait = 10.0;   ///< seconds, at most 3600; see above
  /// Told what could not be had, a line each time; nobody, if empty.  It is called in the caller's thread.
  std::function<void(const std::string&)> log = {};
};

namespace detail {

/// What changes for a node that holds cells.
template <typename Made>
struct Difference {
  std::map<std::string, Made> added;  ///< by id, which is the order of Autoware's loader
  std::vector<std::string> removed;   ///< in the order in which they were held; never one of `added`
  std::string frame_id;
};

/// Remembers the versions of the cells that somebody holds by id, and asks for what he lacks.
class HeldCells {
 public:
  HeldCells(LoaderOptions options, std::string layer)
      : options_(std::move(options)), layer_(std::move(layer)) {}

  /// What `cached` lacks of an area, each cell as `make` makes it out of the mapped one, and what it has in
  /// vain; no value, and nothing forgotten, where something is missing and no other cell has come.  Cells are
  /// let go of as soon as they are made: an area may be larger than the daemon's memory.
  template <typename Make, typename Made = std::invoke_result_t<const Make&, const Cell&>>
  std::optional<Difference<Made>> difference(const Area& area, const std::vector<std::string>& cached,
                                             const Make& make) {
    const std::lock_guard<std::mutex> one_at_a_time(mutex_);
    Difference<Made> found;
    std::map<std::string, std::uint64_t> held;  // of `cached`, and of what comes: that whose version is known
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
          } catch (const Error& error) {  // one cell must not cost the others
            lacks(cell->id, error.what());
          }
        }
        bool no_room = false;
        for (const auto& failure : answer.failed) {
          lacks(failure.id, failure.id + ": " + failure.message + " (" + failure.code + ")");
          no_room = no_room || failure.code == "over_budget" || failure.code == "no_space";
        }
        for (const auto& [id, layer] : answer.pending) lacks(id, id + ": it is still being loaded");
        // room comes of what is let go here; and for a map that is not known yet no request waits
        again = (!covered || !answer.pending.empty() || (no_room && !answer.cells.empty())) &&
                Clock::now() < until;
        if (again && answer.cells.empty()) ::poll(nullptr, 0, 20);
      }
      if (!covered && trouble.empty()) trouble = "not all of the map is known yet";
      if (missing.size() > 1) trouble += "; cells missing in all: " + std::to_string(missing.size());
    } catch (const std::exception& error) {  // what came before it counts
      client_.reset();
      covered = false;
      trouble = error.what();
    }
    if (!trouble.empty()) say(trouble);
    if (!trouble.empty() && found.added.empty()) return std::nullopt;
    std::set<std::string> seen;
    for (const auto& id : cached) {
      // what was not handed out here was not asked for: it is replaced, or nothing of the area
      const bool stranger = versions_.count(id) == 0 && covered && missing.count(id) == 0;
      if (found.added.count(id) == 0 && (stranger || gone.count(id) != 0) && seen.insert(id).second)
        found.removed.push_back(id);
    }
    versions_ = std::move(held);
    return found;
  }

  /// Tell what went wrong; the caller's function must not cost him his node.
  void say(const std::string& message) const noexcept {
    try {
      if (options_.log) options_.log("shmmap: " + message);
    } catch (...) {  // NOLINT(bugprone-empty-catch): there is nobody left to tell
    }
  }

 private:
  Answer asked(const Area& area, const std::map<std::string, std::uint64_t>& held, Clock::time_point until) {
    while (!client_) {
      try {
        client_.emplace(options_.client);
      } catch (const Unreachable& error) {
        if (error.code() == "no_permission" || Clock::now() >= until) throw;
        ::poll(nullptr, 0, 20);  // nobody says when it listens
      }
    }
    std::vector<Held> have;
    have.reserve(held.size());
    for (const auto& [id, version] : held) have.push_back({id, version});
    const auto left = std::chrono::duration_cast<Seconds>(until - Clock::now()).count();
    return client_->differential(area, have, {}, {layer_}, std::max(0.0, left));
  }

  const LoaderOptions options_;
  const std::string layer_;
  std::mutex mutex_;
  std::optional<Client> client_;
  std::map<std::string, std::uint64_t> versions_;
};

/// Autoware's area, of messages of any kind: a square, whatever its fields are called.
template <typename Request>
Square area_of(const Request& request) {
  return {static_cast<double>(request.area.center_x), static_cast<double>(request.area.center_y),
          static_cast<double>(request.area.radius)};
}

template <typename Request>
std::vector<std::string> ids_of(const Request& request) {
  return {request.cached_ids.begin(), request.cached_ids.end()};
}

// --- points ----------------------------------------------------------------------------------------------

/// A field of `sensor_msgs/PointCloud2`, and where its values are in shared memory.
struct PointField {
  std::string name;
  std::uint8_t datatype = 0;
  std::uint32_t count = 1, offset = 0;
  const unsigned char* from = nullptr;
  std::size_t bytes = 0;  // of one point
};

/// `sensor_msgs/PointField`'s number of a dtype; 0 where it has none: integers of 64 bits, floats of 16.
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

/// Put one field's values at their places in so many points.
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

/// The fields of a cell's points, x, y, z first, each beside the one before; `xyz32` keeps coordinates that
/// the map has in 64 bits: PCL's points have 32.
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
    const std::size_t rows = static_cast<std::size_t>(column.shape.front());
    std::uint64_t count = 1;
    for (std::size_t axis = 1; axis < column.shape.size(); ++axis) count *= column.shape[axis];
    if (rows != cell.rows) throw SegmentError("segment_corrupt", cell.id + ": its columns differ in length");
    if (column.name == "xyz") {
      if (count != 3) throw SegmentError("segment_corrupt", cell.id + ": a point has not three coordinates");
      const void* from = column.data;
      if (column.dtype == "<f8") {
        const auto values = cell.column<double>("xyz");
        xyz32.resize(values.size());
        std::transform(values.begin(), values.end(), xyz32.begin(),
                       [](double one) { return static_cast<float>(one); });
        from = xyz32.data();
      } else if (column.dtype != "<f4") {
        throw BadRequest("bad_request", cell.id + ": its coordinates are " + column.dtype);
      }
      for (const char* name : {"x", "y", "z"}) add(name, datatype_of("<f4"), 1, nullptr, 4);
      fields[fields.size() - 3].from = static_cast<const unsigned char*>(from);
    } else if (const auto datatype = datatype_of(column.dtype); datatype != 0 && count != 0) {
      add(column.name, datatype, static_cast<std::size_t>(count), column.data,
          static_cast<std::size_t>(count) * bytes_of(column.dtype));
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
  // x, y, z lie side by side there as here: they are copied as one
  fields.erase(
      std::remove_if(fields.begin(), fields.end(), [](const auto& one) { return one.from == nullptr; }),
      fields.end());
  for (auto& field : fields)
    if (field.name == "x") field.bytes = 12;
  const auto points = static_cast<std::size_t>(cell.rows);
  cloud.height = 1;
  cloud.width = static_cast<std::uint32_t>(points);
  cloud.point_step = static_cast<std::uint32_t>(step);
  cloud.row_step = static_cast<std::uint32_t>(points * step);
  cloud.is_bigendian = false;
  cloud.is_dense = true;
  cloud.data.resize(points * step);
  constexpr std::size_t block = 1024;  // of points: they stay in the cache until all their fields are there
  for (std::size_t first = 0; first < points; first += block)
    for (const auto& field : fields)
      spread(field, first, std::min(block, points - first), cloud.data.data(), step);
}

}  // namespace detail

/// Answers `GetDifferentialPointCloudMap` requests: what Autoware calls a `PcdLoaderFunction`.
///
/// `Service` is `autoware_map_msgs::srv::GetDifferentialPointCloudMap`, or anything that has a `Request` and
/// a `Response` of that shape.
template <typename Service>
class PcdLoader {
 public:
  using Response = typename Service::Response;

  explicit PcdLoader(LoaderOptions options = {})
      : cells_(std::make_shared<detail::HeldCells>(std::move(options), "points")) {}

  /// What of the area the node does not hold in the version that the map has now, and which ids to remove;
  /// nullptr where it could not be fetched.  Cells come in the order of their ids, their points as Autoware's
  /// loader has them; `header.frame_id` is the map's, stamps are 0.  `request` is a pointer of any kind.
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
/// members `nr_points_`, `mean_`, `centroid_` and `icov_` that are used as there.
///
/// Voxels are in Autoware's order (x fastest, then y, then z), of at least 6 points each, unless the layer's
/// `min_points` says otherwise.  One whose covariance has no inverse has zeros in `icov_` and -1 points.
/// `centroid_` is `mean_` rounded to float32, where Autoware sums in float32: far from the map's origin its
/// sum is centimetres off.  Covariances are not filled in: once there is an inverse, nothing reads them.
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

/// Voxels where `PcdLoader` has points: the same requests, and nobody has to make voxels any more.
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

  /// As `PcdLoader` does; no value where it could not be fetched.
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
    spec.imbue(std::locale::classic());  // a point, whatever the program's language is
    spec.precision(17);
    spec << "ndt(leaf=" << resolution << ")";
    return spec.str();
  }

  std::shared_ptr<detail::HeldCells> cells_;
};

}  // namespace shmmap

#endif  // SHMMAP_AUTOWARE_HPP
