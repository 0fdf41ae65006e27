// SPDX-License-Identifier: Apache-2.0
//
// The cells around a moving pose, kept current.
//
//     shmmap::Window window(shmmap::Client{}, {150.0, {"points"}});
//     while (driving) {
//       const auto update = window.move_to({x, y});
//       for (const auto& id : update.removed) drop(id);                // removals first
//       for (const auto& cell : update.added) add(cell->id, cell->column<float>("xyz"));
//       for (const auto& cell : update.changed) replace(cell->id, cell->column<float>("xyz"));
//     }

#ifndef SHMMAP_WINDOW_HPP
#define SHMMAP_WINDOW_HPP

#include <poll.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <shmmap/areas.hpp>
#include <shmmap/client.hpp>
#include <shmmap/detail/nothing_new.hpp>
#include <shmmap/points_around.hpp>

namespace shmmap {

/// A cell outside of the window that is still attached: metres from the pose to the nearest point of its box, the
/// bytes of its columns, and the seconds since it left.
struct Departed {
  double distance = 0.0;
  std::uint64_t nbytes = 0;
  double age = 0.0;
};

/// Says of each departed cell whether to keep it attached.
using RetentionPolicy = std::function<std::vector<bool>(const std::vector<Departed>&)>;

/// Keeps cells up to a distance, a sum of bytes and an age, the nearest first; the default keeps nothing.
struct Retention {
  double distance = 0.0;
  double max_bytes = std::numeric_limits<double>::infinity();
  double max_age = std::numeric_limits<double>::infinity();

  std::vector<bool> operator()(const std::vector<Departed>& departed) const {
    std::vector<bool> kept(departed.size(), false);
    std::vector<std::size_t> order(departed.size());
    for (std::size_t index = 0; index < order.size(); ++index) order[index] = index;
    std::sort(order.begin(), order.end(), [&departed](std::size_t one, std::size_t other) {
      const auto key = [&departed](std::size_t at) { return std::pair(departed[at].distance, departed[at].age); };
      return key(one) < key(other);
    });
    double left = max_bytes;
    for (const auto index : order) {
      const auto& cell = departed[index];
      if (distance == 0.0 || cell.distance > distance) break;
      if (cell.age > max_age) continue;
      left -= static_cast<double>(cell.nbytes);
      if (left < 0.0) break;  // a nearer cell is never dropped for the sake of a farther one
      kept[index] = true;
    }
    return kept;
  }
};

enum class Shape { circle, square };

struct WindowOptions {
  double radius = 150.0;                         ///< metres around the pose
  std::vector<std::string> layers = {"points"};  ///< what to have of each cell
  Shape shape = Shape::circle;                   ///< `square`: Autoware's area test
  double update_distance = 20.0;   ///< metres that the pose moves before the daemon is asked again
  double refresh_interval = 1.0;   ///< seconds after which it is asked anyhow, to learn of a changed map
  std::optional<ZRange> z = std::nullopt;  ///< heights of interest
  RetentionPolicy retention = Retention{};  ///< what to keep attached of what has left the window
};

/// What happened to a window since the last `Window::move_to`.
struct WindowUpdate {
  std::vector<CellPtr> added, kept;
  std::vector<CellPtr> changed;      ///< the new ones, in place of older versions
  std::vector<std::string> removed;  ///< ids that left the window in any layer
  std::vector<std::pair<std::string, std::string>> pending;
  std::vector<Failure> failed;
  bool current = false;  ///< the window answers the pose just given
  bool covered = true;   ///< the daemon knows all that the map has in the window

  /// Whether the set of cells is another one than before.
  [[nodiscard]] bool any() const { return !added.empty() || !changed.empty() || !removed.empty(); }
  /// Whether nothing in it is missing.
  [[nodiscard]] bool complete() const { return current && covered && pending.empty() && failed.empty(); }
};

/// The cells around a moving pose.  Everything happens in `move_to`, in the thread that calls it.
///
/// The daemon fetches what the window will ask for next: along the route of the pose, without one straight ahead and
/// to both sides of that.  A radius larger than what is needed brings nothing.
///
/// A daemon that fails costs an exception there, and the window keeps what it has; a restarted one is found again
/// by itself, and nothing that has not changed is mapped anew.
class Window {
 public:
  using Clock = detail::Clock;
  using LayerKey = std::pair<std::string, std::string>;  ///< id and layer

