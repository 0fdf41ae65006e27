// SPDX-License-Identifier: Apache-2.0
//
// State and counters of the daemon, read from its statistics segment without a request.  So this also works while
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

/// All statistics at one point in time.
struct Statistics {
  DaemonState state = DaemonState::absent;
  double beat_age = 0.0;  ///< seconds since the daemon last wrote
  std::map<std::string, std::string> identity;  ///< `pid`, `epoch`, `instance`, `map_path`, ...
  std::vector<Counter> counters;
  std::vector<Histogram> histograms;

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
  std::uint64_t identity = 0, identity_bytes = 0, state = 0, state_bytes = 0, changes = 0, buckets = 0;
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
  const std::string start = file.bytes(0, 64);
  const auto u32 = [&start](std::size_t at) { return read_at<std::uint32_t>(raw(start), at); };
  if (start.compare(0, 8, std::string_view("SHMSTAT\1", 8)) != 0) damaged(file.path(), "it is no statistics segment");
  if (const auto major = read_at<std::uint16_t>(raw(start), 8); major != 3)
    throw SegmentError("segment_corrupt", "statistics " + std::to_string(major) + "." +
                                              std::to_string(read_at<std::uint16_t>(raw(start), 10)) + " of " +
                                              (major < 3 ? "an older" : "a newer") + " daemon: this program reads 3.x");
  if (u32(12) != 0x01020304U) damaged(file.path(), "it has another byte order");
  const std::uint64_t descriptions = u32(16), row = u32(20), count = u32(24), histograms = u32(28);
  StatisticsHeader header;
  header.identity = u32(32), header.identity_bytes = u32(36), header.state = u32(40), header.state_bytes = u32(44);
  header.changes = u32(48), header.buckets = u32(52);
  if (descriptions < 64 || row < 160 || row > file.size() || count + histograms > file.size() / row)
    damaged(file.path(), "its tables lie outside of it");
  const std::string described = file.bytes(descriptions, (count + histograms) * row);
  if (crc32(start.substr(0, 60) + described, 60 + described.size()) != u32(60))
    damaged(file.path(), "its header's checksum is wrong");
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

  /// The present statistics. Throws SegmentError: `not_permitted`, `segment_corrupt`.
  Statistics snapshot() {
    struct stat status {};
    if (!file_.is_there() || ::fstat(file_.fd(), &status) != 0 || status.st_nlink == 0) {  // replaced by another file
      header_.reset();
      file_ = detail::StatisticsFile(path_);
    }
    Statistics found;
    if (!file_.is_there()) return found;
    if (!header_) header_ = detail::read_statistics_header(file_);
    read_identity(found);
    read_state(found);
    return found;
  }

 private:
  static constexpr int attempts = 100;
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

  void read_state(Statistics& found) const {
    const auto end = [](const std::string& one) {
      return 32 + 8 * (std::uint64_t{at<std::uint32_t>(one, 24)} + at<std::uint32_t>(one, 28));
    };
    const auto state = newest(header_->state, header_->state_bytes, [&end](const std::string& one) {
      const std::uint64_t size = end(one);
      return size + 4 <= one.size() && at<std::uint32_t>(one, size) == detail::crc32(one, size);
    });
    timespec now{};
    ::clock_gettime(CLOCK_MONOTONIC, &now);
    found.beat_age = std::max(0.0, static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec) -
                                       1e-9 * static_cast<double>(at<std::int64_t>(state, 8)));
    found.state = judged(found);
    found.counters = header_->counters;
    const std::uint64_t counters = at<std::uint32_t>(state, 24), values = at<std::uint32_t>(state, 28);
    for (std::uint64_t number = 0; number < std::min<std::uint64_t>(found.counters.size(), counters); ++number)
      found.counters[number].value = at<std::int64_t>(state, 32 + 8 * number);
    found.histograms = header_->histograms;
    const std::uint64_t each = 1 + header_->buckets;
    for (std::size_t number = 0; number < found.histograms.size() && (number + 1) * each <= values; ++number) {
      const auto first = 32 + 8 * (counters + each * number);
      found.histograms[number].sum_ns = at<std::int64_t>(state, first);
      for (std::uint64_t bucket = 1; bucket < each; ++bucket)
        found.histograms[number].counts.push_back(at<std::int64_t>(state, first + 8 * bucket));
    }
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

  std::string path_;
  detail::StatisticsFile file_;
  std::optional<detail::StatisticsHeader> header_;
};

}  // namespace shmmap

#endif  // SHMMAP_STATISTICS_HPP
