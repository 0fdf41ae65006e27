// SPDX-License-Identifier: Apache-2.0
//
// Events of the daemon, without unnoticed gaps.  Numbered events arrive on their own socket.  Missing ones are
// requested, and those that the daemon no longer remembers are reported as `MissedEvents`.

#ifndef SHMMAP_EVENTS_HPP
#define SHMMAP_EVENTS_HPP

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <deque>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include <shmmap/client.hpp>

namespace shmmap {

/// One event: `kind` and its fields, by the names that PROTOCOL.md gives ("Events").
struct Event {
  std::string kind;
  std::uint64_t seq = 0;  ///< number within the epoch, from 1 without gaps
  std::uint64_t epoch = 0;
  std::int64_t unix_ns = 0;  ///< wall-clock time of the event
  std::vector<std::pair<std::string, detail::Value>> fields;

  /// A text by name, as `text("id")`; throws BadRequest if this kind has no such text.
  [[nodiscard]] const std::string& text(std::string_view name) const { return get<std::string>(name); }
  /// A whole number by name, as `number("version")`.
  [[nodiscard]] std::uint64_t number(std::string_view name) const { return get<std::uint64_t>(name); }
  /// A value of any type: `std::uint64_t`, `double`, `bool` or `std::string`.
  template <typename T>
  [[nodiscard]] const T& get(std::string_view name) const {
    for (const auto& [field, value] : fields)
      if (field == name)
        if (const T* found = std::get_if<T>(&value)) return *found;
    throw BadRequest("bad_request", "an event of kind " + kind + " has no such field as " + std::string(name));
  }
};

/// Lost events: request the cells again for the changes that they reported.
struct MissedEvents {
  std::uint64_t epoch = 0, first = 0, last = 0;
};

using Happening = std::variant<Event, MissedEvents>;

namespace detail {

struct KindOfEvent {
  std::string_view kind;
  std::array<std::string_view, 9> fields;
};

/// Names of the fields of an event after its kind, number, epoch and time.
inline constexpr std::array<KindOfEvent, 17> kinds_of_events{{
    {"epoch", {"what", "map_version", "cells", "adopted"}},
    {"loaded", {"id", "layer", "version", "bytes", "points", "load_ns", "again", "replaces", "ahead"}},
    {"changed", {"id", "version", "how"}},
    {"evicted", {"id", "layer", "version", "bytes", "why"}},
    {"failed", {"id", "layer", "code", "message", "retry_s"}},
    {"retried", {"id", "layer", "code"}},
    {"pressure", {"id", "layer", "code", "refused", "budget_bytes", "used_bytes", "pinned_bytes", "zombie_bytes"}},
    {"prefetch_miss", {"session", "pid", "client", "cells", "id", "layer"}},
    {"reload", {"map_version", "changed", "added", "removed", "listed", "error"}},
    {"long_turn", {"kind", "cpu_ns"}},
    {"joined", {"session", "pid", "uid", "client"}},
    {"left", {"session", "pid", "client", "bytes"}},
    {"live_started", {"maps", "chunks"}},
    {"live_ended", {"restarts"}},
    {"live_problem", {"map", "problem"}},
    {"live_damaged", {"map", "what"}},
    {"live_changed", {"map", "change"}},
}};

/// An event; of a kind unknown to this version, only the head is read.
inline Event read_event(Row& row) {
  Event event;
  event.kind = row.get().text();
  event.seq = row.get().number();
  event.epoch = row.get().number();
  event.unix_ns = static_cast<std::int64_t>(row.get().number());
  for (const auto& known : kinds_of_events) {
    if (known.kind != event.kind) continue;
    for (const auto name : known.fields) {
      if (name.empty() || !row.next()) break;
      event.fields.emplace_back(name, row.reader().value());
    }
  }
  row.end();
  return event;
}

}  // namespace detail

/// The daemon's events, in order.  After a restart of the daemon, events of its next run follow.
class EventStream {
 public:
  /// `since`: begin with the events of the last `since` seconds, as far as the daemon remembers; none: from now on.
  explicit EventStream(Options options = {}, std::optional<double> since = std::nullopt)
      : client_(std::move(options)), epoch_(client_.epoch()) {
    if (since && !(*since >= 0.0)) throw BadRequest("bad_request", "since is seconds, not below zero");
    subscribe();
    auto page = recent(0, 0, 0);
    epoch_ = page.epoch, expected_ = page.next;
    if (!since) return;
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    const auto nanoseconds = std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
    const double from = static_cast<double>(nanoseconds) - *since * 1e9;
    while (!catch_up(0, static_cast<std::uint64_t>(std::max(from, 0.0)))) epoch_ = recent(0, 0, 0).epoch;
  }

