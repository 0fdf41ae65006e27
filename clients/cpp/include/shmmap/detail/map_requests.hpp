// SPDX-License-Identifier: Apache-2.0
//
// Requests that name cells by id and version, as Autoware's do; autoware.hpp makes messages of their results.

#ifndef SHMMAP_DETAIL_MAP_REQUESTS_HPP
#define SHMMAP_DETAIL_MAP_REQUESTS_HPP

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <functional>
#include <map>
#include <mutex>
#include <set>
#include <shmmap/shmmap.hpp>

namespace shmmap {

/// A cell's name for requests that carry no versions: `<id>@<version as 16 hexadecimal digits>`.
inline std::string versioned_id(const std::string& id, std::uint64_t version) {
  std::array<char, 18> text{};
  std::snprintf(text.data(), text.size(), "@%016llx",  // NOLINT(cppcoreguidelines-pro-type-vararg)
                static_cast<unsigned long long>(version));
  return id + text.data();
}

/// Id and version of such a name; of any other text, itself and no version.  Ids may contain `@`.
inline std::pair<std::string, std::optional<std::uint64_t>> split_id(const std::string& name) {
  constexpr std::size_t digits = 16;
  if (name.size() > digits && name[name.size() - digits - 1] == '@' &&
      name.find_first_not_of("0123456789abcdef", name.size() - digits) == std::string::npos) {
    std::uint64_t version = 0;
    std::from_chars(name.data() + name.size() - digits, name.data() + name.size(), version, 16);
    return {name.substr(0, name.size() - digits - 1), version};
  }
  return {name, std::nullopt};
}

/// Options of requests for cells.
struct LoaderOptions {
  Options client = {};  ///< how to find the daemon
  double wait = 10.0;   ///< seconds, at most 3600; see above
  /// Bytes of the columns of one result.  Of an area with more the nearest cells come, and the log names the rest.
  /// The default fits into a message of ROS 2, at most 2 GiB.
  std::uint64_t max_bytes = 2'100'000'000;
  /// Ids as of Autoware's loader, without versions: then a node that has a cell never gets it changed.
  bool plain_ids = false;
  /// Called in the caller's thread with a line about cells that are missing.
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
  std::vector<std::string> removed;   ///< names in the order of the request; none of a cell in `added`
  std::string frame_id;
  bool reached = false;     ///< a daemon is there
  bool answered = false;    ///< it has answered; else all may be missing
  bool complete = false;    ///< nothing is missing
  std::string trouble;      ///< why not, as a line for a log
  std::size_t missing = 0;  ///< number of cells, as far as they are known
};

/// Autoware's test of an area and a cell's box, also for areas that are infinite, negative or not a number.
inline bool touches(const Square& area, const Sides& cell) {
  const double x = as_float(area.x), y = as_float(area.y), radius = as_float(area.radius);
  const std::array<double, 2> xs{as_float(cell.min_x), as_float(cell.max_x)};
  const std::array<double, 2> ys{as_float(cell.min_y), as_float(cell.max_y)};
  if (xs[0] - radius <= x && x <= xs[1] + radius && ys[0] - radius <= y && y <= ys[1] + radius) return true;
  for (const double corner_x : xs)
    for (const double corner_y : ys)
      if (std::hypot(x - corner_x, y - corner_y) <= radius) return true;
  return false;
}

inline bool is_sensible(const Square& area) {
  return std::isfinite(area.x) && std::isfinite(area.y) && std::isfinite(area.radius) && area.radius >= 0.0;
}

inline Sides sides_of(const MapCell& cell) { return {cell.min_x, cell.min_y, cell.max_x, cell.max_y}; }

/// Who asks.
enum class Asker {
  node,     ///< a node, which keeps what it has without an answer; odd areas are refused
  service,  ///< a service, whose requesters take an empty answer for an empty map: without a daemon, or where no cell
            ///< has room in memory, nothing counts as answered; odd areas are answered as Autoware does
};

/// Answers requests that name cells by id and version.
class MapRequests {
 public:
  MapRequests(LoaderOptions options, std::string layer)
      : options_(std::move(options)), layer_(std::move(layer)) {
    if (options_.keep_waiting) options_.client.keep_waiting = options_.keep_waiting;
  }

