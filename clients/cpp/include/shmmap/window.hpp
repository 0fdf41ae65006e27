// SPDX-License-Identifier: Apache-2.0
//
// The cells around a moving pose, kept current.
//
//     shmmap::Window window(shmmap::Options{}, {150.0, {"points"}});
//     while (driving) {
//       try {
//         const auto update = window.move_to({x, y});                    // takes at most 0.02 s
//         for (const auto& id : update.removed) drop(id);                // removals first
//         for (const auto& cell : update.added) add(cell->id, cell->column<float>("xyz"));
//         for (const auto& cell : update.changed) replace(cell->id, cell->column<float>("xyz"));
//       } catch (const shmmap::Unreachable&) {}                          // the window keeps its cells
//     }

#ifndef SHMMAP_WINDOW_HPP
#define SHMMAP_WINDOW_HPP

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
#include <thread>
#include <utility>
#include <vector>

#include <shmmap/areas.hpp>
#include <shmmap/client.hpp>
#include <shmmap/points_around.hpp>

namespace shmmap {

/// A cell outside of the window that is still attached: metres from the pose to the nearest point of its box, the
/// bytes of its columns, and the seconds since it left.
struct RetentionCandidate {
  double distance = 0.0;
  std::uint64_t nbytes = 0;
  double age = 0.0;
};

/// Decides for each departed cell whether to keep it attached.
using RetentionPolicy = std::function<std::vector<bool>(const std::vector<RetentionCandidate>&)>;

/// Keeps departed cells up to a distance, a sum of bytes and an age, nearest first; the default keeps nothing.
struct Retention {
  double distance = 0.0;
  double max_bytes = std::numeric_limits<double>::infinity();
  double max_age = std::numeric_limits<double>::infinity();

  std::vector<bool> operator()(const std::vector<RetentionCandidate>& departed) const {
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
      if (left < 0.0) break;  // never drop a nearer cell in favour of a farther one
      kept[index] = true;
    }
    return kept;
  }
};

enum class Shape { circle, square };

struct WindowOptions {
  double radius = 150.0;                         ///< metres around the pose
  std::vector<std::string> layers = {"points"};  ///< layers of each cell
  Shape shape = Shape::circle;                   ///< `square`: Autoware's area test
  double update_distance = 20.0;   ///< metres that the pose moves before the next request
  double refresh_interval = 1.0;   ///< seconds until a request in any case: to notice map changes, and send the route
  std::optional<ZRange> z = std::nullopt;  ///< heights of interest
  RetentionPolicy retention = Retention{};  ///< which departed cells to keep attached
};

/// Changes of a window since the last `Window::move_to`.
struct WindowUpdate {
  std::vector<CellPtr> added, kept;
  std::vector<CellPtr> changed;      ///< new versions, which replace older ones
  std::vector<std::string> removed;  ///< ids that left the window in any layer
  std::vector<std::pair<std::string, std::string>> pending;
  std::vector<Failure> failed;
  bool current = false;  ///< the window is up to date for the given pose
  bool covered = true;   ///< the daemon knows all cells of the map in the window

  /// Whether the set of cells has changed.
  [[nodiscard]] bool any() const { return !added.empty() || !changed.empty() || !removed.empty(); }
  /// Whether no cell is missing.
  [[nodiscard]] bool complete() const { return current && covered && pending.empty() && failed.empty(); }
};

namespace detail {

/// A reply in processing, whose cells are mapped as time allows.
struct Arriving {
  Cells reply;
  std::vector<CellPtr> places;
  std::vector<std::size_t> gone;
  std::size_t next = 0;
};

/// A request of a window.
struct Question {
  Intent pose;
  Area area;
  Clock::time_point asked;
  bool by_name = false;  // held cells are sent by id, as is necessary after a daemon's restart
  std::string start = {};  // where it goes on, if its cells do not fit into one reply
};

}  // namespace detail