  /// The next event, or a report of lost ones; nothing after `timeout` seconds (0: only events already here).
  std::optional<Happening> next(double timeout) {
    const auto until = Client::after(timeout);
    while (ready_.empty()) {
      std::string message;
      try {
        if (!socket_.is_open()) subscribe();
        if (!socket_.receive(message, until)) return std::nullopt;
        pause_ms_ = first_pause_ms;
      } catch (const Unreachable&) {  // the daemon has ended; the start of the next one is unknown
        socket_ = detail::Socket();
        const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(until - detail::Clock::now()).count();
        if (left <= 0) return std::nullopt;
        ::poll(nullptr, 0, static_cast<int>(std::min<long long>(left, pause_ms_)));
        pause_ms_ = std::min(2 * pause_ms_, longest_pause_ms);
        continue;
      }
      take(message);
    }
    Happening first = std::move(ready_.front());
    ready_.pop_front();
    return first;
  }

  /// Number of the daemon's present run.
  [[nodiscard]] std::uint64_t epoch() const noexcept { return epoch_; }
  /// For event loops: readable when `next(0.0)` may have something; -1 while the daemon is away.
  [[nodiscard]] int fd() const noexcept { return socket_.fd(); }

 private:
  static constexpr int first_pause_ms = 20, longest_pause_ms = 500;

  struct Page {
    std::uint64_t epoch = 0, first = 0, next = 0;
    std::vector<Event> events;
  };

  void subscribe() {
    const auto& named = client_.welcome_.events;
    if (named.empty())
      throw ProtocolMismatch("protocol_mismatch", "this daemon publishes no events", "update it");
    // in another mount namespace the directory may have a different path
    const auto& path = client_.path();
    const std::string beside = path.substr(0, path.rfind('/') + 1) + named.substr(named.rfind('/') + 1);
    socket_ = detail::Socket(::access(beside.c_str(), F_OK) == 0 ? beside : named, detail::ready_of_subscriber);
  }

  Page recent(std::uint64_t after, std::uint64_t since_ns, std::uint64_t limit) {
    const auto number = client_.next_request();
    auto message = Client::begun("recent", number, 3);
    message.number(after);
    message.number(since_ns);
    message.number(limit);
    std::string reply;
    client_.ask(number, message.data(), "events", 0.0, reply);
    detail::Reader reader(reply);
    detail::Row row(reader);
    row.get().skip(1);
    row.get().skip(1);
    Page page;
    page.epoch = row.get().number(), page.first = row.get().number(), page.next = row.get().number();
    if (row.next())
      for (auto left = reader.array(); left > 0; --left) {
        detail::Row one(reader);
        page.events.push_back(detail::read_event(one));
      }
    row.end();
    return page;
  }

  static bool is_known(const Event& event) {
    return std::any_of(detail::kinds_of_events.begin(), detail::kinds_of_events.end(),
                       [&event](const auto& known) { return known.kind == event.kind; });
  }

  void take(const std::string& message) {
    detail::Reader reader(message);
    detail::Row row(reader);
    Event event = detail::read_event(row);
    if (event.epoch != epoch_) {
      miss(highest_);
      epoch_ = event.epoch, expected_ = 1, highest_ = 0;
    }
    highest_ = std::max(highest_, event.seq);
    const bool is_numbered = event.kind != "beat" && event.kind != "live_changed";
    const auto before = is_numbered ? event.seq - 1 : event.seq;
    if (before >= expected_ && !tried_to_catch_up()) miss(before);
    if (is_numbered && event.seq != expected_) return;  // a repetition
    if (is_numbered) ++expected_;
    if (is_known(event)) ready_.emplace_back(std::move(event));
  }

  /// Report missing events up to this number as lost.
  void miss(std::uint64_t last) {
    if (last < expected_) return;
    ready_.emplace_back(MissedEvents{epoch_, expected_, last});
    expected_ = last + 1;
  }

  /// Fetch missing events; false if they are from a previous run of the daemon.  If the daemon does not answer now,
  /// they are fetched when it is back.
  bool tried_to_catch_up() {
    try {
      return catch_up(expected_ - 1, 0);
    } catch (const Unreachable&) {
      return true;
    }
  }

  bool catch_up(std::uint64_t after, std::uint64_t since_ns) {
    while (true) {
      Page page = recent(after, since_ns, 500);
      if (page.epoch != epoch_) return false;
      if (page.first > after + 1 && since_ns == 0) {
        ready_.emplace_back(MissedEvents{page.epoch, after + 1, page.first - 1});
        after = page.first - 1;
      }
      const bool is_last = page.events.empty();
      for (auto& event : page.events) {
        after = event.seq;
        if (is_known(event)) ready_.emplace_back(std::move(event));
      }
      expected_ = is_last ? page.next : after + 1;
      if (is_last) return true;
    }
  }

  Client client_;
  detail::Socket socket_;
  std::deque<Happening> ready_;
  std::uint64_t epoch_ = 0, expected_ = 1, highest_ = 0;
  int pause_ms_ = first_pause_ms;
};

}  // namespace shmmap

#endif  // SHMMAP_EVENTS_HPP
