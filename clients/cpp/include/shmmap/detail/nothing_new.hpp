// SPDX-License-Identifier: Apache-2.0
//
// Whether a request of a window would bring nothing: then it need not be sent.

#ifndef SHMMAP_DETAIL_NOTHING_NEW_HPP
#define SHMMAP_DETAIL_NOTHING_NEW_HPP

#include <cmath>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include <shmmap/areas.hpp>
#include <shmmap/client.hpp>
#include <shmmap/statistics.hpp>

namespace shmmap::detail {

/// Knows for certain that an answer would be empty, or does not know.
///
/// The answer depends on the map, on its cells' versions, and on which of them the area touches.  The map is the
/// same while the daemon's change counter is that of before the last request, on the same connection: the daemon
/// raises it before any reply tells of a change.  A window that got everything then, and asks for an area that
/// touches the same cells, would get nothing.  Which cells an area touches is computed here as the daemon does,
/// from the boxes of all cells around, asked for once in 50 m and state of the map.
class NothingNew {
 public:
  /// The counter as it is now, to be read before a request; nothing where it cannot be read.
  std::optional<std::uint64_t> changes(const Client& client) {
    answered_.reset();  // until the request has brought everything
    const std::pair connection(client.epoch(), client.handshakes_);
    if (connection != opened_for_) {
      opened_for_ = connection;
      counter_.reset();
      try {
        ChangeCounter counter(client.statistics_path());
        if (counter.epoch() == client.epoch()) counter_ = std::move(counter);
      } catch (const SegmentError&) {  // this user may not read it: then nothing is ever certain
      }
    }
    return counter_ ? std::optional(counter_->read()) : std::nullopt;
  }

  /// A request that was sent after `changes` was read has brought all that there is.
  void got_everything(std::optional<std::uint64_t> changes, std::uint64_t epoch, const Intent& pose,
                      Clock::time_point asked) {
    if (changes && counter_ && counter_->epoch() == epoch) answered_ = Answered{*changes, pose, asked};
  }

  /// Whether asking for an area would bring nothing to a window that last asked for `last`, of this state of the map.
  bool certain(Client& client, const Intent& pose, const Area& area, const Intent& last_pose, const Area& last,
               std::uint64_t map_version, Clock::time_point now) {
    return answered_ && counter_ && answered_->changes == counter_->read() && now - answered_->asked < tell &&
           std::hypot(pose.x - answered_->pose.x, pose.y - answered_->pose.y) < tell_m &&
           pose.route == answered_->pose.route && client.is_connected() &&
           opened_for_ == std::pair(client.epoch(), client.handshakes_) &&
           ((pose.x == last_pose.x && pose.y == last_pose.y) || touch_the_same(client, area, last, map_version));
  }

  /// The daemon is told the pose after so long or so far, anyhow.
  static constexpr Seconds tell{1.0};
  static constexpr double tell_m = 5.0, tell_mps = 1.0;

  /// Whether a pose says more of where a client goes than what the daemon was told last.
  static bool says_more(const Intent& pose, const Intent& told) {
    return pose.route != told.route || std::hypot(pose.vx - told.vx, pose.vy - told.vy) >= tell_mps ||
           std::hypot(pose.x - told.x, pose.y - told.y) >= tell_m;
  }

 private:
  static constexpr double around_m = 50.0;
  static constexpr std::size_t most_cells = 4096;

  struct Answered {
    std::uint64_t changes = 0;
    Intent pose;
    Clock::time_point asked;
  };
  struct Neighbourhood {
    std::uint64_t map_version = 0;
    Sides region;
    std::vector<Sides> boxes;
  };

  bool touch_the_same(Client& client, const Area& area, const Area& last, std::uint64_t map_version) {
    if (!around_ || around_->map_version != map_version || !lies_in(bounds(area), around_->region))
      look_around(client, area, map_version);
    if (!around_ || !lies_in(bounds(last), around_->region)) return false;
    for (const auto& box : around_->boxes)
      if (overlaps(area, box) != overlaps(last, box)) return false;
    return true;
  }

  void look_around(Client& client, const Area& area, std::uint64_t map_version) {
    around_.reset();
    if (in_vain_ == map_version) return;
    const auto sides = bounds(area);
    const Sides region{sides.min_x - around_m, sides.min_y - around_m, sides.max_x + around_m, sides.max_y + around_m};
    try {
      const auto listing = client.metadata(Box{region.min_x, region.min_y, region.max_x, region.max_y});
      if (listing.cells.size() > most_cells) {
        in_vain_ = listing.map_version;
      } else if (listing.map_version == map_version) {
        around_ = Neighbourhood{map_version, region, {}};
        for (const auto& cell : listing.cells)
          around_->boxes.push_back({cell.min_x, cell.min_y, cell.max_x, cell.max_y});
      }
    } catch (const Error&) {  // then it is not certain
    }
  }

  std::optional<std::pair<std::uint64_t, std::uint64_t>> opened_for_;
  std::optional<ChangeCounter> counter_;
  std::optional<Answered> answered_;
  std::optional<Neighbourhood> around_;
  std::uint64_t in_vain_ = 0;  // state of the map of which there are too many cells around
};

}  // namespace shmmap::detail

#endif  // SHMMAP_DETAIL_NOTHING_NEW_HPP
