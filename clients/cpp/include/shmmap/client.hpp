// SPDX-License-Identifier: Apache-2.0
//
// A client of the daemon.

#ifndef SHMMAP_CLIENT_HPP
#define SHMMAP_CLIENT_HPP

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <functional>
#include <iterator>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

#include <shmmap/detail/messages.hpp>
#include <shmmap/detail/socket.hpp>

#ifndef SHMMAP_FAILPOINT
#define SHMMAP_FAILPOINT(label)  // tests end the process here
#endif

namespace shmmap {

namespace detail {
using CellKey = std::pair<std::uint64_t, std::string>;  // version and layer, which identify the bytes

struct HashOfCellKey {
  std::size_t operator()(const CellKey& key) const noexcept {
    return key.first ^ std::hash<std::string>()(key.second);
  }
};

/// Versions unmapped by any thread, and not yet reported to the daemon.
class Unmapped {
 public:
  void add(const CellKey& key) noexcept {
    try {
      const std::lock_guard<std::mutex> alone(mutex_);
      keys_.push_back(key);
    } catch (...) {  // NOLINT(bugprone-empty-catch): the daemon finds out by itself, a little later
    }
  }
  std::vector<CellKey> take() {
    const std::lock_guard<std::mutex> alone(mutex_);
    return std::exchange(keys_, {});
  }

 private:
  std::mutex mutex_;
  std::vector<CellKey> keys_;
};

}  // namespace detail

/// How a client finds the daemon, and its own name and limits.
struct Options {
  std::string endpoint = {};  ///< the socket's path, or an instance's name; empty: from the environment, as for all
  std::string name = {};      ///< name of the program in `shmmap top`; at most 64 characters
  std::string shm_dir = {};   ///< where this process finds segments; empty: `SHMMAP_SHM_DIR`, or as the daemon says
  double timeout = 5.0;       ///< seconds to wait for an answer, beyond the `wait` of a request
  /// Called ten times a second while a request waits; if it returns false, the request ends with `Interrupted`.
  std::function<bool()> keep_waiting = {};
};

namespace detail {

/// A request whose answer a later call may receive.
struct Exchange {
  std::uint64_t number = 0;
  std::string message;
  std::string_view tag;  // of its answer
  double wait = 0.0;     // seconds that the daemon may take
  Clock::time_point since = Clock::now();  // or since the connection was lost
  Clock::time_point repeat_at = {};        // on silence
  double pause = 0.0;                      // until then; 0: it has not been sent on this connection
  std::string reply = {};                  // if it arrived during the wait for another answer

  [[nodiscard]] Clock::time_point overdue(double timeout) const {
    return since + std::chrono::duration_cast<Clock::duration>(Seconds(std::min(wait + timeout, 1e6)));
  }
};

inline std::string short_text(double number) {
  std::array<char, 32> text{};
  std::snprintf(text.data(), text.size(), "%.3g", number);  // NOLINT(cppcoreguidelines-pro-type-vararg)
  return text.data();
}

inline std::string variable(const char* name) {
  const char* value = std::getenv(name);  // NOLINT(concurrency-mt-unsafe): nothing here changes it
  return value != nullptr ? value : "";
}

/// Whether a directory that any user could have created belongs to this user.
inline bool is_private(const std::string& directory) {
  struct stat status {};
  return ::lstat(directory.c_str(), &status) == 0 && S_ISDIR(status.st_mode) && status.st_uid == ::geteuid() &&
         (status.st_mode & 077U) == 0;
}

/// The sockets to try, in this order.
inline std::vector<std::string> endpoints(std::string given) {
  std::string named;
  if (given.find_first_of("/.@") == std::string::npos) named.swap(given);
  if (given.empty() && named.empty()) given = variable("SHMMAP_ENDPOINT");
  if (given.compare(0, 6, "ipc://") == 0) given.erase(0, 6);
  if (!given.empty()) return {given};
  if (named.empty()) named = variable("SHMMAP_INSTANCE");
  const std::string directory = variable("SHMMAP_RUNTIME_DIR");
  const std::string file = "/" + (named.empty() ? "default" : named) + ".sock";
  if (!directory.empty()) return {directory + file};
  std::vector<std::string> found;
  const std::string users = variable("XDG_RUNTIME_DIR");  // ignored if not absolute
  if (!users.empty() && users[0] == '/') found.push_back(users + "/shmmap" + file);
  const std::string fallback = "/tmp/shmmap-" + std::to_string(::geteuid());
  if (is_private(fallback)) found.push_back(fallback + file);
  found.push_back("/run/shmmap" + file);
  return found;
}

}  // namespace detail

/// One connection to the daemon, and one session.
class Client {
 public:
  static constexpr double default_wait = 5.0;

