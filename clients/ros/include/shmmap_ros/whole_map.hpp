// SPDX-License-Identifier: Apache-2.0
//
// The map as a whole: its list of cells, again whenever it has changed, and all of its points as one cloud.
// Includes nothing of ROS.

#ifndef SHMMAP_ROS_WHOLE_MAP_HPP
#define SHMMAP_ROS_WHOLE_MAP_HPP

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <shmmap/autoware.hpp>
#include <shmmap_ros/requests.hpp>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace shmmap_ros {

/// The cells of the map, in the order of ids, and the frame of their coordinates.
struct Listing {
  std::vector<shmmap::MapCell> cells;
  std::string frame_id;
};

/// Looks for another version of the map, and notes in `Requests` whether the daemon answers.
class MapWatch {
 public:
  MapWatch(shmmap::Options options, Requests& requests) : options_(std::move(options)), requests_(requests) {
    options_.keep_waiting = [&requests] { return !requests.is_stopped(); };
  }

  /// The list of cells if it has changed since the last call; nothing without a daemon.
  std::optional<Listing> look() {
    try {
      if (!client_) client_.emplace(options_);
      static_cast<void>(client_->metadata(shmmap::Square{}));  // the few cells there, and the version
      requests_.record(true, "");
      if (version_ == client_->map_version()) return std::nullopt;
      auto listing = client_->metadata();
      version_ = listing.map_version;
      std::sort(listing.cells.begin(), listing.cells.end(),
                [](const auto& one, const auto& other) { return one.id < other.id; });
      return Listing{std::move(listing.cells), client_->frame_id()};
    } catch (const std::exception& error) {
      client_.reset();
      if (!requests_.is_stopped()) requests_.record(false, error.what());
      return std::nullopt;
    }
  }

 private:
  shmmap::Options options_;
  Requests& requests_;
  std::optional<shmmap::Client> client_;
  std::optional<std::uint64_t> version_;
};

/// Append the points of a cloud to one that has points already: fields that it has not are zero, others are left out.
template <typename Cloud>
void append(Cloud& whole, const Cloud& part) {
  const std::size_t begin = whole.data.size(), points = part.width, step = whole.point_step;
  whole.data.resize(begin + points * step);
  for (const auto& field : whole.fields) {
    const auto from = std::find_if(part.fields.begin(), part.fields.end(), [&field](const auto& one) {
      return one.name == field.name && one.datatype == field.datatype && one.count == field.count;
    });
    if (from == part.fields.end()) continue;
    constexpr std::size_t sizes[] = {0, 1, 1, 2, 2, 4, 4, 4, 8};  // of the types of PointField
    const std::size_t bytes = sizes[field.datatype] * field.count;
    for (std::size_t point = 0; point < points; ++point)
      std::memcpy(&whole.data[begin + point * step + field.offset],
                  &part.data[point * part.point_step + from->offset], bytes);
  }
  whole.width += part.width;
}

/// All points of a layer as one cloud, with the fields of the first cell that has points.  Each cell is released
/// before the next one is asked for, so the daemon's memory need not hold the map.
///
/// Throws BadRequest if they are more than `max_bytes`, and Refused (`load_failed`) if a cell is missing.
template <typename Cloud>
Cloud whole_cloud(shmmap::Client& client, const std::vector<shmmap::MapCell>& cells, const std::string& layer,
                  double wait, std::size_t max_bytes = (std::size_t{1} << 31) - 4096) {
  Cloud whole;
  double read = 0.0, all = 0.0;
  for (const auto& cell : cells) all += static_cast<double>(cell.source_bytes);
  for (const auto& cell : cells) {
    const auto found = client.selected({cell.id}, {layer}, wait);
    if (found.cells.size() != 1) {
      const auto why = found.failed.empty() ? "it was not loaded in time" : found.failed.front().message;
      throw shmmap::Refused("load_failed", cell.id + ": " + why);
    }
    read += static_cast<double>(cell.source_bytes);
    Cloud part;
    shmmap::to_point_cloud2(*found.cells.front(), part);
    if (part.width == 0) continue;
    const std::size_t step = whole.width == 0 ? part.point_step : whole.point_step;
    const std::size_t bytes = whole.data.size() + step * part.width;
    if (bytes > max_bytes)
      throw shmmap::BadRequest("bad_request", "the whole map takes about " +
                                                  std::to_string(static_cast<double>(bytes) / read * all / 1e9) +
                                                  " GB as a PointCloud2, and 2.147 GB is the most",
                               "do not publish it whole: nodes get the cells that they need from the services");
    if (whole.width == 0) whole = std::move(part);
    else append(whole, part);
  }
  whole.height = 1;
  whole.is_dense = true;
  whole.row_step = whole.point_step * whole.width;
  whole.header.frame_id = client.frame_id();
  return whole;
}

}  // namespace shmmap_ros

#endif  // SHMMAP_ROS_WHOLE_MAP_HPP
