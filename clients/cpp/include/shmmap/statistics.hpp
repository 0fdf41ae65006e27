// SPDX-License-Identifier: Apache-2.0
//
// State and contents of the daemon, read from its statistics segment without a request.  So this also works while
// the daemon is busy, stopped, hung or dead.  The layout is in shmmap/statistics/STATISTICS.md.

#ifndef SHMMAP_STATISTICS_HPP
#define SHMMAP_STATISTICS_HPP

#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <ctime>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <shmmap/detail/message_pack.hpp>
#include <shmmap/detail/segments.hpp>
#include <shmmap/detail/socket.hpp>
#include <shmmap/errors.hpp>

namespace shmmap {

/// State of a daemon: no segment, no process, stopped by a signal, no beat for 5 s, or well.
enum class DaemonState { absent, dead, stopped, hung, healthy };

/// One number of the daemon: a counter only grows during its run, a gauge is a present amount.
struct Counter {
  std::string name, unit, help;
  bool is_gauge = false;
  std::int64_t value = 0;
};

/// Durations counted since the daemon started, four buckets an octave, from 1 us to 73 min.
struct Histogram {
  std::string name, help;
  std::int64_t sum_ns = 0;
  std::vector<std::int64_t> counts;

  /// The quantile of the durations for this share, seconds, accurate to an eighth; NaN without durations.
  [[nodiscard]] double quantile(double share) const {
    double total = 0.0, before = 0.0;
    for (const auto count : counts) total += static_cast<double>(count);
    for (std::size_t bucket = 0; bucket < counts.size(); ++bucket) {
      const auto count = static_cast<double>(counts[bucket]);
      if (count > 0.0 && before + count >= share * total) {
        const double low = lower_bound_ns(bucket);
        const double high = bucket + 1 < counts.size() ? lower_bound_ns(bucket + 1) : low;
        return (low + (high - low) * std::max(share * total - before, 0.0) / count) * 1e-9;
      }
      before += count;
    }
    return std::nan("");
  }
  /// The shortest duration that a bucket counts.
  static double lower_bound_ns(std::size_t bucket) {
    if (bucket == 0) return 0.0;
    const std::size_t octave = (bucket - 1) / 4, step = (bucket - 1) % 4;
    return std::ldexp(static_cast<double>(4 + step), static_cast<int>(octave) + 8);
  }
};

/// One segment that the daemon keeps.
struct KeptCell {
  std::string id, layer, segment;  ///< texts that are too long are cut with an ellipsis
  enum class State { resident = 1, stale, retired } state = State::resident;
  std::uint64_t version = 0, bytes = 0, points = 0, hits = 0;
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  std::int64_t last_use_monotonic_ns = 0, load_ns = 0;
  bool ahead = false;  ///< prefetched, and not requested yet
};

/// One client of the daemon.
struct ListedClient {
  std::uint64_t session = 0, cells = 0, bytes = 0, requests = 0;
  std::uint32_t pid = 0;
  std::int64_t uid = -1, gid = -1;  ///< -1: unknown
  std::string client, command;
  std::int64_t last_request_monotonic_ns = 0;
  std::optional<std::array<double, 2>> pose = std::nullopt;  ///< metres
  std::optional<double> heading = std::nullopt;              ///< radians
};

/// One live map.
struct KeptLiveMap {
  std::string name, path, problem;
  std::int64_t chunks = 0, active = 0, bytes = 0, loading = 0, dirty = 0, saving = 0, waiting_bytes = 0, files = 0,
               file_bytes = 0, scans = 0, durable = 0, budget_bytes = 0, damaged = 0, mappers = 0, change = 0;
};

/// All statistics at one point in time.
struct Statistics {
  DaemonState state = DaemonState::absent;
  double beat_age = 0.0;  ///< seconds since the daemon last wrote
  std::map<std::string, std::string> identity;  ///< `pid`, `epoch`, `instance`, `map_path`, ...
  std::vector<Counter> counters;
  std::vector<Histogram> histograms;
  std::vector<KeptCell> cells;
  std::vector<ListedClient> clients;
  std::vector<KeptLiveMap> live_maps;