  /// Find the daemon and open a session; throws Unreachable, ProtocolMismatch, Refused.
  explicit Client(Options options = {}) : Client(std::move(options), nullptr) {
    std::optional<Unreachable> first;  // the first error of a socket that exists
    for (auto& path : std::exchange(paths_, {})) {
      try {
        paths_ = {std::move(path)};
        connect();
        return;
      } catch (const Unreachable& error) {
        if (error.code() == "no_answer") throw;  // a daemon exists: the next socket might serve another map
        if (!first || first->code() == "no_socket") first = error;
      }
    }
    throw *first;
  }
  Client(Client&&) = default;
  Client& operator=(Client&&) = default;
  ~Client() {
    try {
      if (socket_.is_open() && !hello_) socket_.send(begun("bye", next_request(), 0).data());
    } catch (const std::exception&) {  // the session ends anyway
    }
  }

  /// All cells of an area, with errors for those that could not be loaded.  `wait`: seconds that the daemon may
  /// take to load (at most 3600); none: only cells in memory, the others are `pending` and being loaded.
  Answer area(const Area& area, const std::vector<std::string>& layers = {"points"},
              std::optional<double> wait = default_wait, const std::optional<Intent>& intent = std::nullopt) {
    return cells("area", wait, [&](detail::Writer& to, const std::optional<double>& left, const std::string& start) {
      detail::write(to, area);
      detail::write(to, layers);
      detail::write(to, left);
      detail::write(to, intent);
      to.text(start);
    }, 5);
  }

  /// Cells of an area that the client lacks, and cells that it should drop; apply removals before additions.
  /// `packed` has only versions, each of one layer of one cell.
  Answer differential(const Area& area, const std::vector<Held>& held, const std::vector<std::uint64_t>& packed = {},
                      const std::vector<std::string>& layers = {"points"},
                      std::optional<double> wait = default_wait,
                      const std::optional<Intent>& intent = std::nullopt) {
    const auto write = [&](detail::Writer& to, const std::optional<double>& left, const std::string& start) {
      write_differential(to, area, held, packed, layers, left, intent, start);
    };
    return cells("differential", wait, write, 7);
  }

  /// Cells by id, in that order.
  Answer selected(const std::vector<std::string>& ids, const std::vector<std::string>& layers = {"points"},
                  std::optional<double> wait = default_wait, const std::optional<Intent>& intent = std::nullopt) {
    check_wait(wait);
    const auto end = after(wait.value_or(0.0));
    const auto most = std::max<std::size_t>(1, detail::max_selected / std::max<std::size_t>(1, layers.size()));
    std::vector<Answer> parts;
    const auto ask = [&](std::size_t part, const std::optional<double>& left) {
      const auto first = ids.begin() + static_cast<std::ptrdiff_t>(std::min(part * most, ids.size()));
      const auto last = ids.begin() + static_cast<std::ptrdiff_t>(std::min((part + 1) * most, ids.size()));
      return one_answer("selected", left, [&](detail::Writer& to) {
        detail::write(to, std::vector<std::string>(first, last));
        detail::write(to, layers);
        detail::write(to, left);
        detail::write(to, intent);
      }, 4).first;
    };
    const std::size_t count = std::max<std::size_t>(1, (ids.size() + most - 1) / most);
    for (std::size_t part = 0; part < count; ++part)  // the last one waits, when all loads have begun
      parts.push_back(ask(part, part + 1 < count ? std::nullopt : left_of(wait, end)));
    for (std::size_t part = 0; part + 1 < count && Clock::now() < end; ++part)
      if (!parts[part].pending.empty()) parts[part] = ask(part, left_of(wait, end));
    Answer whole = std::move(parts.front());
    for (std::size_t part = 1; part < count; ++part) append(whole, std::move(parts[part]));
    return whole;
  }

  /// The cells of the map (of an area of it), whether they are in memory or not.
  MapListing metadata(const std::optional<Area>& area = std::nullopt) {
    for (int round = 0; round < rounds; ++round)
      if (auto listing = pages(area)) return std::move(*listing);
    throw Unreachable("no_answer", path_ + ": the map changed each time before its list had come", "ask again");
  }

  /// Report unmapped cells to the daemon at once; each request does so first.
  void release() {
    report_unmapped();
    const auto number = next_request();
    auto message = begun("release", number, 1);
    message.binary("", 0);
    std::string reply;
    ask(number, message.data(), "released", 0.0, reply);
  }