/// The cells around a moving pose.  All work is done in `move_to`, in the caller's thread, within the time limit of
/// the call; the next call processes replies that arrive later.  So it can be called in a control loop.
///
/// The daemon prefetches the cells that the window will request next: along the route of the pose, or without one
/// straight ahead and to both sides.  A radius larger than necessary has no benefit.
///
/// If the daemon fails, `move_to` throws, and the window keeps its cells.  It reconnects to a restarted daemon by
/// itself, and does not map unchanged cells again.
class Window {
 public:
  using Clock = detail::Clock;
  using LayerKey = std::pair<std::string, std::string>;  ///< id and layer

  static constexpr double default_wait = 0.02;

  /// A window that connects in `move_to`.  Throws BadRequest if an option is invalid.
  explicit Window(Options client, WindowOptions options = {})
      : Window(Client(std::move(client), nullptr), std::move(options)) {}

  /// The same, with a connected client.
  explicit Window(Client client, WindowOptions options = {})
      : client_(std::move(client)), options_(std::move(options)) {
    detail::check_circle(0.0, 0.0, options_.radius);
    if (!(options_.update_distance >= 0.0) || !(options_.refresh_interval > 0.0))
      throw BadRequest("bad_request", "a window's update_distance is not below zero, its refresh_interval above");
    if (options_.layers.empty()) throw BadRequest("bad_request", "a window has at least one layer", "such as points");
    if (options_.z && !(options_.z->min <= options_.z->max))
      throw BadRequest("bad_request", "a window's lowest z lies above its highest");
  }

  /// Set the pose, and process received replies; returns the changes since the last call.
  ///
  /// Waits until no cell is missing, at most `wait` seconds, and at most half a second for cells that do not fit into
  /// the daemon's memory, or cannot be reached.  Throws BadRequest, and errors of the connection: Unreachable if no
  /// daemon listens (at once if `wait` is below 20 ms, else after `wait`), and `no_answer` if the daemon has been
  /// silent for `Options::timeout` seconds.  The window keeps its cells.
  WindowUpdate move_to(const Intent& pose, double wait = default_wait) {
    check_pose(pose);
    if (!(wait >= 0.0)) throw BadRequest("bad_request", "wait must not be below zero");
    pose_ = pose;
    become_current(Client::after(wait), stalled_s);
    return changes_since_last();
  }

  /// Wait until no cell is missing around a pose, for a program's start; the next `move_to` returns the new cells.
  /// Returns whether the window is complete: false after `seconds`, also without a daemon, and at once if all missing
  /// cells have failed.
  bool wait_until_complete(const Intent& pose, double seconds) {
    check_pose(pose);
    pose_ = pose;
    return wait_until_complete(seconds);
  }

  /// The same around the pose of the last `move_to`; throws BadRequest before the first one.
  bool wait_until_complete(double seconds) {
    if (!pose_) throw BadRequest("bad_request", "a window waits for what is around a pose", "call move_to first");
    if (!(seconds >= 0.0)) throw BadRequest("bad_request", "the seconds to wait must not be below zero");
    for (const auto until = Client::after(seconds);; std::this_thread::sleep_for(Client::look_again)) {
      try {
        become_current(until, std::numeric_limits<double>::infinity());
        return complete();
      } catch (const Unreachable&) {  // `error()` has the reason
        if (Clock::now() + Client::look_again >= until) return complete();
      }
    }
  }

  /// Cells in the window, in the order of ids and layers.
  [[nodiscard]] std::vector<CellPtr> cells() const {
    std::vector<CellPtr> found;
    for (const auto& [key, cell] : cells_) found.push_back(cell);
    return found;
  }

  /// Version of each (id, layer) in the window; storing these keeps no cell mapped.
  [[nodiscard]] std::map<LayerKey, std::uint64_t> versions() const {
    std::map<LayerKey, std::uint64_t> found;
    for (const auto& [key, cell] : cells_) found.emplace(key, cell->version);
    return found;
  }

  /// Whether the window is up to date for the last pose, with no cell pending, failed or unknown.
  [[nodiscard]] bool complete() const { return answers() && covered_ && pending_.empty() && failed_.empty(); }