  /// A counter's value by name; nothing if this daemon has no such counter.
  [[nodiscard]] std::optional<std::int64_t> value(std::string_view name) const {
    for (const auto& one : counters)
      if (one.name == name) return one.value;
    return std::nullopt;
  }
};

namespace detail {

/// The constant part of a statistics segment: offsets, and meanings of the numbers.
struct StatisticsHeader {
  std::uint64_t identity = 0, identity_bytes = 0, state = 0, state_bytes = 0, table = 0, rows = 0, row_bytes = 0,
                max_rows = 0;
  std::uint64_t buckets = 0, clients = 0, client_bytes = 0, max_clients = 0, changes = 0, live = 0, live_bytes = 0,
                max_live = 0;
  std::vector<Counter> counters;
  std::vector<Histogram> histograms;
};

[[noreturn]] inline void damaged(const std::string& path, const std::string& why) {
  throw SegmentError("segment_corrupt", path + ": " + why);
}

/// An open file of the daemon, read without mapping it.
class StatisticsFile {
 public:
  StatisticsFile() = default;
  /// Throws SegmentError; `is_there` is false if there is no such file.
  explicit StatisticsFile(std::string path) : path_(std::move(path)) {
    fd_ = Descriptor(::open(path_.c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK));  // NOLINT
    if (fd_.get() < 0) {
      if (errno == ENOENT) return;
      throw SegmentError(errno == EACCES ? "not_permitted" : "segment_error", path_ + ": " + error_text(errno));
    }
    struct stat status {};
    if (::fstat(fd_.get(), &status) != 0 || !S_ISREG(status.st_mode)) damaged(path_, "no daemon made it");
    size_ = static_cast<std::uint64_t>(status.st_size);
  }
  [[nodiscard]] bool is_there() const noexcept { return fd_.get() >= 0; }
  [[nodiscard]] int fd() const noexcept { return fd_.get(); }
  [[nodiscard]] std::uint64_t size() const noexcept { return size_; }
  [[nodiscard]] const std::string& path() const noexcept { return path_; }
  /// A range of bytes, completely.
  [[nodiscard]] std::string bytes(std::uint64_t at, std::uint64_t count) const {
    if (at > size_ || count > size_ - at) damaged(path_, "its tables lie outside of it");
    std::string found(count, '\0');
    for (std::size_t got = 0; got < found.size();) {
      const auto part = ::pread(fd_.get(), &found[got], found.size() - got, static_cast<off_t>(at + got));
      if (part <= 0) damaged(path_, "it cannot be read");
      got += static_cast<std::size_t>(part);
    }
    return found;
  }

 private:
  std::string path_;
  Descriptor fd_;
  std::uint64_t size_ = 0;
};

inline const unsigned char* raw(const std::string& text) { return reinterpret_cast<const unsigned char*>(text.data()); }

inline std::uint32_t crc32(const std::string& text, std::size_t size) { return crc32(raw(text), size); }

inline StatisticsHeader read_statistics_header(const StatisticsFile& file) {
  const std::string start = file.bytes(0, 128);
  const auto u32 = [&start](std::size_t at) { return read_at<std::uint32_t>(raw(start), at); };
  if (start.compare(0, 8, std::string_view("SHMSTAT\1", 8)) != 0) damaged(file.path(), "it is no statistics segment");
  if (const auto major = read_at<std::uint16_t>(raw(start), 8); major != 2)
    throw SegmentError("segment_corrupt", "statistics " + std::to_string(major) + "." +
                                              std::to_string(read_at<std::uint16_t>(raw(start), 10)) + " of " +
                                              (major < 2 ? "an older" : "a newer") + " daemon: this program reads 2.x");
  if (u32(12) != 0x01020304U) damaged(file.path(), "it has another byte order");
  const std::uint64_t descriptions = u32(16), count = u32(20), row = u32(24), histograms = u32(64);
  StatisticsHeader header;
  header.identity = u32(28), header.identity_bytes = u32(32), header.state = u32(36), header.state_bytes = u32(40);
  header.table = u32(44), header.rows = u32(48), header.row_bytes = u32(52), header.max_rows = u32(56);
  if (descriptions < 128 || row < 160 || row > file.size() || count + histograms > file.size() / row)
    damaged(file.path(), "its tables lie outside of it");
  const std::string described = file.bytes(descriptions, (count + histograms) * row);
  const auto sum = [&](std::size_t at, std::uint64_t first, std::uint64_t rows) {
    return crc32(start.substr(at, 60) + described.substr(first * row, rows * row), 60 + rows * row) == u32(at + 60);
  };
  if (!sum(0, 0, count) || !sum(64, count, histograms)) damaged(file.path(), "its header's checksum is wrong");
  header.buckets = u32(68), header.clients = u32(72), header.client_bytes = u32(76), header.max_clients = u32(80);
  header.changes = u32(84), header.live = u32(88), header.live_bytes = u32(92), header.max_live = u32(96);
  for (std::uint64_t number = 0; number < count + histograms; ++number) {
    const unsigned char* one = raw(described) + number * row;
    Counter counter{fixed_text(one, 32), fixed_text(one + 32, 16), fixed_text(one + 49, 111), one[48] != 0, 0};
    if (number < count) header.counters.push_back(std::move(counter));
    else header.histograms.push_back({counter.name, counter.help, 0, {}});
  }
  return header;
}

}  // namespace detail

/// Reader of an instance's statistics; the daemon need not run yet.
class StatisticsReader {
 public:
  explicit StatisticsReader(const std::string& instance = "default", const std::string& shm_dir = "/dev/shm")
      : path_(shm_dir + "/shmmap." + instance + ".statistics") {}