  /// Number of the daemon's run.
  [[nodiscard]] std::uint64_t epoch() const noexcept { return welcome_.epoch; }
  /// Version of the map in the last answer; 0 before the first one.
  [[nodiscard]] std::uint64_t map_version() const noexcept { return map_version_; }
  /// The session's number, as in `shmmap top`.
  [[nodiscard]] std::uint64_t session() const noexcept { return welcome_.session; }
  [[nodiscard]] const std::string& instance() const noexcept { return welcome_.instance; }
  /// The frame of all coordinates.
  [[nodiscard]] const std::string& frame_id() const noexcept { return welcome_.frame_id; }
  /// An id as cells have it: one without a leading slash lacks the map's directory.
  [[nodiscard]] std::string whole(const std::string& id) const {
    return !id.empty() && id.front() == '/' ? id : welcome_.id_prefix + id;
  }
  /// The connection's descriptor, for event loops: readable when the daemon has ended.
  [[nodiscard]] int fd() const noexcept { return socket_.fd(); }
  /// Whether the connection is open, as far as the kernel knows; if not, the next request reconnects.
  [[nodiscard]] bool is_connected() const noexcept { return socket_.stands(); }
  /// The daemon's socket.
  [[nodiscard]] const std::string& path() const noexcept { return path_.empty() ? paths_.front() : path_; }

 private:
  friend class Window;
  friend class EventStream;
  using Clock = detail::Clock;

  static constexpr double greeting_s = 1.0;
  static constexpr std::size_t max_request_bytes = std::size_t{4} << 20;  // a larger request ends the connection
  static constexpr std::chrono::milliseconds look_again{20};  // retry interval while no daemon listens
  static constexpr double attach_s = 0.2;  // time for the daemon to check a segment
  static constexpr int attempts = 8;
  static constexpr int rounds = 5;  // a listing restarts if the map has changed meanwhile
  static constexpr std::uint64_t page_rows = 10'000;

  static Clock::time_point after(double seconds) {
    return Clock::now() + std::chrono::duration_cast<Clock::duration>(detail::Seconds(std::min(seconds, 1e6)));
  }

  std::uint64_t next_request() { return ++request_; }

  static detail::Writer begun(std::string_view tag, std::uint64_t number, std::size_t elements) {
    detail::Writer message;
    message.array(2 + elements);
    message.text(tag);
    message.number(number);
    return message;
  }

  /// A client that connects with its first request.
  Client(Options options, std::nullptr_t)
      : options_(std::move(options)), paths_(detail::endpoints(options_.endpoint)) {
    if (options_.shm_dir.empty()) options_.shm_dir = detail::variable("SHMMAP_SHM_DIR");
  }

  // --- the connection ---

  void connect() {
    if (is_welcome(after(greeting_s))) return;
    disconnect();
    throw Unreachable("no_answer", path() + ": the daemon does not answer", "it is stopped, hung or overloaded");
  }

  void disconnect() {
    socket_ = detail::Socket();
    hello_.reset();
    if (exchange_) exchange_->pause = 0.0, exchange_->since = Clock::now();
  }

  /// Connect if there is no connection; returns whether the daemon has sent its welcome by then.
  bool is_welcome(Clock::time_point until) {
    if (!socket_.is_open()) greet();
    if (!hello_) return true;
    try {
      std::string reply;
      if (!is_answered(*hello_, "welcome", reply, until)) return false;
      detail::Reader reader(reply);
      detail::Row row(reader);
      row.get().skip(1);
      row.get().skip(1);
      welcome_ = detail::read_welcome(row);
    } catch (const Unreachable&) {
      throw;
    } catch (const Interrupted&) {
      throw;
    } catch (const Error&) {  // the connection is unusable
      disconnect();
      throw;
    }
    hello_.reset();
    paths_ = {path_};
    look_whose_segments();
    return true;
  }

  /// Connect to the first socket on which a daemon listens, and send hello.
  void greet() {
    std::optional<Unreachable> first;
    for (const auto& path : paths_) {
      try {
        socket_ = detail::Socket(path, detail::ready_of_dealer);
        path_ = path;
        break;
      } catch (const Unreachable& error) {
        if (error.code() == "no_answer") throw;  // it is there
        if (!first || first->code() == "no_socket") first = error;
      }
    }
    if (!socket_.is_open()) throw *first;
    hello_ = next_request();
    auto message = begun("hello", *hello_, 4);
    message.number(detail::protocol_major);
    message.number(detail::protocol_minor);
    message.text(options_.name);
    message.number(welcome_.session);
    socket_.send(message.data());
  }

  /// Receive until the answer to a request arrives; false if it has not by then.  Throws the error in it.
  bool is_answered(std::uint64_t number, std::string_view tag, std::string& reply, Clock::time_point until) {
    while (received(reply, until)) {
      detail::Reader reader(reply);
      detail::Row row(reader);
      const auto kind = row.get().text();
      const auto answered = row.get().number();
      if (answered == number || (answered == 0 && kind == "error")) {
        check_kind(row, kind, tag);
        return true;
      }
      row.end();
      if (exchange_ && answered == exchange_->number) exchange_->reply = reply;
    }
    return false;
  }