  /// Whether the window has all cells of the map within a circle, in all its layers (or in `layer`, if given).  False
  /// if the circle reaches beyond the last answered area, or touches a missing cell.
  [[nodiscard]] bool covers(double x, double y, double radius = 0.0, std::string_view layer = {}) const {
    detail::check_circle(x, y, radius);
    if (!area_ || !covered_ || !detail::contains_circle(*area_, x, y, radius)) return false;
    const auto holds = [&](const std::string& id, const std::string& of) {
      return cells_.count({id, of}) != 0 || (!layer.empty() && layer != of);
    };
    const auto lies_apart = [&](const std::optional<Box>& box) {
      return box && detail::distance_to({box->min_x, box->min_y, box->max_x, box->max_y}, x, y) > radius;
    };
    return std::all_of(pending_.begin(), pending_.end(), [&](const auto& one) { return holds(one.first, one.second); }) &&
           std::all_of(failed_.begin(), failed_.end(),
                       [&](const auto& one) { return holds(one.id, one.layer) || lies_apart(one.box); });
  }

  /// The window's cells that touch a circle, in place in memory.  `layer`: its name in the request or in cells;
  /// empty: the first layer.  Throws BadRequest if the window has no such layer.
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

  /// Error of the present or last request to the daemon; nothing if it succeeded.
  [[nodiscard]] std::optional<Error> error() const {
    if (error_ || client_.is_connected()) return error_;
    if (client_.epoch() == 0)
      return Error("no_answer", client_.path() + ": not connected yet", "the window connects by itself");
    return Error("connection_lost", client_.path() + ": the daemon ended, or was restarted",
                 "the window serves what it has, and connects again by itself");
  }
  /// Time of that error.  A daemon's end is noticed by calls of this or `error`, a hang when a reply is overdue.
  [[nodiscard]] std::optional<Clock::time_point> stale_since() {
    if (!stale_since_ && !client_.is_connected()) stale_since_ = Clock::now();
    return stale_since_;
  }

  /// Version of the map in the window.
  [[nodiscard]] std::uint64_t map_version() const noexcept { return map_version_; }
  /// The client of the window; the window's thread may use it for other requests.
  Client& client() noexcept { return client_; }

 private:
  struct Kept {
    CellPtr cell;
    Clock::time_point since;
  };

  static constexpr double pending_wait_s = 0.25, first_pause_s = 0.005, longest_pause_s = 0.5, stalled_s = 0.5;

  static void check_pose(const Intent& pose) {
    bool is_finite = std::isfinite(pose.x) && std::isfinite(pose.y) && std::isfinite(pose.vx) &&
                     std::isfinite(pose.vy) && std::isfinite(pose.heading.value_or(0.0));
    for (const auto& [x, y] : pose.route) is_finite = is_finite && std::isfinite(x) && std::isfinite(y);
    if (!is_finite) throw BadRequest("bad_request", "every number of a pose must be finite");
  }

  static detail::Sides sides_of(const Cell& cell) { return {cell.min_x, cell.min_y, cell.max_x, cell.max_y}; }

  static double seconds(Clock::duration span) { return std::chrono::duration<double>(span).count(); }

  // --- when to ask ---

  /// Whether the window is up to date for the last pose.
  [[nodiscard]] bool answers() const { return pose_ && !has_moved(*pose_); }

  [[nodiscard]] bool has_moved(const Intent& pose) const {
    if (!asked_ || !area_) return true;
    const double distance = std::hypot(pose.x - asked_->x, pose.y - asked_->y);
    return distance > 0.0 &&
           (distance >= options_.update_distance || !detail::contains_circle(*area_, pose.x, pose.y, 0.0));
  }

  /// Whether an immediate further request would be useless.
  [[nodiscard]] bool is_settled() const {
    return asked_ && covered_ && pending_.empty() && std::none_of(failed_.begin(), failed_.end(), [](const auto& one) {
             return one.code == "over_budget" || one.code == "no_space" || one.code == "offline";
           });
  }

  /// Whether to send a request although no cell is missing: the pose has moved, or time has passed.
  [[nodiscard]] bool is_due(Clock::time_point now) const {
    return has_moved(*pose_) || error_ || seconds(now - asked_at_) >= options_.refresh_interval;
  }