  /// The present statistics; without `tables` cells, clients and live maps are left out.
  /// Throws SegmentError: `not_permitted`, `segment_corrupt`.
  Statistics snapshot(bool tables = true) {
    struct stat status {};
    if (!file_.is_there() || ::fstat(file_.fd(), &status) != 0 || status.st_nlink == 0) {  // replaced by another file
      header_.reset();
      file_ = detail::StatisticsFile(path_);
    }
    Statistics found;
    if (!file_.is_there()) return found;
    if (!header_) header_ = detail::read_statistics_header(file_);
    read_identity(found);
    const auto [used, clients_used] = read_state(found);
    if (tables) {
      read_cells(found, used);
      read_clients(found, clients_used);
      read_live(found);
    }
    return found;
  }

 private:
  static constexpr int attempts = 100, table_attempts = 16;
  static constexpr double hung_after_s = 5.0;

  template <typename T>
  static T at(const std::string& text, std::uint64_t offset) {
    if (offset > text.size() || sizeof(T) > text.size() - offset)
      throw SegmentError("segment_corrupt", "the statistics end too early");
    return detail::read_at<T>(detail::raw(text), offset);
  }

  /// The newer of two blocks, at least one of which is always complete.
  template <typename IsWhole>
  std::string newest(std::uint64_t offset, std::uint64_t size, const IsWhole& is_whole) const {
    for (int left = attempts; left > 0; --left) {
      std::string best;
      for (const auto place : {offset, offset + size}) {
        std::string block = file_.bytes(place, size);
        const auto sequence = at<std::uint64_t>(block, 0);
        if (sequence == 0 || (!best.empty() && at<std::uint64_t>(best, 0) > sequence)) continue;
        if (is_whole(block)) best = std::move(block);
      }
      if (!best.empty()) return best;
    }
    detail::damaged(path_, "it is written over all the time, or damaged");
  }

  void read_identity(Statistics& found) const {
    const auto block = newest(header_->identity, header_->identity_bytes, [](const std::string& one) {
      const std::uint64_t length = at<std::uint32_t>(one, 8);
      return length <= one.size() - 16 &&
             detail::crc32(one.substr(0, 12) + one.substr(16, length), 12 + length) == at<std::uint32_t>(one, 12);
    });
    std::string_view left = std::string_view(block).substr(16, at<std::uint32_t>(block, 8));
    const auto next = [&left] {
      const auto end = std::min(left.find('\0'), left.size());
      const auto text = left.substr(0, end);
      left.remove_prefix(std::min(end + 1, left.size()));
      return std::string(text);
    };
    while (!left.empty()) {
      auto name = next();
      found.identity[std::move(name)] = next();
    }
  }