  static void check_kind(detail::Row& row, std::string_view kind, std::string_view tag) {
    if (kind == tag) return;
    if (kind == "error") detail::read_error(row);
    const std::string asked(tag == "welcome" ? "hello" : tag);
    throw ProtocolMismatch("protocol_mismatch", asked + " was answered by " + std::string(kind));
  }

  bool received(std::string& reply, Clock::time_point until) {
    while (true) {
      if (!options_.keep_waiting) return socket_.receive(reply, until);
      if (socket_.receive(reply, std::min(until, after(0.1)))) return true;
      if (Clock::now() >= until) return false;
      check_waiting();
    }
  }

  /// Throws Interrupted if the program ends the wait.
  void check_waiting() const {
    if (options_.keep_waiting && !options_.keep_waiting())
      throw Interrupted("interrupted", path() + ": the program has ended the wait for the daemon's answer");
  }

  static void check_size(const std::string& message) {
    if (message.size() > max_request_bytes)
      throw BadRequest("bad_request", "the request has " + std::to_string(message.size()) +
                                          " bytes, and a daemon takes at most 4 MiB",
                       "ask for fewer cells at a time, or send versions (packed) in place of names");
  }

  /// Send a request, repeatedly if necessary, until it is answered; `reply` receives the answer.
  void ask(std::uint64_t number, const std::string& message, std::string_view tag, double wait, std::string& reply) {
    check_size(message);
    const auto deadline = after(wait + options_.timeout);
    double pause = wait + 1.0;
    bool may_be_back = true;  // the first retry is immediate
    while (true) {
      try {
        connect();
        socket_.send(message);
        const auto until = std::min(deadline, after(pause));
        pause *= 2.0;
        if (is_answered(number, tag, reply, until)) return;
        if (Clock::now() >= deadline)
          throw Unreachable("no_answer", path() + ": no answer within " + detail::short_text(wait + options_.timeout) +
                                             " s", "is the daemon stopped, hung or overloaded? see `shmmap health`");
      } catch (const Refused& error) {
        if (error.code() != "no_session" || Clock::now() >= deadline) throw;
        disconnect();  // hello on a new connection takes the session over
      } catch (const Unreachable& error) {
        disconnect();
        if (error.code() == "no_answer" || error.code() == "no_permission" || Clock::now() >= deadline) throw;
        check_waiting();
        if (!std::exchange(may_be_back, false)) ::poll(nullptr, 0, look_again.count());  // it sends no notification
      }
    }
  }

  // --- a request that outlasts a call ---

  /// Prepare a request, which `is_finished` sends.
  void begin(std::uint64_t number, const std::string& message, std::string_view tag, double wait) {
    check_size(message);
    exchange_ = detail::Exchange{number, message, tag, wait};
  }

  /// Continue the prepared request: connect, greet, send, receive.  Returns whether its answer is in `reply`; false
  /// if it has not arrived by then.  After Unreachable, the request remains pending, and is sent when a daemon
  /// listens again; other errors are its answer.
  bool is_finished(std::string& reply, Clock::time_point until) {
    for (bool may_be_back = true;; may_be_back = false) {
      try {
        const auto overdue = exchange_->overdue(options_.timeout);
        if (const auto limit = std::min(until, overdue); is_welcome(limit) && is_exchanged(reply, limit)) {
          exchange_.reset();
          return true;
        }
        if (Clock::now() < overdue) return false;
        exchange_->since = Clock::now();
        throw silent();
      } catch (const Unreachable& error) {
        if (error.code() == "no_answer" && socket_.is_open()) throw;
        disconnect();
        if (!may_be_back || error.code() == "no_answer" || error.code() == "no_permission") throw;
      } catch (const Refused& error) {
        if (may_be_back && error.code() == "no_session") {
          disconnect();  // hello on a new connection takes the session over
          continue;
        }
        exchange_.reset();
        throw;
      } catch (const Interrupted&) {
        throw;
      } catch (const Error&) {
        exchange_.reset();
        throw;
      }
    }
  }

  [[nodiscard]] Unreachable silent() const {
    return Unreachable("no_answer", path() + ": the daemon does not answer",
                       "is it stopped, hung or overloaded? see `shmmap health`");
  }