  /// Send requests until no cell is missing, nothing new has arrived for `stalled` seconds, or time is up.
  void become_current(Clock::time_point until, double stalled) {
    auto progressed = Clock::now();
    while (true) {
      auto pause_until = Clock::now();
      try {
        client_.check_waiting();
        if (!is_under_way()) {
          const bool is_same_place = asked_ && !has_moved(*pose_);
          if (is_settled() && !is_due(pause_until)) return;
          if (pause_until < not_before_ && (is_same_place || error_)) pause_until = not_before_;
          else ask(is_same_place && !is_settled() ? std::optional(pending_wait_s) : std::nullopt, false);
        }
        if (is_under_way()) {
          if (!take_over(until)) {
            if (error_ && error_->code() == "no_answer") throw client_.silent();
            return;
          }
          if (is_under_way()) continue;
          if (is_settled() && !has_moved(*pose_)) return;
          if (made_progress_ || !pending_.empty()) progressed = Clock::now();
        }
      } catch (const Error& error) {
        error_ = error;  // NOLINT(cppcoreguidelines-slicing): its code identifies it
        if (!stale_since_) stale_since_ = Clock::now();
        if (dynamic_cast<const Unreachable*>(&error) == nullptr) not_before_ = Client::after(0.1);
        pause_until = Clock::now() + Client::look_again;  // a starting daemon sends no notification
        if (not_before_ > pause_until || error.code() == "no_permission" || error.code() == "no_answer" ||
            pause_until >= until)
          throw;
        progressed = Clock::now();
      }
      const auto now = Clock::now();
      if (now >= until || seconds(now - progressed) >= stalled) return;
      if (pause_until > now) std::this_thread::sleep_until(std::min(pause_until, until));
    }
  }

  // --- asking ---

  [[nodiscard]] bool is_under_way() const { return arriving_ || client_.exchange_; }

  /// Begin a request for the missing cells of the area around the pose.
  void ask(std::optional<double> wait, bool by_name) {
    client_.report_unmapped();
    so_far_.reset();
    send({*pose_, area_around(*pose_), Clock::now(), by_name}, wait);
  }

  void send(detail::Question question, std::optional<double> wait) {
    question_ = std::move(question);
    const bool by_name = question_.by_name && cells_.size() <= detail::max_named;
    const auto number = client_.next_request();
    auto message = Client::begun("differential", number, 7);
    Client::write_differential(message, question_.area, by_name ? named() : std::vector<Held>{},
                               by_name ? std::vector<std::uint64_t>{} : packed(), options_.layers, wait,
                               question_.pose, question_.start);
    client_.begin(number, message.data(), "cells", wait.value_or(0.0));
  }

  /// Process the received reply; returns whether it is complete.
  bool take_over(Clock::time_point until) {
    if (!arriving_) {
      std::string reply;
      if (!client_.is_finished(reply, until)) return false;
      arriving_.emplace();
      arriving_->reply = client_.read_reply(reply);
      arriving_->places.resize(arriving_->reply.handles.size());
    }
    try {
      if (!map(until)) return false;
      finish();
    } catch (...) {
      arriving_.reset();
      throw;
    }
    return true;
  }

  /// Map cells of the reply, at least one; returns whether all are mapped.
  bool map(Clock::time_point until) {
    auto& [reply, places, gone, next] = *arriving_;
    while (next < places.size()) {
      client_.take(reply.handles[next], next, places, gone, reply.answer, until);
      ++next;
      if (Clock::now() >= until && next < places.size()) return false;
    }
    return true;
  }