  /// Cells of an area that `cached` lacks, each converted by `make` from its name and the mapped cell, and names to
  /// remove.  Each mapped cell is released after its conversion, so that an area may be larger than the daemon's
  /// memory.
  template <typename Make, typename Made = std::invoke_result_t<const Make&, const std::string&, const Cell&>>
  Difference<Made> difference(const Square& area, const std::vector<std::string>& cached, const Make& make,
                              Asker asker = Asker::node) {
    const std::lock_guard<std::mutex> one_at_a_time(mutex_);
    auto now = beginning<Made>(cached);
    attempt(now, asker, [&](Clock::time_point until) {
      const bool is_odd = asker == Asker::service && !is_sensible(area);
      if (!is_odd && found_at_once(now, area, make, until, asker)) return;
      now = beginning<Made>(cached);
      find_nearest(now, area, make, until, is_odd);
    });
    remove_outdated(now, cached);
    return std::move(now.found);
  }

  /// Cells by their names or ids, whatever their versions; `ids` becomes what these stand for.
  template <typename Make, typename Made = std::invoke_result_t<const Make&, const std::string&, const Cell&>>
  Difference<Made> selected(std::vector<std::string>& ids, const Make& make) {
    const std::lock_guard<std::mutex> one_at_a_time(mutex_);
    Progress<Made> now;
    attempt(now, Asker::service, [&](Clock::time_point until) {
      now.covered = true;
      for (auto& id : ids) id = client(until).whole(options_.plain_ids ? id : split_id(id).first);
      std::vector<std::string> wanted;
      std::set<std::string> seen;
      for (const auto& id : ids)
        if (seen.insert(id).second) wanted.push_back(id);
      fetch(now, wanted, make, until);
    });
    return std::move(now.found);
  }

  /// Log an error; an exception of the caller's log function does not end its node.
  void say(const std::string& message) const noexcept {
    try {
      if (options_.log) options_.log("shmmap: " + message);
    } catch (...) {  // NOLINT(bugprone-empty-catch): there is no other log
    }
  }

 private:
  using Version = std::optional<std::uint64_t>;  // none: the current one

  /// What a call has found so far.
  template <typename Made>
  struct Progress {
    Difference<Made> found;
    std::map<std::string, Version> held;         // by id: the request's cells that are not gone, and added ones
    std::map<std::string, std::string> missing;  // by id: why
    std::uint64_t bytes = 0;                     // of added cells
    bool covered = false;
    bool lacks_room = false;  // memory that others hold: failed cells may come later
    std::string trouble;      // that concerns more than one cell
  };

  /// Run the requests of a call, and note what is missing then.
  template <typename Made, typename Run>
  void attempt(Progress<Made>& now, Asker asker, const Run& run) {
    const auto end = [this] {
      return Clock::now() + std::chrono::duration_cast<Clock::duration>(Seconds(options_.wait));
    };
    bool is_away = false;
    const auto fail = [&](const std::exception& error, bool away) {  // keep the cells before the error
      client_.reset();
      now.covered = false;
      now.trouble = error.what();
      is_away = away;
    };
    try {
      auto until = end();
      if (asker == Asker::service && !client_) client(until), until = end();  // the time of cells begins with a daemon
      run(until);
    } catch (const Unreachable& error) {
      fail(error, true);
    } catch (const Interrupted& error) {
      fail(error, true);
    } catch (const ProtocolMismatch& error) {
      fail(error, true);
    } catch (const Refused& error) {
      fail(error, error.code() == "no_session" || error.code() == "busy");
    } catch (const std::exception& error) {
      fail(error, false);
    }
    auto& found = now.found;
    if (now.trouble.empty() && !now.missing.empty()) {
      now.trouble = now.missing.begin()->second;
      if (now.missing.size() > 1) now.trouble += "; cells missing in all: " + std::to_string(now.missing.size());
    }
    if (now.trouble.empty() && !now.covered) now.trouble = "not all of the map is known yet";
    found.missing = now.missing.size();
    found.trouble = now.trouble;
    found.complete = now.trouble.empty();
    found.reached = !is_away;
    found.answered = !is_away && !(asker == Asker::service && now.lacks_room && found.added.empty());
  }

  [[nodiscard]] std::string name_of(const std::string& id, std::uint64_t version) const {
    return options_.plain_ids ? id : versioned_id(id, version);
  }