  std::pair<std::uint64_t, std::uint64_t> read_state(Statistics& found) const {
    const auto ends = [](const std::string& one) {
      const std::uint64_t counters = 40 + 8 * std::uint64_t{at<std::uint32_t>(one, 32)};
      const std::uint64_t histograms = counters + 16 + 8 * std::uint64_t{at<std::uint32_t>(one, counters + 12)};
      return std::pair(counters, histograms);
    };
    const auto state = newest(header_->state, header_->state_bytes, [&ends](const std::string& one) {
      try {
        const auto [counters, end] = ends(one);
        return at<std::uint32_t>(one, counters) == detail::crc32(one, counters) &&
               at<std::uint32_t>(one, end) == detail::crc32(one, end);
      } catch (const SegmentError&) {
        return false;
      }
    });
    timespec now{};
    ::clock_gettime(CLOCK_MONOTONIC, &now);
    found.beat_age = std::max(0.0, static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec) -
                                       1e-9 * static_cast<double>(at<std::int64_t>(state, 8)));
    found.state = judged(found);
    found.counters = header_->counters;
    const auto count = std::min<std::size_t>(found.counters.size(), at<std::uint32_t>(state, 32));
    for (std::size_t number = 0; number < count; ++number)
      found.counters[number].value = at<std::int64_t>(state, 40 + 8 * number);
    const auto counters = ends(state).first;
    found.histograms = header_->histograms;
    const std::uint64_t each = 1 + header_->buckets, values = at<std::uint32_t>(state, counters + 12);
    for (std::size_t number = 0; number < found.histograms.size() && (number + 1) * each <= values; ++number) {
      const auto first = counters + 16 + 8 * each * number;
      found.histograms[number].sum_ns = at<std::int64_t>(state, first);
      for (std::uint64_t bucket = 1; bucket < each; ++bucket)
        found.histograms[number].counts.push_back(at<std::int64_t>(state, first + 8 * bucket));
    }
    return {at<std::uint32_t>(state, 24), at<std::uint32_t>(state, counters + 8)};
  }

  /// State of the daemon, by the process that wrote the segment and by its last beat.
  static DaemonState judged(const Statistics& found) {
    const auto by_beat = found.beat_age <= hung_after_s ? DaemonState::healthy : DaemonState::hung;
    const auto text = [&found](const char* name) {
      const auto one = found.identity.find(name);
      return one != found.identity.end() ? one->second : std::string();
    };
    struct stat space {};
    const auto own = ::stat("/proc/self/ns/pid", &space) == 0 ? std::to_string(space.st_ino) : std::string("0");
    if (const auto theirs = text("pid_namespace"); theirs != "0" && theirs != own) return by_beat;
    const std::string pid = text("pid");
    const detail::Descriptor fd(::open(("/proc/" + pid + "/stat").c_str(), O_RDONLY | O_CLOEXEC));  // NOLINT
    std::array<char, 1024> line{};
    const auto got = fd.get() >= 0 ? ::read(fd.get(), line.data(), line.size()) : -1;
    if (got <= 0) {
      const bool is_gone = ::kill(static_cast<pid_t>(std::atol(pid.c_str())), 0) != 0 && errno == ESRCH;
      return is_gone ? DaemonState::dead : by_beat;  // processes of other users may be hidden
    }
    const std::string_view whole(line.data(), static_cast<std::size_t>(got));
    auto fields = whole.substr(std::min(whole.rfind(')') + 2, whole.size()));
    const char letter = fields.empty() ? 'X' : fields.front();
    for (int left = 19; left > 0; --left) fields.remove_prefix(std::min(fields.find(' ') + 1, fields.size()));
    if (fields.substr(0, fields.find(' ')) != text("start_time_ticks") ||
        std::string_view("ZXx").find(letter) != std::string_view::npos)
      return DaemonState::dead;
    return letter == 'T' || letter == 't' ? DaemonState::stopped : by_beat;
  }