  /// Throws BadRequest where an option makes no sense.
  explicit Window(Client client, WindowOptions options = {})
      : client_(std::move(client)), options_(std::move(options)) {
    detail::check_circle(0.0, 0.0, options_.radius);
    if (!(options_.update_distance >= 0.0) || !(options_.refresh_interval > 0.0))
      throw BadRequest("bad_request", "a window's update_distance is not below zero, its refresh_interval above");
    if (options_.layers.empty()) throw BadRequest("bad_request", "a window has at least one layer", "such as points");
    if (options_.z && !(options_.z->min <= options_.z->max))
      throw BadRequest("bad_request", "a window's lowest z lies above its highest");
  }

  /// Tell the window the pose, and have it current: within `wait` seconds, or no longer than half a second where
  /// what is missing does not fit in the daemon's memory, or cannot be reached.  Returns what has changed since the
  /// last call.  Throws BadRequest, and whatever keeps the daemon from being asked; the window keeps what it has.
  WindowUpdate move_to(const Intent& pose, double wait = Client::default_wait) {
    bool is_finite = std::isfinite(pose.x) && std::isfinite(pose.y) && std::isfinite(pose.vx) &&
                     std::isfinite(pose.vy) && std::isfinite(pose.heading.value_or(0.0));
    for (const auto& [x, y] : pose.route) is_finite = is_finite && std::isfinite(x) && std::isfinite(y);
    if (!is_finite) throw BadRequest("bad_request", "every number of a pose must be finite");
    if (!(wait >= 0.0)) throw BadRequest("bad_request", "wait must not be below zero");
    pose_ = pose;
    try {
      become_current(wait);
    } catch (const Error& error) {
      error_ = error;  // NOLINT(cppcoreguidelines-slicing): its code says what it was
      if (!stale_since_) stale_since_ = Clock::now();
      throw;
    }
    return changes_since_last();
  }

  /// Cells in the window, in the order of ids and layers.
  [[nodiscard]] std::vector<CellPtr> cells() const {
    std::vector<CellPtr> found;
    for (const auto& [key, cell] : cells_) found.push_back(cell);
    return found;
  }

  /// Version of each (id, layer) in the window: remembering them keeps nothing mapped.
  [[nodiscard]] std::map<LayerKey, std::uint64_t> versions() const {
    std::map<LayerKey, std::uint64_t> found;
    for (const auto& [key, cell] : cells_) found.emplace(key, cell->version);
    return found;
  }

  /// Whether the window answers the last pose, and nothing in it is pending, failed or not known yet.
  [[nodiscard]] bool complete() const { return answers() && covered_ && pending_.empty() && failed_.empty(); }

  /// Whether all that the map has within a circle is in the window, in all its layers (in `layer`, if one is given).
  /// False where the circle reaches beyond what was last answered, or touches a cell that is missing.
  [[nodiscard]] bool covers(double x, double y, double radius = 0.0, std::string_view layer = {}) const {
    detail::check_circle(x, y, radius);
    if (!area_ || !covered_ || !detail::contains_circle(*area_, x, y, radius)) return false;
    const auto holds = [&](const std::string& id, const std::string& of) {  // nobody knows where else it may lie
      if (cells_.count({id, of}) != 0 || (!layer.empty() && layer != of)) return true;
      const auto box = failed_boxes_.find(id);
      return box != failed_boxes_.end() && detail::distance_to(box->second, x, y) > radius;
    };
    return std::all_of(pending_.begin(), pending_.end(), [&](const auto& one) { return holds(one.first, one.second); }) &&
           std::all_of(failed_.begin(), failed_.end(), [&](const auto& one) { return holds(one.id, one.layer); });
  }