  bool is_exchanged(std::string& reply, Clock::time_point until) {
    detail::Exchange& one = *exchange_;
    while (one.reply.empty()) {
      if (one.pause == 0.0 || Clock::now() >= one.repeat_at) {
        socket_.send(one.message);
        one.pause = one.pause == 0.0 ? one.wait + 1.0 : 2.0 * one.pause;
        one.repeat_at = after(one.pause);
      }
      if (is_answered(one.number, one.tag, reply, std::min(until, one.repeat_at))) return true;
      if (Clock::now() >= until) return false;
    }
    reply = std::move(one.reply);  // it arrived during the wait for another answer
    detail::Reader reader(reply);
    detail::Row row(reader);
    const auto kind = row.get().text();
    row.get().skip(1);
    check_kind(row, kind, one.tag);
    return true;
  }

  /// All pages of the map's list; nothing if it changed between them.
  std::optional<MapListing> pages(const std::optional<Area>& area) {
    MapListing listing;
    std::optional<std::uint64_t> start = 0;
    for (bool first = true; start; first = false) {
      const auto number = next_request();
      std::string reply;
      ask(number, page_request(number, area, *start), "metadata_page", 0.0, reply);
      const auto epoch = listing.epoch, map_version = listing.map_version;
      start = read_listing(reply, listing);
      if (!first && (epoch != listing.epoch || map_version != listing.map_version)) return std::nullopt;
    }
    return listing;
  }

  static std::string page_request(std::uint64_t number, const std::optional<Area>& area, std::uint64_t start) {
    auto message = begun("metadata", number, 4);
    if (area) detail::write(message, *area);
    else message.nil();
    message.nil();
    message.number(start);
    message.number(page_rows);
    return message.data();
  }

  /// Add a page of the map's list; returns where the next one starts.
  std::optional<std::uint64_t> read_listing(const std::string& reply, MapListing& listing) {
    detail::Reader reader(reply);
    detail::Row row(reader);
    row.get().skip(1);
    row.get().skip(1);
    listing.epoch = row.get().number();
    listing.map_version = map_version_ = row.get().number();
    const auto before = static_cast<std::ptrdiff_t>(listing.cells.size());
    const auto next = detail::read_page(row, listing.cells);
    for (auto cell = listing.cells.begin() + before; cell != listing.cells.end(); ++cell) cell->id = whole(cell->id);
    return next;
  }

  // --- cells ---

  static void write_differential(detail::Writer& to, const Area& area, const std::vector<Held>& held,
                                 const std::vector<std::uint64_t>& packed, const std::vector<std::string>& layers,
                                 const std::optional<double>& wait, const std::optional<Intent>& intent,
                                 const std::string& start) {
    detail::write(to, area);
    detail::write(to, layers);
    to.array(held.size());
    for (const Held& one : held) detail::write(to, one);
    to.binary(packed.data(), packed.size() * sizeof(std::uint64_t));
    detail::write(to, wait);
    detail::write(to, intent);
    to.text(start);
  }

  static void check_wait(const std::optional<double>& wait) {
    if (wait && !(*wait >= 0.0 && *wait <= 3600.0))
      throw BadRequest("bad_request", "wait is 0 to 3600 seconds, not " + detail::short_text(*wait));
  }

  /// What is left of a wait.
  static std::optional<double> left_of(const std::optional<double>& wait, Clock::time_point end) {
    if (!wait) return std::nullopt;
    return std::max(0.0, std::chrono::duration_cast<detail::Seconds>(end - Clock::now()).count());
  }

  /// Add the answer to the next part of a request.  The map may change between two of them: its version is that of
  /// the first, after which all that changed is new.
  static void append(Answer& whole, Answer&& part) {
    const auto move = [](auto& to, auto& from) {
      to.insert(to.end(), std::make_move_iterator(from.begin()), std::make_move_iterator(from.end()));
    };
    move(whole.cells, part.cells);
    move(whole.pending, part.pending);
    move(whole.failed, part.failed);
    move(whole.removed, part.removed);
    move(whole.removed_versions, part.removed_versions);
    whole.layers = std::move(part.layers);
    whole.epoch = part.epoch;
    whole.covered = whole.covered && part.covered;
    if (whole.reason.empty()) whole.reason = std::move(part.reason);
  }

  /// Ask for the cells of an area, reply after reply.  Only the last one waits for loads, so that all have begun by
  /// then; what was pending in the others is asked for again by id.
  template <typename Write>
  Answer cells(std::string_view tag, const std::optional<double>& wait, const Write& write, std::size_t elements) {
    check_wait(wait);
    const auto end = after(wait.value_or(0.0));
    const auto ask = [&](const std::string& start) {
      const auto left = left_of(wait, end);
      return one_answer(tag, left, [&](detail::Writer& to) { write(to, left, start); }, elements);
    };
    auto [whole, next] = ask({});
    if (next.empty()) return std::move(whole);
    std::set<std::pair<std::string, std::string>> late;
    while (!next.empty()) {
      late.insert(whole.pending.begin(), whole.pending.end());
      whole.pending.clear();
      auto [more, after_it] = ask(next);
      append(whole, std::move(more));
      next = std::move(after_it);
    }
    add_late(whole, late, left_of(wait, end));
    return std::move(whole);
  }