  /// Up to `count` rows of a table, decoded, without rows that are free, being changed, or damaged.
  template <typename Read>
  void each_row(std::uint64_t offset, std::uint64_t count, std::uint64_t row_bytes, const Read& read) const {
    if (offset == 0 || row_bytes < 8 || offset > file_.size()) return;
    const std::string rows = file_.bytes(offset, std::min(count, (file_.size() - offset) / row_bytes) * row_bytes);
    for (std::size_t at_row = 0; at_row + row_bytes <= rows.size(); at_row += row_bytes) {
      const auto length = at<std::uint32_t>(rows, at_row);
      if (length == 0 || length > row_bytes - 8) continue;
      const std::string_view body = std::string_view(rows).substr(at_row + 8, length);
      if (detail::crc32(rows.substr(at_row, 4).append(body), 4 + length) != at<std::uint32_t>(rows, at_row + 4)) continue;
      detail::Reader reader(body);
      try {
        detail::Row row(reader);
        read(row);
      } catch (const ProtocolMismatch&) {
        continue;
      }
    }
  }

  void read_cells(Statistics& found, std::uint64_t used) const {
    for (int left = table_attempts; left > 0; --left) {  // a consistent state, if the daemon permits
      const auto before = at<std::uint64_t>(file_.bytes(header_->table, 8), 0);
      found.cells.clear();
      each_row(header_->rows, std::min(used, header_->max_rows), header_->row_bytes, [&found](detail::Row& row) {
        KeptCell cell;
        cell.id = row.get().text(), cell.layer = row.get().text();
        cell.version = row.get().number();
        cell.segment = row.get().text();
        const auto state = row.get().text();
        cell.state = state == "resident" ? KeptCell::State::resident
                     : state == "stale"  ? KeptCell::State::stale
                                         : KeptCell::State::retired;
        cell.bytes = row.get().number(), cell.points = row.get().number();
        detail::Row sides(row.get());
        for (double* side : {&cell.min_x, &cell.min_y, &cell.max_x, &cell.max_y}) *side = sides.get().real();
        sides.end();
        cell.hits = row.get().number();
        cell.last_use_monotonic_ns = row.get().integer(), cell.load_ns = row.get().integer();
        cell.ahead = row.get().boolean();
        found.cells.push_back(std::move(cell));
      });
      if (before % 2 == 0 && before == at<std::uint64_t>(file_.bytes(header_->table, 8), 0)) return;
    }
  }

  void read_clients(Statistics& found, std::uint64_t used) const {
    each_row(header_->clients, std::min(used, header_->max_clients), header_->client_bytes, [&found](detail::Row& row) {
      ListedClient one;
      one.session = row.get().number();
      one.pid = static_cast<std::uint32_t>(row.get().number());
      one.uid = row.get().integer(), one.gid = row.get().integer();
      one.client = row.get().text(), one.command = row.get().text();
      one.cells = row.get().number(), one.bytes = row.get().number(), one.requests = row.get().number();
      one.last_request_monotonic_ns = row.get().integer();
      if (!row.get().nil()) {
        detail::Row place(row.reader());
        one.pose = {place.get().real(), place.get().real()};
        place.end();
      }
      if (!row.get().nil()) one.heading = row.reader().real();
      found.clients.push_back(std::move(one));
    });
  }

  void read_live(Statistics& found) const {
    each_row(header_->live, header_->max_live, header_->live_bytes, [&found](detail::Row& row) {
      KeptLiveMap one;
      one.name = row.get().text(), one.path = row.get().text();
      row.get().skip(1);  // the edge of a voxel
      row.get().skip(1);  // the frame
      for (auto* value : {&one.chunks, &one.active, &one.bytes, &one.loading, &one.dirty, &one.saving,
                          &one.waiting_bytes, &one.files, &one.file_bytes, &one.scans, &one.durable, &one.budget_bytes})
        *value = row.get().integer();
      row.get().skip(1);  // names of damaged files, and of mappers
      row.get().skip(1);
      one.problem = row.get().text();
      one.change = row.get().integer();
      row.get().skip(1);  // memory beside the chunks
      row.get().skip(1);  // readers
      one.damaged = row.get().integer(), one.mappers = row.get().integer();
      found.live_maps.push_back(std::move(one));
    });
  }

  std::string path_;
  detail::StatisticsFile file_;
  std::optional<detail::StatisticsHeader> header_;
};

}  // namespace shmmap

#endif  // SHMMAP_STATISTICS_HPP