  /// The window's cells that touch a circle, where they lie in memory.  `layer`: as it was asked for, or as cells
  /// have it; empty: the first one.  Throws BadRequest where the window has no such layer.
  [[nodiscard]] PointsAround points_around(double x, double y, double radius, std::string_view layer = {}) const {
    detail::check_circle(x, y, radius);
    const std::string name = canonical(layer.empty() ? std::string_view(options_.layers.front()) : layer);
    PointsAround found{x, y, radius, {}, covers(x, y, radius, name)};
    for (const auto& [key, cell] : cells_) {
      const auto box = sides_of(*cell);
      if (key.second == name && detail::distance_to(box, x, y) <= radius)
        found.cells.push_back({cell, detail::farthest_in(box, x, y) <= radius});
    }
    return found;
  }

  /// Why the daemon cannot be asked, or could not the last time; nothing if it could.
  [[nodiscard]] std::optional<Error> error() const {
    if (!error_ && !client_.is_connected())
      return Error("connection_lost", client_.path() + ": the daemon ended, or was restarted",
                   "the window serves what it has, and connects again by itself");
    return error_;
  }
  /// Since when; a daemon that ends is noticed when this or `error` is asked, one that hangs when a reply is overdue.
  [[nodiscard]] std::optional<Clock::time_point> stale_since() {
    if (!stale_since_ && !client_.is_connected()) stale_since_ = Clock::now();
    return stale_since_;
  }

  /// State of the map that the window shows.
  [[nodiscard]] std::uint64_t map_version() const noexcept { return map_version_; }
  /// The client that the window asks through; the window's thread may ask other things through it.
  Client& client() noexcept { return client_; }

 private:
  using Box4 = detail::Sides;
  struct Kept {
    CellPtr cell;
    Clock::time_point since;
  };

  static constexpr double pending_wait_s = 0.25, first_pause_s = 0.005, stalled_s = 0.5;

  static Box4 sides_of(const Cell& cell) { return {cell.min_x, cell.min_y, cell.max_x, cell.max_y}; }

  static double seconds(Clock::duration span) { return std::chrono::duration<double>(span).count(); }

  // --- when to ask ---

  /// Whether what is here answers the last pose.
  [[nodiscard]] bool answers() const { return pose_ && !has_moved(*pose_); }

  [[nodiscard]] bool has_moved(const Intent& pose) const {
    if (!asked_ || !area_) return true;
    const double distance = std::hypot(pose.x - asked_->x, pose.y - asked_->y);
    return distance > 0.0 &&
           (distance >= options_.update_distance || !detail::contains_circle(*area_, pose.x, pose.y, 0.0));
  }

  /// Whether asking again at once cannot bring more.
  [[nodiscard]] bool is_settled() const {
    return asked_ && covered_ && pending_.empty() && std::none_of(failed_.begin(), failed_.end(), [](const auto& one) {
             return one.code == "over_budget" || one.code == "no_space" || one.code == "offline";
           });
  }

  /// Ask until nothing is missing, nothing more comes, or time is up.
  void become_current(double wait) {
    auto now = Clock::now();
    const bool is_to_tell = told_ && detail::NothingNew::says_more(*pose_, *told_) &&
                            now - told_at_ >= detail::NothingNew::tell;
    const bool is_due = seconds(now - asked_at_) >= options_.refresh_interval || error_ || is_to_tell;
    if (is_settled() && !is_due && !has_moved(*pose_)) return;
    const auto deadline = now + std::chrono::duration_cast<Clock::duration>(detail::Seconds(std::min(wait, 1e6)));
    auto progressed = now;
    double pause = first_pause_s;
    std::optional<double> patience;
    while (true) {
      const bool progress = refresh(patience);
      error_.reset();
      stale_since_.reset();
      asked_at_ = now = Clock::now();
      if (is_settled() || now >= deadline) return;
      const double left = seconds(deadline - now);
      if (progress || !pending_.empty()) {
        progressed = now;
        pause = first_pause_s;
      } else if (seconds(now - progressed) >= stalled_s) {
        return;  // what is missing waits for memory that others have
      } else {
        ::poll(nullptr, 0, static_cast<int>(1000.0 * std::min(pause, left)));  // what was dropped has to be freed
        pause *= 2.0;
      }
      patience = std::max(0.0, std::min(pending_wait_s, left));
    }
  }