  /// Ask again for cells that were pending, and add what has become of them, in the order of a reply.
  void add_late(Answer& whole, const std::set<std::pair<std::string, std::string>>& late,
                const std::optional<double>& wait) {
    if (late.empty()) return;
    if (wait.value_or(0.0) <= 0.0) {
      whole.pending.insert(whole.pending.end(), late.begin(), late.end());
      return;
    }
    std::vector<std::string> ids;
    for (const auto& [id, layer] : late)
      if (ids.empty() || ids.back() != id) ids.push_back(id);
    Answer again = selected(ids, whole.layers, wait);
    const auto is_late = [&late](const std::string& id, const std::string& layer) { return late.count({id, layer}) != 0; };
    std::set<std::pair<std::string, std::string>> come;
    for (const auto& cell : again.cells)
      if (is_late(cell->id, cell->layer)) come.emplace(cell->id, cell->layer);
    const auto is_outdated = [&come](const CellPtr& cell) { return come.count({cell->id, cell->layer}) != 0; };
    whole.cells.erase(std::remove_if(whole.cells.begin(), whole.cells.end(), is_outdated), whole.cells.end());
    for (auto& cell : again.cells)
      if (is_late(cell->id, cell->layer)) whole.cells.push_back(std::move(cell));
    for (auto& one : again.pending)
      if (is_late(one.first, one.second)) whole.pending.push_back(std::move(one));
    for (auto& one : again.failed)  // one that is unknown has left the map
      if (one.code != "unknown_cell" && is_late(one.id, one.layer)) whole.failed.push_back(std::move(one));
    const auto key = [&whole](const CellPtr& cell) {
      return std::pair(std::string_view(cell->id),
                       std::find(whole.layers.begin(), whole.layers.end(), cell->layer) - whole.layers.begin());
    };
    std::stable_sort(whole.cells.begin(), whole.cells.end(),
                     [&](const CellPtr& one, const CellPtr& other) { return key(one) < key(other); });
  }

  /// Ask once and map the cells of the reply; returns them, and where to go on.
  template <typename Write>
  std::pair<Answer, std::string> one_answer(std::string_view tag, const std::optional<double>& wait,
                                            const Write& write, std::size_t elements) {
    report_unmapped();
    const auto deadline = after(wait.value_or(0.0) + options_.timeout);
    auto found = one_reply(tag, wait.value_or(0.0), write, elements);
    Answer& answer = found.answer;
    std::vector<CellPtr> places(found.handles.size());
    std::vector<std::size_t> gone;
    const auto limit = [] { return after(attach_s); };
    for (std::size_t at = 0; at < places.size(); ++at) take(found.handles[at], at, places, gone, answer, limit());
    for (int attempt = 0; !gone.empty() && attempt < attempts && Clock::now() < deadline; ++attempt) {
      ask_again(found.handles, places, gone, answer);
      if (!gone.empty()) check_visible();  // not at first: a daemon that ends removes all its segments
    }
    for (const auto at : gone) answer.pending.emplace_back(whole(found.handles[at].id), found.handles[at].layer);
    for (auto& cell : places)
      if (cell) answer.cells.push_back(std::move(cell));
    return {std::move(answer), std::move(found.next)};
  }

  template <typename Write>
  detail::Cells one_reply(std::string_view tag, double wait, const Write& write, std::size_t elements) {
    const auto number = next_request();
    auto message = begun(tag, number, elements);
    write(message);
    std::string reply;
    ask(number, message.data(), "cells", wait, reply);
    return read_reply(reply);
  }

  /// The answer to a request for cells, before anything is mapped.
  detail::Cells read_reply(const std::string& reply) {
    SHMMAP_FAILPOINT("client.answer");
    detail::Reader reader(reply);
    detail::Row row(reader);
    row.get().skip(1);
    row.get().skip(1);
    auto found = detail::read_cells(reader, row);
    map_version_ = found.answer.map_version;
    for (auto& [id, layer] : found.answer.pending) id = whole(id);
    for (auto& failure : found.answer.failed)
      if (failure.code != "unknown_cell") failure.id = whole(failure.id);
    return found;
  }

  void take(const detail::Handle& handle, std::size_t at, std::vector<CellPtr>& places,
            std::vector<std::size_t>& gone, Answer& answer, Clock::time_point until) {
    try {
      places[at] = attached(handle, until);
    } catch (const SegmentError& error) {  // the other cells are still usable
      if (error.code() == "stale_handle") gone.push_back(at);
      else if (error.code() == "segment_corrupt")
        answer.failed.push_back({whole(handle.id), handle.layer, "load_failed", error.what()});
      else throw;
    }
  }