  /// Id and version that a name stands for; nothing if it was not given out in this form.
  [[nodiscard]] std::optional<std::pair<std::string, Version>> cell_of(const std::string& name) const {
    auto found = options_.plain_ids ? std::pair(name, Version()) : split_id(name);
    if (found.first.empty() || found.first.front() != '/') return std::nullopt;  // given out are complete ids
    if (!options_.plain_ids && !found.second) return std::nullopt;
    return found;
  }

  template <typename Made>
  [[nodiscard]] Progress<Made> beginning(const std::vector<std::string>& cached) const {
    Progress<Made> now;
    for (const auto& name : cached)
      if (auto cell = cell_of(name)) now.held.insert_or_assign(std::move(cell->first), cell->second);
    return now;
  }

  /// Names of `cached` that stand for no current cell of the area.  A cell that could not be loaded replaces nothing.
  template <typename Made>
  void remove_outdated(Progress<Made>& now, const std::vector<std::string>& cached) const {
    std::set<std::string> seen;
    for (const auto& [id, made] : now.found.added) seen.insert(name_of(id, *now.held.at(id)));
    for (const auto& name : cached) {
      if (!seen.insert(name).second) continue;
      bool stays = !now.covered || now.missing.count(name) != 0;
      if (const auto cell = cell_of(name)) {
        const auto held = now.held.find(cell->first);
        stays = held != now.held.end() && held->second == cell->second;
      }
      if (!stays) now.found.removed.push_back(name);
    }
  }

  /// Request the area until nothing is missing.  False if that is too much for one request or one result.
  template <typename Made, typename Make>
  bool found_at_once(Progress<Made>& now, const Square& area, const Make& make, Clock::time_point until,
                     Asker asker) {
    for (bool again = true; again;) {
      std::vector<Held> held;
      held.reserve(now.held.size());
      for (const auto& [id, version] : now.held) held.push_back({id, version});
      Answer answer;
      try {
        answer = client(until).differential(area, held, {}, {layer_}, left(until));
      } catch (const BadRequest&) {  // too many cells, or ids; if the area is bad, listing it fails, too
        return false;
      }
      std::uint64_t bytes = now.bytes;
      for (const auto& cell : answer.cells) bytes += bytes_of(*cell);
      if (bytes > options_.max_bytes) return false;
      now.found.frame_id = client_->frame_id();
      now.covered = answer.covered;
      for (const auto& id : answer.removed) {
        now.held.erase(id);
        now.found.added.erase(id);
      }
      now.missing.clear();
      const bool retry = take(now, answer, make);
      // requests do not wait for a map that is not known yet
      const bool is_empty = asker == Asker::service && now.lacks_room && now.found.added.empty();
      again = (!now.covered || retry || is_empty) && Clock::now() < until && is_wanted();
      if (again && answer.cells.empty()) ::poll(nullptr, 0, 20);
    }
    return true;
  }

  /// Request the area's cells from its middle outward, a few at a time, until the result is full.
  template <typename Made, typename Make>
  void find_nearest(Progress<Made>& now, const Square& area, const Make& make, Clock::time_point until, bool is_odd) {
    auto listing = is_odd ? client(until).metadata() : client(until).metadata(area);
    now.covered = true;
    auto& cells = listing.cells;
    if (is_odd)
      cells.erase(std::remove_if(cells.begin(), cells.end(),
                                 [&area](const MapCell& cell) { return !touches(area, sides_of(cell)); }),
                  cells.end());
    const auto distance = [&area](const MapCell& cell) {
      const double metres = distance_to(sides_of(cell), area.x, area.y);
      return std::isnan(metres) ? 0.0 : metres;
    };
    std::stable_sort(cells.begin(), cells.end(), [&](const MapCell& one, const MapCell& other) {
      return distance(one) < distance(other);
    });
    std::map<std::string, Version> held;
    std::vector<std::string> wanted;
    for (const auto& cell : cells) {
      const auto has = now.held.find(cell.id);
      if (has != now.held.end()) held.insert(*has);
      if (has == now.held.end() || (has->second && *has->second != cell.version)) wanted.push_back(cell.id);
    }
    now.held = std::move(held);
    fetch(now, wanted, make, until);
  }