  // --- asking ---

  /// Ask the daemon once, unless it is certain that nothing would come; returns whether cells came or went.
  bool refresh(std::optional<double> wait) {
    const Intent pose = *pose_;
    const Area area = area_around(pose);
    const auto asked_at = Clock::now();
    if (asked_ && area_ && nothing_new_.certain(client_, pose, area, *asked_, *area_, map_version_, asked_at)) {
      asked_ = pose, area_ = area;
      retain(asked_at);
      return false;
    }
    const auto changes = nothing_new_.changes(client_);
    const auto ask = [&](const std::vector<Held>& by_name, const std::vector<std::uint64_t>& by_version) {
      return client_.differential(area, by_name, by_version, options_.layers, wait, pose);
    };
    Answer answer = ask({}, packed());
    if (answer.epoch != epoch_ && !cells_.empty()) {
      // Another life of the daemon cannot know what versions of an earlier one belonged to, and takes those that are
      // not current for strangers.  What was attached stays so while asking again.
      const Answer first = std::exchange(answer, ask(named(), {}));
    }
    const auto now = Clock::now();
    told_ = pose, told_at_ = asked_at;
    if (answer.map_version != map_version_ || std::any_of(answer.failed.begin(), answer.failed.end(), [](const auto& one) {
          return one.code == "over_budget";
        }))
      retained_.clear();  // it may be outdated, or in the way of what is in the window
    const bool progress = apply(answer, now);
    asked_ = pose, area_ = area;
    epoch_ = answer.epoch, map_version_ = answer.map_version, covered_ = answer.covered;
    if (!answer.layers.empty()) canonical_ = std::move(answer.layers);
    pending_ = std::move(answer.pending);
    failed_ = std::move(answer.failed);
    find_failed_boxes();
    retain(now);
    answer.cells.clear();
    client_.tell_unmapped();
    if (covered_ && pending_.empty() && failed_.empty())
      nothing_new_.got_everything(changes, epoch_, pose, asked_at);
    return progress;
  }

  [[nodiscard]] Area area_around(const Intent& pose) const {
    if (options_.shape == Shape::square) return Square{pose.x, pose.y, options_.radius, options_.z};
    return Circle{pose.x, pose.y, options_.radius, options_.z};
  }

  [[nodiscard]] std::vector<std::uint64_t> packed() const {
    std::vector<std::uint64_t> found;
    found.reserve(cells_.size());
    for (const auto& [key, cell] : cells_) found.push_back(cell->version);
    return found;
  }

  [[nodiscard]] std::vector<Held> named() const {
    std::vector<Held> found;
    for (const auto& [key, cell] : cells_) found.push_back({cell->id, cell->version, {cell->layer}});
    return found;
  }

  /// Take over what came; returns whether anything did.
  bool apply(const Answer& answer, Clock::time_point now) {
    std::set<std::string> removed(answer.removed.begin(), answer.removed.end());
    const std::set<std::uint64_t> versions(answer.removed_versions.begin(), answer.removed_versions.end());
    if (!versions.empty()) {
      // of a cell in several layers all have to go: of a single one that the daemon has forgotten, another comes
      std::map<std::string, bool> is_gone;
      for (const auto& [key, cell] : cells_) {
        auto& gone = is_gone.emplace(key.first, true).first->second;
        gone = gone && versions.count(cell->version) != 0;
      }
      for (const auto& [id, gone] : is_gone)
        if (gone) removed.insert(id);
    }
    for (auto one = cells_.begin(); one != cells_.end();) {
      if (removed.count(one->first.first) == 0) {
        ++one;
        continue;
      }
      retained_[one->first] = {one->second, now};
      one = cells_.erase(one);
    }
    for (const auto& cell : answer.cells) {
      cells_[{cell->id, cell->layer}] = cell;
      retained_.erase({cell->id, cell->layer});
    }
    return !answer.cells.empty() || !removed.empty();
  }