  /// Request the handles again whose segments were removed before they could be attached.
  void ask_again(std::vector<detail::Handle>& handles, std::vector<CellPtr>& places, std::vector<std::size_t>& gone,
                 Answer& answer) {
    std::vector<std::string> ids, layers;
    const auto add = [](std::vector<std::string>& to, const std::string& one) {
      if (std::find(to.begin(), to.end(), one) == to.end()) to.push_back(one);
    };
    for (const auto at : gone) add(layers, handles[at].layer);
    const std::size_t most = std::max<std::size_t>(1, detail::max_selected / layers.size());
    const auto is_asked = [&ids](const std::string& id) { return std::find(ids.begin(), ids.end(), id) != ids.end(); };
    for (const auto at : gone)
      if (ids.size() < most) add(ids, handles[at].id);
    const std::optional<double> wait = options_.timeout / 2.0;
    auto found = one_reply("selected", *wait, [&](detail::Writer& to) {
      detail::write(to, ids);
      detail::write(to, layers);
      detail::write(to, wait);
    }, 3);
    std::vector<std::size_t> still;
    for (const auto at : std::exchange(gone, {})) {
      if (!is_asked(handles[at].id)) {
        still.push_back(at);
        continue;
      }
      const auto is_it = [&](const auto& one) {
        return whole(one.id) == whole(handles[at].id) && one.layer == handles[at].layer;
      };
      if (const auto handle = std::find_if(found.handles.begin(), found.handles.end(), is_it);
          handle != found.handles.end()) {
        handles[at] = *handle;
        take(handles[at], at, places, still, answer, after(attach_s));
        continue;
      }
      const auto& failed = found.answer.failed;
      if (const auto failure = std::find_if(failed.begin(), failed.end(), is_it); failure != failed.end())
        answer.failed.push_back(*failure);
      else answer.pending.emplace_back(whole(handles[at].id), handles[at].layer);
    }
    gone = std::move(still);
  }

  [[nodiscard]] const std::string& shm_dir() const {
    return options_.shm_dir.empty() ? welcome_.shm_dir : options_.shm_dir;
  }

  [[nodiscard]] std::string statistics_path() const { return shm_dir() + welcome_.segment_prefix + "statistics"; }

  /// Refuse a directory without the daemon's statistics, since a container may have a different one.
  void check_visible() const {
    if (struct stat status {}; ::lstat(statistics_path().c_str(), &status) == 0 || !socket_.stands()) return;
    throw SegmentError("segment_error", "the daemon's segments are not in " + shm_dir() + ", as this process sees it",
                       "in a container mount the daemon's directory of segments, and name it with SHMMAP_SHM_DIR "
                       "where its path differs");
  }

  void look_whose_segments() {
    struct stat status {};
    const std::string path = statistics_path();
    owner_ = ::lstat(path.c_str(), &status) == 0 ? std::optional<uid_t>(status.st_uid) : std::nullopt;
  }

  CellPtr attached(const detail::Handle& handle, Clock::time_point until) {
    auto& known = cells_[{handle.version, handle.layer}];
    if (CellPtr there = known.lock()) return there;
    CellPtr cell = attach(handle, until);
    known = cell;
    return cell;
  }

  [[nodiscard]] static detail::Descriptor opened(const detail::Handle& handle, const std::string& path,
                                                 Clock::time_point until) {
    while (true) {
      detail::Descriptor fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK));  // NOLINT
      if (fd.get() >= 0) return fd;
      if (errno != EWOULDBLOCK || Clock::now() >= until) {
        if (errno == ENOENT || errno == EWOULDBLOCK || errno == ELOOP) stale(handle);
        throw SegmentError("segment_error", path + ": " + detail::error_text(errno));
      }
      const timespec pause{0, 200'000};
      ::nanosleep(&pause, nullptr);  // the daemon is checking the segment, and does not report the end
    }
  }

  [[noreturn]] static void stale(const detail::Handle& handle) {
    throw SegmentError("stale_handle", handle.segment + " (" + handle.id + ") is gone", "ask the daemon again");
  }