  /// Request cells in this order, a few at a time, until the result is full.
  template <typename Made, typename Make>
  void fetch(Progress<Made>& now, const std::vector<std::string>& wanted, const Make& make, Clock::time_point until) {
    constexpr std::size_t per_request = 64;
    now.found.frame_id = client(until).frame_id();
    for (const auto& id : wanted) now.missing[id] = id + ": the time was over before it was requested";
    bool is_full = false;
    std::vector<std::string> some;
    for (auto next = wanted.begin(); next != wanted.end() && !is_full;) {
      for (some.clear(); next != wanted.end() && some.size() < per_request; ++next) some.push_back(*next);
      for (bool again = true; again && !is_full;) {
        auto answer = client(until).selected(some, {layer_}, left(until));
        std::uint64_t bytes = now.bytes;
        const auto end = std::find_if(answer.cells.begin(), answer.cells.end(), [&](const CellPtr& cell) {
          if (!has(now, *cell)) bytes += bytes_of(*cell);
          return bytes > options_.max_bytes;
        });
        is_full = end != answer.cells.end();
        answer.cells.erase(end, answer.cells.end());
        again = take(now, answer, make) && Clock::now() < until && is_wanted();
        const auto is_here = [&now](const std::string& id) { return now.missing.count(id) == 0; };
        some.erase(std::remove_if(some.begin(), some.end(), is_here), some.end());
      }
      if (Clock::now() >= until || !is_wanted()) break;
    }
    if (is_full)
      now.trouble = "an answer of at most " + std::to_string(options_.max_bytes) + " bytes lacks " +
                    std::to_string(now.missing.size()) + " cells of the area, the farthest: ask for a smaller radius";
  }

  /// Convert cells, and note missing ones.  Returns whether some of those may come with another request.
  template <typename Made, typename Make>
  bool take(Progress<Made>& now, const Answer& answer, const Make& make) const {
    for (const auto& cell : answer.cells) {
      now.missing.erase(cell->id);
      if (has(now, *cell)) continue;
      try {
        now.found.added.insert_or_assign(cell->id, make(name_of(cell->id, cell->version), *cell));
        now.held.insert_or_assign(cell->id, cell->version);
        now.bytes += bytes_of(*cell);
      } catch (const Error& error) {  // the other cells are still usable
        now.missing[cell->id] = error.what();
      }
    }
    bool no_room = false;
    now.lacks_room = false;
    for (const auto& failure : answer.failed) {
      now.missing[failure.id] = failure.id + ": " + failure.message + " (" + failure.code + ")";
      const bool no_memory = failure.code == "over_budget", no_space = failure.code == "no_space";
      no_room = no_room || no_memory || no_space;
      now.lacks_room = now.lacks_room || (no_memory && failure.holders != 0) || no_space;
    }
    for (const auto& [id, layer] : answer.pending) now.missing[id] = id + ": it is still being loaded";
    return !answer.pending.empty() || (no_room && !answer.cells.empty());  // released cells make room
  }

  template <typename Made>
  static bool has(const Progress<Made>& now, const Cell& cell) {
    const auto held = now.held.find(cell.id);
    return held != now.held.end() && held->second == cell.version;
  }

  static std::uint64_t bytes_of(const Cell& cell) {
    std::uint64_t bytes = 0;
    for (const auto& column : cell.columns) bytes += column.nbytes;
    return bytes;
  }

  [[nodiscard]] bool is_wanted() const { return !options_.keep_waiting || options_.keep_waiting(); }

  static double left(Clock::time_point until) {
    return std::max(0.0, std::chrono::duration_cast<Seconds>(until - Clock::now()).count());
  }

  /// The connected client; waits for a daemon.
  Client& client(Clock::time_point until) {
    while (!client_) {
      try {
        client_.emplace(options_.client);
      } catch (const Unreachable& error) {
        if (error.code() == "no_permission" || Clock::now() >= until || !is_wanted()) throw;
        ::poll(nullptr, 0, 20);  // a starting daemon sends no notification
      }
    }
    return *client_;
  }

  LoaderOptions options_;
  const std::string layer_;
  std::mutex mutex_;
  std::optional<Client> client_;
};

}  // namespace detail

}  // namespace shmmap

#endif  // SHMMAP_DETAIL_MAP_REQUESTS_HPP