  /// Apply a reply whose cells are mapped.
  void finish() {
    Answer answer = std::move(arriving_->reply.answer);
    for (auto& cell : arriving_->places)
      if (cell) answer.cells.push_back(std::move(cell));
    for (const auto at : arriving_->gone) {  // just evicted: the next reply has them
      const auto& handle = arriving_->reply.handles[at];
      answer.pending.emplace_back(client_.whole(handle.id), handle.layer);
    }
    const bool are_gone = !arriving_->gone.empty();
    if (are_gone && were_gone_) client_.check_visible();
    were_gone_ = are_gone;
    const std::string next = std::move(arriving_->reply.next);
    arriving_.reset();
    error_.reset();
    stale_since_.reset();
    if (so_far_) {
      Client::append(*so_far_, std::move(answer));
      answer = std::move(*so_far_);
      so_far_.reset();
    }
    if (!next.empty()) {  // go on with the same pose, and with the cells held before
      so_far_ = std::move(answer);
      auto question = question_;
      question.start = next;
      send(std::move(question), std::nullopt);
      return;
    }
    if (answer.epoch != epoch_ && !cells_.empty() && !question_.by_name) {
      // A restarted daemon cannot resolve versions of an earlier run, and treats those that are not current as
      // unknown.  Mapped cells stay mapped during the next request.
      earlier_ = std::move(answer.cells);
      ask(std::nullopt, true);
      made_progress_ = true;
      return;
    }
    const auto now = Clock::now();
    if (answer.map_version != map_version_ || std::any_of(answer.failed.begin(), answer.failed.end(), [](const auto& one) {
          return one.code == "over_budget";
        }))
      retained_.clear();  // they may be outdated, or conflict with cells in the window
    made_progress_ = apply(answer, now);
    asked_ = question_.pose, area_ = question_.area, asked_at_ = question_.asked;
    epoch_ = answer.epoch, map_version_ = answer.map_version, covered_ = answer.covered;
    if (!answer.layers.empty()) canonical_ = std::move(answer.layers);
    pending_ = std::move(answer.pending);
    failed_ = std::move(answer.failed);
    retain(now);
    answer.cells.clear();
    earlier_.clear();
    client_.report_unmapped();
    pause_s_ = made_progress_ || !pending_.empty() ? 0.0 : std::clamp(2.0 * pause_s_, first_pause_s, longest_pause_s);
    not_before_ = is_settled() ? now : now + std::chrono::duration_cast<Clock::duration>(detail::Seconds(pause_s_));
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

  /// Apply the new cells; returns whether there were any.
  bool apply(const Answer& answer, Clock::time_point now) {
    std::set<std::string> removed(answer.removed.begin(), answer.removed.end());
    const std::set<std::uint64_t> versions(answer.removed_versions.begin(), answer.removed_versions.end());
    if (!versions.empty()) {
      // remove all layers of a cell; if the daemon has forgotten only one of them, it sends that one again
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

  void retain(Clock::time_point now) {
    if (retained_.empty()) return;
    std::vector<RetentionCandidate> departed;
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

  // --- what has changed ---

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

  /// The name of a requested layer in cells.
  [[nodiscard]] std::string canonical(std::string_view layer) const {
    if (std::find(canonical_.begin(), canonical_.end(), layer) != canonical_.end()) return std::string(layer);
    for (std::size_t at = 0; at < options_.layers.size(); ++at)
      if (options_.layers[at] == layer) return at < canonical_.size() ? canonical_[at] : std::string(layer);
    throw BadRequest("bad_request", "the window has no layer " + std::string(layer));
  }

  Client client_;
  WindowOptions options_;
  std::optional<detail::Arriving> arriving_;
  std::optional<Answer> so_far_;  // the replies to a question before its last one
  detail::Question question_;
  bool made_progress_ = false;   // with the last reply
  bool were_gone_ = false;       // segments of the last reply
  std::vector<CellPtr> earlier_;  // cells of a reply that is requested again
  std::map<LayerKey, CellPtr> cells_;
  std::map<LayerKey, Kept> retained_;
  std::map<LayerKey, std::uint64_t> seen_;
  std::vector<std::pair<std::string, std::string>> pending_;
  std::vector<Failure> failed_;
  std::vector<std::string> canonical_;
  std::optional<Intent> pose_, asked_;
  std::optional<Area> area_;
  std::optional<Error> error_;
  std::optional<Clock::time_point> stale_since_;
  Clock::time_point asked_at_{}, not_before_{};  // time of the last request; earliest time of the next
  double pause_s_ = 0.0;
  std::uint64_t epoch_ = 0, map_version_ = 0;
  bool covered_ = true;
};

}  // namespace shmmap

#endif  // SHMMAP_WINDOW_HPP