  CellPtr attach(const detail::Handle& handle, Clock::time_point until) const {
    using detail::read_at;
    const auto fd = opened(handle, shm_dir() + welcome_.segment_prefix + handle.segment, until);
    SHMMAP_FAILPOINT("client.open");
    struct stat status {};
    if (::fstat(fd.get(), &status) != 0) throw SegmentError("segment_error", detail::error_text(errno));
    if (!S_ISREG(status.st_mode) || (owner_ && status.st_uid != *owner_)) stale(handle);
    struct flock lock {};
    lock.l_type = F_RDLCK;
    lock.l_whence = SEEK_SET;
    lock.l_start = static_cast<off_t>(welcome_.session);
    lock.l_len = 1;
    static_assert(sizeof(off_t) == 8, "compile with -D_FILE_OFFSET_BITS=64");
    ::fcntl(fd.get(), F_OFD_SETLK, &lock);  // NOLINT: without the lock the segment is as safe, but its user unknown
    SHMMAP_FAILPOINT("client.lock");
    const auto size = static_cast<std::uint64_t>(status.st_size);
    if (handle.offset > size || handle.bytes > size - handle.offset || size - handle.offset < 4096)
      detail::corrupt(handle, "it has not the bytes of its handle");
    const auto mapping = std::make_shared<const detail::Mapping>(fd.get(), size);
    SHMMAP_FAILPOINT("client.map");
    const unsigned char* segment = mapping->data() + handle.offset;
    if (std::memcmp(segment, "SHMMAP\0\1", 8) != 0) detail::corrupt(handle, "it is no segment");
    if (read_at<std::uint16_t>(segment, 8) != 1) detail::corrupt(handle, "it has another version");
    if (read_at<std::uint32_t>(segment, 12) != 0x01020304U) detail::corrupt(handle, "it has another byte order");
    const auto header_bytes = read_at<std::uint64_t>(segment, 16), total = read_at<std::uint64_t>(segment, 24);
    if (header_bytes < 4096 || header_bytes > total || total > size - handle.offset)
      detail::corrupt(handle, "its sizes are wrong");
    const std::uint64_t end = header_bytes - 72;
    if (detail::crc32(segment, end) != read_at<std::uint32_t>(segment, end))
      detail::corrupt(handle, "the header's checksum is wrong");
    const std::shared_ptr<Cell> cell(
        new Cell, [unmapped = unmapped_, key = detail::CellKey(handle.version, handle.layer)](Cell* one) {
          delete one;
          unmapped->add(key);
        });
    cell->id = whole(handle.id);
    cell->layer = handle.layer;
    cell->version = handle.version;
    cell->min_x = handle.min_x, cell->min_y = handle.min_y, cell->max_x = handle.max_x, cell->max_y = handle.max_y;
    cell->stale = handle.stale;
    cell->rows = read_at<std::uint64_t>(segment, 32);
    cell->source_points = read_at<std::uint64_t>(segment, 40);
    cell->dropped_points = read_at<std::uint64_t>(segment, 48);
    cell->z_min = read_at<double>(segment, 128);
    cell->z_max = read_at<double>(segment, 136);
    cell->frame_id = detail::text_in(segment, end, 200, handle);
    Lattice lattice;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      cell->origin[axis] = read_at<double>(segment, 144 + 8 * axis);
      lattice.leaf[axis] = read_at<double>(segment, 216 + 8 * axis);
      lattice.first[axis] = read_at<std::int64_t>(segment, 240 + 8 * axis);
      lattice.shape[axis] = read_at<std::uint64_t>(segment, 264 + 8 * axis);
    }
    if (lattice.leaf[0] != 0.0) cell->lattice = lattice;
    detail::read_columns(*cell, handle, segment, header_bytes, total);
    cell->mapping_ = mapping;
    return cell;
  }

  /// Report versions that are no longer mapped here, so that the daemon can reuse their memory at once.
  void report_unmapped() {
    std::vector<std::uint64_t> versions;
    for (const auto& key : unmapped_->take()) {
      const auto known = cells_.find(key);
      if (known == cells_.end() || !known->second.expired()) continue;  // already reported, or mapped again
      versions.push_back(key.first);
      cells_.erase(known);
    }
    if (versions.empty() || !socket_.is_open()) return;
    auto message = begun("release", next_request(), 1);
    message.binary(versions.data(), versions.size() * sizeof(std::uint64_t));
    try {
      socket_.send(message.data());  // nothing waits for the id of its answer
    } catch (const Unreachable&) {
      socket_ = detail::Socket();
    }
  }

  Options options_;
  std::vector<std::string> paths_;  // sockets to try
  std::string path_;                // of the connection
  detail::Socket socket_;
  std::optional<std::uint64_t> hello_;  // number of the unanswered hello
  std::optional<detail::Exchange> exchange_;
  detail::Welcome welcome_;
  std::uint64_t request_ = 0, map_version_ = 0;
  std::optional<uid_t> owner_;
  std::unordered_map<detail::CellKey, std::weak_ptr<const Cell>, detail::HashOfCellKey> cells_;
  std::shared_ptr<detail::Unmapped> unmapped_ = std::make_shared<detail::Unmapped>();
};

}  // namespace shmmap

#endif  // SHMMAP_CLIENT_HPP