  /// Where the cells lie that cannot be had: replies name them, only the map's list says where they are.
  void find_failed_boxes() {
    if (boxes_of_ != map_version_) {
      boxes_of_ = map_version_;
      failed_boxes_.clear();
      sought_.clear();
    }
    bool is_known = true;
    for (const auto& one : failed_) is_known = sought_.count(one.id) != 0 && is_known;
    if (is_known) return;
    try {
      std::set<std::string> failed;
      for (const auto& one : failed_) failed.insert(one.id);
      for (const auto& cell : client_.metadata(*area_).cells)
        if (failed.count(cell.id) != 0) failed_boxes_[cell.id] = {cell.min_x, cell.min_y, cell.max_x, cell.max_y};
      sought_.insert(failed.begin(), failed.end());
    } catch (const Error&) {  // not where they lie, then: they are taken to be near
    }
  }

  void retain(Clock::time_point now) {
    if (retained_.empty()) return;
    std::vector<Departed> departed;
    for (const auto& [key, one] : retained_) {
      std::uint64_t nbytes = 0;
      for (const auto& column : one.cell->columns) nbytes += column.nbytes;
      departed.push_back({detail::distance_to(sides_of(*one.cell), asked_->x, asked_->y), nbytes, seconds(now - one.since)});
    }
    const auto keep = options_.retention ? options_.retention(departed) : std::vector<bool>(departed.size(), false);
    std::size_t at = 0;
    for (auto one = retained_.begin(); one != retained_.end(); ++at)
      one = at < keep.size() && keep[at] ? std::next(one) : retained_.erase(one);
  }

  // --- telling ---

  WindowUpdate changes_since_last() {
    WindowUpdate update;
    auto seen = versions();
    for (const auto& [key, cell] : cells_) {
      const auto before = seen_.find(key);
      (before == seen_.end() ? update.added : before->second == cell->version ? update.kept : update.changed)
          .push_back(cell);
    }
    for (const auto& [key, version] : seen_)
      if (seen.count(key) == 0 && (update.removed.empty() || update.removed.back() != key.first))
        update.removed.push_back(key.first);
    seen_ = std::move(seen);
    update.pending = pending_;
    update.failed = failed_;
    update.current = answers();
    update.covered = covered_;
    return update;
  }

  /// The name by which cells have a layer that was asked for.
  [[nodiscard]] std::string canonical(std::string_view layer) const {
    if (std::find(canonical_.begin(), canonical_.end(), layer) != canonical_.end()) return std::string(layer);
    for (std::size_t at = 0; at < options_.layers.size(); ++at)
      if (options_.layers[at] == layer) return at < canonical_.size() ? canonical_[at] : std::string(layer);
    throw BadRequest("bad_request", "the window has no layer " + std::string(layer));
  }

  Client client_;
  WindowOptions options_;
  detail::NothingNew nothing_new_;
  std::map<LayerKey, CellPtr> cells_;
  std::map<LayerKey, Kept> retained_;
  std::map<LayerKey, std::uint64_t> seen_;
  std::vector<std::pair<std::string, std::string>> pending_;
  std::vector<Failure> failed_;
  std::vector<std::string> canonical_;
  std::map<std::string, Box4> failed_boxes_;
  std::set<std::string> sought_;
  std::optional<Intent> pose_, asked_, told_;
  std::optional<Area> area_;
  std::optional<Error> error_;
  std::optional<Clock::time_point> stale_since_;
  Clock::time_point asked_at_{}, told_at_{};
  std::uint64_t epoch_ = 0, map_version_ = 0, boxes_of_ = 0;
  bool covered_ = true;
};

}  // namespace shmmap

#endif  // SHMMAP_WINDOW_HPP
