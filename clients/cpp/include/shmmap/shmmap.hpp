// SPDX-License-Identifier: Apache-2.0
//
// shmmap's client: asks the daemon for cells of a point-cloud map, and maps what it hands out.
//
//     shmmap::Client client;                                    // finds the daemon as every client does
//     auto answer = client.area(shmmap::Square{x, y, 150.0});   // Autoware's area test, metres
//     for (const auto& cell : answer.cells) {
//       auto xyz = cell->column<float>("xyz");                  // rows of three, in shared memory
//       use(xyz.data(), xyz.rows());
//     }
//
// Header-only, C++17, Linux, nothing but the C library.  What goes over the socket is in
// shmmap/protocol/PROTOCOL.md, what is mapped in shmmap/segment/LAYOUT.md; where both are silent this does as
// the Python client does.
//
// A `Client` is one connection and one session: move it, do not share it among threads.  Cells may be used by
// any thread, outlive their client and the daemon, and are unmapped with their last owner.  Nothing here starts
// threads, handles signals or keeps globals.  Whatever is read is checked first; who cannot be trusted costs an
// exception, no crash.

#ifndef SHMMAP_SHMMAP_HPP
#define SHMMAP_SHMMAP_HPP

#include <fcntl.h>
#include <poll.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <initializer_list>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <system_error>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#if !defined(__BYTE_ORDER__) || __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "segments are little-endian, and are read as they are"
#endif

#ifndef SHMMAP_FAILPOINT
#define SHMMAP_FAILPOINT(label)  // tests end the process here
#endif

namespace shmmap {

// --- errors ----------------------------------------------------------------------------------------------

/// What went wrong: `what()`; `code()` is the name that it has in the protocol and in Python, `hint()` says
/// what to do, if that is known.
class Error : public std::runtime_error {
 public:
  Error(std::string code, const std::string& message, std::string hint = "")
      : std::runtime_error(hint.empty() ? message : message + " (" + hint + ")"),
        code_(std::move(code)),
        hint_(std::move(hint)) {}
  [[nodiscard]] const std::string& code() const noexcept { return code_; }
  [[nodiscard]] const std::string& hint() const noexcept { return hint_; }

 private:
  std::string code_, hint_;
};

/// The request cannot be answered, however often it is sent.
struct BadRequest : Error { using Error::Error; };
/// There is no such column.
struct NoColumn : BadRequest { using BadRequest::BadRequest; };
/// Nobody answers: `no_socket`, `no_permission`, `stale_socket`, `connection_lost` or `no_answer`.
struct Unreachable : Error { using Error::Error; };
/// The daemon speaks another version, or no shmmap at all.
struct ProtocolMismatch : Error { using Error::Error; };
/// The daemon refused: any other code.
struct Refused : Error { using Error::Error; };
/// A segment is not what its handle says: `segment_corrupt`, or `stale_handle` where it is gone.
struct SegmentError : Error { using Error::Error; };

// --- places ----------------------------------------------------------------------------------------------

/// Lowest and highest z of an area, metres; a cell whose bounds are not known yet belongs to it.
struct ZRange {
  double min = 0.0, max = 0.0;
};

/// Cells whose nearest point is within `radius` of (x, y).
struct Circle {
  double x = 0.0, y = 0.0, radius = 0.0;
  std::optional<ZRange> z = std::nullopt;
};

/// Autoware's test: the cell's box grown by `radius` contains (x, y).
struct Square {
  double x = 0.0, y = 0.0, radius = 0.0;
  std::optional<ZRange> z = std::nullopt;
};

/// Cells that touch the rectangle.
struct Box {
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  std::optional<ZRange> z = std::nullopt;
};

using Area = std::variant<Circle, Square, Box>;

/// Where the client is and is going: it decides what stays in memory longest.  Metres, m/s, radians.
struct Intent {
  double x = 0.0, y = 0.0, vx = 0.0, vy = 0.0;
  std::optional<double> heading = std::nullopt;
  std::vector<std::array<double, 2>> route = {};
};

namespace detail {

using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

// --- MessagePack -----------------------------------------------------------------------------------------

/// Writes one message.
class Writer {
 public:
  void nil() { byte(0xc0); }
  void boolean(bool value) { byte(value ? 0xc3 : 0xc2); }
  void number(std::uint64_t value) {
    if (value < 0x80) return byte(static_cast<unsigned>(value));
    byte(0xcf);
    big_endian(value, 8);
  }
  void real(double value) {
    std::uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof bits);
    byte(0xcb);
    big_endian(bits, 8);
  }
  void array(std::size_t size) {
    byte(0xdd);
    big_endian(size, 4);
  }
  void text(std::string_view value) {
    byte(0xdb);
    big_endian(value.size(), 4);
    data_.append(value);
  }
  void binary(const void* data, std::size_t size) {
    byte(0xc6);
    big_endian(size, 4);
    data_.append(static_cast<const char*>(data), size);
  }
  [[nodiscard]] const std::string& data() const { return data_; }

 private:
  void byte(unsigned value) { data_.push_back(static_cast<char>(static_cast<unsigned char>(value))); }
  void big_endian(std::uint64_t value, unsigned bytes) {
    while (bytes-- > 0) byte(static_cast<unsigned>(value >> (8 * bytes)) & 0xffU);
  }
  std::string data_;
};

/// Reads one message; whatever does not fit is a ProtocolMismatch.
class Reader {
 public:
  explicit Reader(std::string_view data) : data_(data) {}

  /// Elements of an array, which follow.
  std::uint64_t array() {
    const unsigned tag = byte();
    if ((tag & 0xf0U) == 0x90) return tag & 0x0fU;
    if (tag == 0xdc) return big_endian(2);
    if (tag == 0xdd) return big_endian(4);
    bad("an array");
  }
  std::string_view text() {
    const unsigned tag = byte();
    if ((tag & 0xe0U) == 0xa0) return take(tag & 0x1fU);
    if (tag == 0xd9) return take(big_endian(1));
    if (tag == 0xda) return take(big_endian(2));
    if (tag == 0xdb) return take(big_endian(4));
    bad("a text");
  }
  std::string_view binary() {
    const unsigned tag = byte();
    if (tag == 0xc4) return take(big_endian(1));
    if (tag == 0xc5) return take(big_endian(2));
    if (tag == 0xc6) return take(big_endian(4));
    bad("bytes");
  }
  std::uint64_t number() {
    const unsigned tag = byte();
    if (tag < 0x80) return tag;
    if (tag >= 0xcc && tag <= 0xcf) return big_endian(1U << (tag - 0xcc));
    if (tag >= 0xd0 && tag <= 0xd3) {  // of a signed kind, but not below zero
      const unsigned bytes = 1U << (tag - 0xd0);
      const std::uint64_t value = big_endian(bytes);
      if ((value >> (8 * bytes - 1)) == 0) return value;
    }
    bad("a number that is not below zero");
  }
  double real() {
    const unsigned tag = peek();
    if (tag == 0xcb) {
      byte();
      return bits<double>(big_endian(8));
    }
    if (tag == 0xca) {
      byte();
      return static_cast<double>(bits<float>(static_cast<std::uint32_t>(big_endian(4))));
    }
    if (tag >= 0xe0) return static_cast<double>(static_cast<std::int8_t>(byte()));
    if (tag >= 0xd0 && tag <= 0xd3) {
      byte();
      const unsigned shift = 64 - 8 * (1U << (tag - 0xd0));
      return static_cast<double>(static_cast<std::int64_t>(big_endian(1U << (tag - 0xd0)) << shift) >> shift);
    }
    return static_cast<double>(number());
  }
  bool boolean() {
    const unsigned tag = byte();
    if (tag == 0xc2 || tag == 0xc3) return tag == 0xc3;
    bad("true or false");
  }
  /// Leave out so many values, whatever they are.
  void skip(std::uint64_t values) {
    for (; values > 0; --values) {  // nested ones are counted, not recursed into
      const unsigned tag = byte();
      if (tag < 0x80 || tag >= 0xe0 || tag == 0xc0 || tag == 0xc2 || tag == 0xc3) continue;
      if ((tag & 0xf0U) == 0x80) values = more(values, 2 * (tag & 0x0fU));
      else if ((tag & 0xf0U) == 0x90) values = more(values, tag & 0x0fU);
      else if ((tag & 0xe0U) == 0xa0) take(tag & 0x1fU);
      else if (tag >= 0xc4 && tag <= 0xc6) take(big_endian(1U << (tag - 0xc4)));
      else if (tag >= 0xc7 && tag <= 0xc9) take(big_endian(1U << (tag - 0xc7)) + 1);
      else if (tag == 0xca || tag == 0xcb) take(tag == 0xca ? 4 : 8);
      else if (tag >= 0xcc && tag <= 0xcf) take(1U << (tag - 0xcc));
      else if (tag >= 0xd0 && tag <= 0xd3) take(1U << (tag - 0xd0));
      else if (tag >= 0xd4 && tag <= 0xd8) take((1U << (tag - 0xd4)) + 1);
      else if (tag >= 0xd9 && tag <= 0xdb) take(big_endian(1U << (tag - 0xd9)));
      else if (tag == 0xdc || tag == 0xdd) values = more(values, big_endian(tag == 0xdc ? 2 : 4));
      else if (tag == 0xde || tag == 0xdf) values = more(values, 2 * big_endian(tag == 0xde ? 2 : 4));
      else bad("a value");
    }
  }

 private:
  template <typename To, typename From>
  static To bits(From from) {
    static_assert(sizeof(To) == sizeof(From));
    To to{};
    std::memcpy(&to, &from, sizeof to);
    return to;
  }
  [[noreturn]] static void bad(const char* wanted) {
    throw ProtocolMismatch("protocol_mismatch", std::string("the daemon's message has not ") + wanted +
                                                    " where that should be");
  }
  /// Each value takes a byte at least: a count beyond that is no count.
  std::uint64_t more(std::uint64_t values, std::uint64_t nested) const {
    if (nested > data_.size() - at_) bad("as many values as it says");
    return values + nested;
  }
  unsigned peek() const {
    if (at_ >= data_.size()) bad("a value");
    return static_cast<unsigned char>(data_[at_]);
  }
  unsigned byte() {
    const unsigned value = peek();
    ++at_;
    return value;
  }
  std::string_view take(std::uint64_t size) {
    if (size > data_.size() - at_) bad("as many bytes as it says");
    const auto found = data_.substr(at_, static_cast<std::size_t>(size));
    at_ += static_cast<std::size_t>(size);
    return found;
  }
  std::uint64_t big_endian(unsigned bytes) {
    std::uint64_t value = 0;
    for (const char one : take(bytes)) value = (value << 8) | static_cast<unsigned char>(one);
    return value;
  }
  std::string_view data_;
  std::size_t at_ = 0;
};

/// Elements of one array in a message: those that a later version added are left out, missing ones have defaults.
class Row {
 public:
  explicit Row(Reader& reader) : reader_(reader), left_(reader.array()) {}
  Row(const Row&) = delete;
  Row& operator=(const Row&) = delete;
  ~Row() = default;
  /// Whether there is another one; what it is comes next from the reader.
  bool next() { return left_ > 0 && left_-- > 0; }
  Reader& reader() { return reader_; }
  /// The next one, which has no default.
  Reader& get() {
    if (!next()) throw ProtocolMismatch("protocol_mismatch", "the daemon's message is too short");
    return reader_;
  }
  void end() { reader_.skip(std::exchange(left_, 0)); }

 private:
  Reader& reader_;
  std::uint64_t left_;
};

// --- the socket ------------------------------------------------------------------------------------------

/// A file descriptor that is closed with its owner.
class Descriptor {
 public:
  explicit Descriptor(int fd = -1) noexcept : fd_(fd) {}
  Descriptor(Descriptor&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
  Descriptor& operator=(Descriptor&& other) noexcept {
    std::swap(fd_, other.fd_);
    return *this;
  }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  ~Descriptor() {
    if (fd_ >= 0) ::close(fd_);
  }
  [[nodiscard]] int get() const noexcept { return fd_; }

 private:
  int fd_;
};

inline std::string error_text(int number) { return std::generic_category().message(number); }

/// One connection that speaks ZMTP 3.0 with the NULL mechanism, as PROTOCOL.md has it.
class Socket {
 public:
  static constexpr std::uint64_t most_bytes = std::uint64_t{1} << 30;  // of one message
  static constexpr std::size_t read_bytes = std::size_t{1} << 16;      // at once, at least

  Socket() = default;

  /// Connect and send what comes first; throws Unreachable.
  Socket(const std::string& path, std::string_view ready) : path_(path) {
    sockaddr_un address{};
    if (path.size() >= sizeof address.sun_path)
      throw Unreachable("no_socket", path + ": a socket's path has at most 107 bytes", "choose a shorter one");
    address.sun_family = AF_UNIX;
    std::memcpy(static_cast<void*>(address.sun_path), path.data(), path.size());
    fd_ = Descriptor(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
    if (fd_.get() < 0) throw Unreachable("no_socket", "no socket: " + error_text(errno));
    if (::connect(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address) != 0) refused(errno);
    std::string greeting("\xff\0\0\0\0\0\0\0\0\x7f\x03\0NULL", 16);
    greeting.resize(64);
    output_ = greeting.append(ready);
  }

  [[nodiscard]] int fd() const noexcept { return fd_.get(); }
  [[nodiscard]] bool is_open() const noexcept { return fd_.get() >= 0; }

  /// Have a message sent.
  void send(std::string_view body) {
    if (body.size() < 256) {
      output_.append({'\0', static_cast<char>(static_cast<unsigned char>(body.size()))});
    } else {
      output_.push_back('\x02');
      for (unsigned shift = 64; shift > 0; shift -= 8)
        output_.push_back(static_cast<char>(static_cast<unsigned char>(body.size() >> (shift - 8))));
    }
    output_.append(body);
    write_some();
  }

  /// The next message; nothing if there is none until then.  Throws Unreachable when the connection is over.
  bool receive(std::string& message, Clock::time_point until) {
    while (true) {
      write_some();
      while (parse(message)) {
        if (complete_) return true;
      }
      if (!read_some() && !wait(until)) return false;
    }
  }

 private:
  [[noreturn]] void refused(int number) const {
    switch (number) {
      case ENOENT:
      case ENOTDIR: throw Unreachable("no_socket", path_ + ": no daemon was started there");
      case ECONNREFUSED: throw Unreachable("stale_socket", path_ + ": the daemon that listened there has ended");
      case EACCES: throw Unreachable("no_permission", path_ + ": this user may not ask that daemon");
      case EAGAIN: throw Unreachable("no_answer", path_ + ": the daemon takes nobody just now");
      default: throw Unreachable("no_socket", path_ + ": " + error_text(number));
    }
  }
  [[noreturn]] void lost(const std::string& why) const { throw Unreachable("connection_lost", path_ + ": " + why); }

  void write_some() {
    while (!output_.empty()) {
      const auto sent = ::send(fd_.get(), output_.data(), output_.size(), MSG_NOSIGNAL);
      if (sent < 0) {
        if (errno == EINTR) continue;
        if (errno == EAGAIN) return;
        lost("the connection is over: " + error_text(errno));
      }
      output_.erase(0, static_cast<std::size_t>(sent));
    }
  }

  bool read_some() {
    if (start_ > 0 && start_ == input_.size()) {
      input_.clear();
      start_ = 0;
    } else if (start_ > read_bytes) {
      input_.erase(0, std::exchange(start_, 0));
    }
    const auto before = input_.size();
    const auto missing = wanted_ - std::min(wanted_, before - start_);  // as the frame says: memory comes as bytes do
    input_.resize(before + std::clamp<std::size_t>(missing, read_bytes, 16 * read_bytes));
    const auto got = ::recv(fd_.get(), &input_[before], input_.size() - before, 0);
    const int number = errno;
    input_.resize(before + static_cast<std::size_t>(std::max<ssize_t>(got, 0)));
    if (got > 0) return true;
    if (got == 0) lost("the daemon has closed the connection");
    if (number != EAGAIN && number != EINTR) lost("the connection is over: " + error_text(number));
    return false;
  }

  bool wait(Clock::time_point until) const {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(until - Clock::now()).count() + 1;
    if (until <= Clock::now()) return false;
    pollfd one{fd_.get(), static_cast<short>(POLLIN | (output_.empty() ? 0 : POLLOUT)), 0};
    ::poll(&one, 1, static_cast<int>(std::min<long long>(left, 1 << 30)));
    return true;
  }

  /// Take the next frame out of what has come; `complete_` says whether it was a message, and not a command.
  bool parse(std::string& message) {
    const std::string_view input = std::string_view(input_).substr(start_);
    complete_ = false;
    wanted_ = 0;
    if (!greeted_) {
      if (input.size() < 64) return false;
      if (input[0] != '\xff' || input[9] != '\x7f' || input[10] < 3 ||
          input.substr(12, 20) != std::string_view("NULL\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0", 20))
        throw ProtocolMismatch("protocol_mismatch", path_ + ": what listens there is no daemon of shmmap");
      greeted_ = true;
      start_ += 64;
      return true;
    }
    if (input.size() < 2) return false;
    const unsigned flags = static_cast<unsigned char>(input[0]);
    const std::size_t head = (flags & 2U) != 0 ? 9 : 2;
    if (input.size() < head) return false;
    std::uint64_t size = 0;
    for (const char one : input.substr(1, head - 1)) size = (size << 8) | static_cast<unsigned char>(one);
    if ((flags & ~6U) != 0 || size > most_bytes) lost("what came is no message of a daemon");
    if (input.size() - head < size) {
      wanted_ = head + static_cast<std::size_t>(size);
      return false;
    }
    const auto body = input.substr(head, static_cast<std::size_t>(size));
    start_ += head + body.size();
    if ((flags & 4U) == 0) {
      message.assign(body);
      complete_ = true;
    } else if (body.size() >= 7 && body.substr(0, 5) == "\4PING") {
      const auto context = body.substr(7, 16);
      output_.append({'\4', static_cast<char>(5 + context.size())}).append("\4PONG").append(context);
    }
    return true;
  }

  std::string path_, input_, output_;
  std::size_t start_ = 0, wanted_ = 0;
  bool greeted_ = false, complete_ = false;
  Descriptor fd_;
};

inline constexpr std::string_view ready_of_dealer{
    "\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06" "DEALER", 30};

// --- segments --------------------------------------------------------------------------------------------

inline std::uint32_t crc32(const unsigned char* data, std::size_t size) {
  static const auto table = [] {
    std::array<std::uint32_t, 256> made{};
    for (std::uint32_t value = 0; value < 256; ++value) {
      std::uint32_t left = value;
      for (int bit = 0; bit < 8; ++bit) left = (left >> 1) ^ ((left & 1U) != 0 ? 0xedb88320U : 0U);
      made[value] = left;
    }
    return made;
  }();
  std::uint32_t crc = ~std::uint32_t{0};
  for (std::size_t at = 0; at < size; ++at) crc = (crc >> 8) ^ table[(crc ^ data[at]) & 0xffU];
  return ~crc;
}

/// A mapped object; what it holds does not change while it is mapped.
class Mapping {
 public:
  Mapping(int fd, std::size_t size) : data_(::mmap(nullptr, size, PROT_READ, MAP_SHARED, fd, 0)), size_(size) {
    if (data_ == MAP_FAILED) throw SegmentError("segment_error", "cannot be mapped: " + error_text(errno));
  }
  Mapping(const Mapping&) = delete;
  Mapping& operator=(const Mapping&) = delete;
  ~Mapping() { ::munmap(data_, size_); }
  [[nodiscard]] const unsigned char* data() const noexcept { return static_cast<const unsigned char*>(data_); }

 private:
  void* data_;
  std::size_t size_;
};

template <typename T>
T read_at(const unsigned char* data, std::size_t at) {
  T value{};
  std::memcpy(&value, data + at, sizeof value);
  return value;
}

template <typename T>
constexpr std::string_view dtype_of() {
  static_assert(std::is_arithmetic_v<T> && sizeof(T) <= 8, "columns hold integers, float and double");
  if constexpr (std::is_floating_point_v<T>) return sizeof(T) == 4 ? "<f4" : "<f8";
  constexpr bool is_signed = std::is_signed_v<T>;
  switch (sizeof(T)) {
    case 1: return is_signed ? "|i1" : "|u1";
    case 2: return is_signed ? "<i2" : "<u2";
    case 4: return is_signed ? "<i4" : "<u4";
    default: return is_signed ? "<i8" : "<u8";
  }
}

inline std::size_t bytes_of(std::string_view dtype) {
  for (const std::string_view known : {"<f2", "<f4", "<f8", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "|i1", "|u1"})
    if (known == dtype) return static_cast<std::size_t>(dtype[2] - '0');
  return 0;
}

}  // namespace detail

// --- cells -----------------------------------------------------------------------------------------------

/// One column as it lies in shared memory: `dtype` as numpy writes it, row-major, the first dimension is rows.
struct Column {
  std::string name, dtype, unit;
  std::vector<std::uint64_t> shape;
  const void* data = nullptr;
  std::uint64_t nbytes = 0;
  std::uint64_t checksum = 0;
};

/// The values of a column; they live as long as their cell.
template <typename T>
class Values {
 public:
  Values(const T* data, std::size_t rows, std::size_t width) : data_(data), rows_(rows), width_(width) {}
  [[nodiscard]] const T* data() const noexcept { return data_; }
  /// Of each point, voxel or field.
  [[nodiscard]] std::size_t rows() const noexcept { return rows_; }
  /// Values of one row: 3 of `xyz`.
  [[nodiscard]] std::size_t width() const noexcept { return width_; }
  [[nodiscard]] std::size_t size() const noexcept { return rows_ * width_; }
  [[nodiscard]] const T* begin() const noexcept { return data_; }
  [[nodiscard]] const T* end() const noexcept { return data_ + size(); }
  /// The values of one row.
  const T* operator[](std::size_t row) const noexcept { return data_ + row * width_; }

 private:
  const T* data_;
  std::size_t rows_, width_;
};

/// The voxels that a computed layer's rows lie on: edges in metres (infinite: not divided along that axis),
/// index of the first one of the box that is occupied, and that box's voxels along x, y, z.
struct Lattice {
  std::array<double, 3> leaf{};
  std::array<std::int64_t, 3> first{};
  std::array<std::uint64_t, 3> shape{};
};

/// One layer of one map cell, mapped for reading.
class Cell {
 public:
  std::string id;  ///< whole: as Autoware's `cell_id`
  std::string layer;
  std::uint64_t version = 0;  ///< with the layer it names the bytes, also across restarts
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  double z_min = 0.0, z_max = 0.0;  ///< of its points; NaN where there are none
  bool stale = false;               ///< the map has a newer version that could not be loaded yet
  std::uint64_t rows = 0;
  std::uint64_t source_points = 0, dropped_points = 0;
  std::array<double, 3> origin{};  ///< what to add to the coordinates
  std::string frame_id;
  std::optional<Lattice> lattice;
  std::vector<Column> columns;

  /// A column by name; throws NoColumn, and BadRequest where its values are of another type.
  template <typename T>
  [[nodiscard]] Values<T> column(std::string_view name) const {
    const Column& found = this->named(name);
    if (found.dtype != detail::dtype_of<T>())
      throw BadRequest("bad_request", id + ": the values of " + found.name + " are " + found.dtype + ", not " +
                                          std::string(detail::dtype_of<T>()));
    const std::uint64_t count = found.shape.front();
    const std::uint64_t values = found.nbytes / sizeof(T);
    return Values<T>(static_cast<const T*>(found.data), static_cast<std::size_t>(count),
                     static_cast<std::size_t>(count != 0 ? values / count : 0));
  }

  /// A column by name, whatever its values are; throws NoColumn.
  [[nodiscard]] const Column& named(std::string_view name) const {
    for (const Column& one : columns)
      if (one.name == name) return one;
    std::string there;
    for (const Column& one : columns) there += (there.empty() ? "" : ", ") + one.name;
    throw NoColumn("no_column", id + " (" + layer + ") has no column " + std::string(name), "there are: " + there);
  }

 private:
  friend class Client;
  std::shared_ptr<const detail::Mapping> mapping_;
};

using CellPtr = std::shared_ptr<const Cell>;

/// A cell that could not be handed out, and why: `unknown_cell`, `load_failed`, `load_timeout`, `over_budget`,
/// `no_space`, `offline`; take any other code for `load_failed`.
struct Failure {
  std::string id, layer, code, message;
};

/// What came of a request.
struct Answer {
  std::vector<CellPtr> cells;
  std::vector<std::string> removed;                           ///< of what was held by id
  std::vector<std::uint64_t> removed_versions;                ///< of what was held packed
  std::vector<std::pair<std::string, std::string>> pending;   ///< id and layer of what is being loaded
  std::vector<Failure> failed;
  std::vector<std::string> layers;  ///< those asked for, in canonical form
  std::uint64_t epoch = 0, map_version = 0;
  bool covered = true;  ///< false: part of what was asked for is not known yet, ask again
};

/// What a client has: the cell's id and its version, of all layers that it asks for.
struct Held {
  std::string id;
  std::optional<std::uint64_t> version = std::nullopt;
};

namespace detail {

/// Where a handle says that a segment is.
struct Handle {
  std::string id, layer, segment;
  std::uint64_t version = 0, offset = 0, bytes = 0;
  double min_x = 0.0, min_y = 0.0, max_x = 0.0, max_y = 0.0;
  bool stale = false;
};

[[noreturn]] inline void corrupt(const Handle& handle, const std::string& why) {
  throw SegmentError("segment_corrupt", handle.segment + " (" + handle.id + "): " + why);
}

inline std::string text_in(const unsigned char* header, std::uint64_t end, std::size_t at, const Handle& handle) {
  const std::uint64_t offset = read_at<std::uint32_t>(header, at), size = read_at<std::uint32_t>(header, at + 4);
  if (offset > end || size > end - offset) corrupt(handle, "a text of the header lies outside of it");
  return std::string(reinterpret_cast<const char*>(header) + offset, static_cast<std::size_t>(size));
}

inline std::string fixed_text(const unsigned char* data, std::size_t size) {
  const auto* text = reinterpret_cast<const char*>(data);
  return std::string(text, ::strnlen(text, size));
}

/// Read the table of columns; each is checked against what the segment has.
inline void read_columns(Cell& cell, const Handle& handle, const unsigned char* segment, std::uint64_t header_bytes,
                         std::uint64_t total) {
  const std::uint64_t end = header_bytes - 72;
  const std::uint64_t count = read_at<std::uint32_t>(segment, 172), start = read_at<std::uint32_t>(segment, 176);
  const std::uint64_t row_bytes = read_at<std::uint32_t>(segment, 180);
  if (row_bytes < 128 || start > end || count > (end - start) / row_bytes) corrupt(handle, "no table of columns");
  cell.columns.reserve(static_cast<std::size_t>(count));
  for (std::uint64_t number = 0; number < count; ++number) {
    const unsigned char* row = segment + start + number * row_bytes;
    Column column;
    column.name = fixed_text(row, 40);
    column.dtype = fixed_text(row + 40, 8);
    column.unit = fixed_text(row + 48, 16);
    const auto dimensions = read_at<std::uint32_t>(row, 64);
    std::uint64_t bytes = bytes_of(column.dtype);
    if (bytes == 0 || dimensions < 1 || dimensions > 4) corrupt(handle, "column " + column.name + " has no type");
    for (std::uint32_t axis = 0; axis < dimensions; ++axis) {
      const auto side = read_at<std::uint64_t>(row, 72 + 8 * axis);
      if (side != 0 && bytes > total / side) corrupt(handle, "column " + column.name + " is too large");
      bytes *= side;
      column.shape.push_back(side);
    }
    const auto offset = read_at<std::uint64_t>(row, 104);
    column.nbytes = read_at<std::uint64_t>(row, 112);
    column.checksum = read_at<std::uint64_t>(row, 120);
    if (column.nbytes != bytes || offset % 64 != 0 || offset < header_bytes || offset > total ||
        bytes > total - offset)
      corrupt(handle, "column " + column.name + " lies outside of the segment");
    column.data = segment + offset;
    cell.columns.push_back(std::move(column));
  }
}

}  // namespace detail

/// How a client finds the daemon and what it says of itself.
struct Options {
  std::string endpoint = {};  ///< the socket's path; empty: the environment says, as for every client
  std::string name = {};      ///< how the program is listed (`shmmap top`); at most 64 characters
  std::string shm_dir = {};   ///< where this process finds segments; empty: `SHMMAP_SHM_DIR`, or as the daemon says
  double patience = 5.0;      ///< seconds to wait for an answer, beyond those that the daemon may take
};

namespace detail {

inline std::string variable(const char* name) {
  const char* value = std::getenv(name);  // NOLINT(concurrency-mt-unsafe): nobody here changes it
  return value != nullptr ? value : "";
}

/// The sockets to try, the first one first.
inline std::vector<std::string> endpoints(std::string given) {
  if (given.empty()) given = variable("SHMMAP_ENDPOINT");
  if (given.compare(0, 6, "ipc://") == 0) given.erase(0, 6);
  if (!given.empty()) return {given};
  const std::string named = variable("SHMMAP_INSTANCE"), directory = variable("SHMMAP_RUNTIME_DIR");
  const std::string file = "/" + (named.empty() ? "default" : named) + ".sock";
  if (!directory.empty()) return {directory + file};
  const std::string users = variable("XDG_RUNTIME_DIR");
  if (users.empty()) return {"/run/shmmap" + file};
  return {users + "/shmmap" + file, "/run/shmmap" + file};
}

inline void write(Writer& to, const std::optional<double>& value) {
  if (value) to.real(*value);
  else to.nil();
}

inline void write(Writer& to, const Area& area) {
  const auto range = [&to](std::size_t size, const char* form, std::initializer_list<double> values,
                           const std::optional<ZRange>& z) {
    to.array(size + (z ? 2 : 0));
    to.text(form);
    for (const double value : values) to.real(value);
    if (z) to.real(z->min), to.real(z->max);
  };
  std::visit(
      [&](const auto& one) {
        using Kind = std::decay_t<decltype(one)>;
        if constexpr (std::is_same_v<Kind, Box>)
          range(5, "box", {one.min_x, one.min_y, one.max_x, one.max_y}, one.z);
        else
          range(4, std::is_same_v<Kind, Circle> ? "circle" : "square", {one.x, one.y, one.radius}, one.z);
      },
      area);
}

inline void write(Writer& to, const std::optional<Intent>& intent) {
  if (!intent) return to.nil();
  to.array(6);
  for (const double value : {intent->x, intent->y, intent->vx, intent->vy}) to.real(value);
  write(to, intent->heading);
  to.array(intent->route.size());
  for (const auto& [x, y] : intent->route) {
    to.array(2);
    to.real(x);
    to.real(y);
  }
}

inline void write(Writer& to, const std::vector<std::string>& texts) {
  to.array(texts.size());
  for (const auto& text : texts) to.text(text);
}

/// What the daemon says of itself.
struct Welcome {
  std::uint64_t minor = 0, epoch = 0, session = 0;
  std::string instance, shm_dir, id_prefix, segment_prefix, frame_id;
};

inline Welcome read_welcome(Row& row) {
  Welcome found;
  if (row.get().number() != 1) throw ProtocolMismatch("protocol_mismatch", "the daemon speaks another protocol");
  found.minor = row.get().number();
  row.get().skip(1);  // its version
  found.instance = row.get().text();
  found.epoch = row.get().number();
  found.session = row.get().number();
  row.get().number();  // the map's version: each answer has it
  row.get().skip(1);   // the map's path
  found.frame_id = row.get().text();
  found.shm_dir = row.get().text();
  found.id_prefix = row.get().text();
  found.segment_prefix = row.get().text();
  row.end();
  return found;
}

inline Handle read_handle(Reader& reader) {
  Row row(reader);
  Handle found;
  found.id = row.get().text();
  found.version = row.get().number();
  found.layer = row.get().text();
  found.segment = row.get().text();
  found.offset = row.get().number();
  found.bytes = row.get().number();
  row.get().number();  // rows: the segment has them
  for (double* side : {&found.min_x, &found.min_y, &found.max_x, &found.max_y}) *side = row.get().real();
  if (row.next()) found.stale = reader.boolean();
  row.end();
  return found;
}

/// The reply to a request for cells, before anything is mapped.
struct Cells {
  Answer answer;
  std::vector<Handle> handles;
};

inline Cells read_cells(Reader& reader, Row& row) {
  Cells found;
  Answer& answer = found.answer;
  answer.epoch = row.get().number();
  answer.map_version = row.get().number();
  for (auto left = row.get().array(); left > 0; --left) found.handles.push_back(read_handle(reader));
  for (auto left = row.get().array(); left > 0; --left) answer.removed.emplace_back(reader.text());
  const auto packed = row.get().binary();
  for (std::size_t at = 0; at + 8 <= packed.size(); at += 8) {
    std::uint64_t version = 0;
    std::memcpy(&version, packed.data() + at, 8);
    answer.removed_versions.push_back(version);
  }
  for (auto left = row.get().array(); left > 0; --left) {
    Row one(reader);
    std::string id(one.get().text());
    answer.pending.emplace_back(std::move(id), std::string(one.get().text()));
    one.end();
  }
  for (auto left = row.get().array(); left > 0; --left) {
    Row one(reader);
    Failure failure;
    for (std::string* text : {&failure.id, &failure.layer, &failure.code, &failure.message}) *text = one.get().text();
    one.end();
    answer.failed.push_back(std::move(failure));
  }
  if (row.next())
    for (auto left = reader.array(); left > 0; --left) answer.layers.emplace_back(reader.text());
  if (row.next()) answer.covered = reader.boolean();
  row.end();
  return found;
}

[[noreturn]] inline void read_error(Row& row) {
  const std::string code(row.get().text()), message(row.get().text());
  const std::string hint(row.next() ? row.reader().text() : std::string_view{});
  if (code == "bad_request") throw BadRequest(code, message, hint);
  if (code == "protocol_mismatch") throw ProtocolMismatch(code, message, hint);
  throw Refused(code, message, hint);
}

}  // namespace detail

/// One connection to the daemon, and one session.
class Client {
 public:
  static constexpr double default_wait = 5.0;

  /// Find the daemon and open a session; throws Unreachable, ProtocolMismatch, Refused.
  explicit Client(Options options = {}) : options_(std::move(options)) {
    if (options_.shm_dir.empty()) options_.shm_dir = detail::variable("SHMMAP_SHM_DIR");
    const auto paths = detail::endpoints(options_.endpoint);
    for (std::size_t at = 0; at < paths.size(); ++at) {
      try {
        path_ = paths[at];
        connect();
        return;
      } catch (const Unreachable& error) {
        if (at + 1 == paths.size() || error.code() == "no_answer") throw;
      }
    }
  }
  Client(Client&&) = default;
  Client& operator=(Client&&) = default;
  ~Client() {
    try {
      if (socket_.is_open()) socket_.send(begun("bye", next_request(), 0).data());
    } catch (const std::exception&) {  // it is over anyway
    }
  }

  /// All cells of an area, and what of them could not be had.  `wait`: seconds that the daemon may take to load
  /// (at most 3600); none: what is in memory, the rest is `pending` and being loaded.
  Answer area(const Area& area, const std::vector<std::string>& layers = {"points"},
              std::optional<double> wait = default_wait, const std::optional<Intent>& intent = std::nullopt) {
    return cells("area", wait, [&](detail::Writer& to) {
      detail::write(to, area);
      detail::write(to, layers);
      detail::write(to, wait);
      detail::write(to, intent);
    }, 4);
  }

  /// What of an area the client does not hold, and what it holds in vain: apply removals before additions.
  /// `packed` are versions alone, each of one layer of one cell.
  Answer differential(const Area& area, const std::vector<Held>& held, const std::vector<std::uint64_t>& packed = {},
                      const std::vector<std::string>& layers = {"points"},
                      std::optional<double> wait = default_wait,
                      const std::optional<Intent>& intent = std::nullopt) {
    return cells("differential", wait, [&](detail::Writer& to) {
      detail::write(to, area);
      detail::write(to, layers);
      to.array(held.size());
      for (const Held& one : held) {
        to.array(2);
        to.text(one.id);
        if (one.version) to.number(*one.version);
        else to.nil();
      }
      to.binary(packed.data(), packed.size() * sizeof(std::uint64_t));
      detail::write(to, wait);
      detail::write(to, intent);
    }, 6);
  }

  /// Cells by id, in that order.
  Answer selected(const std::vector<std::string>& ids, const std::vector<std::string>& layers = {"points"},
                  std::optional<double> wait = default_wait, const std::optional<Intent>& intent = std::nullopt) {
    return cells("selected", wait, [&](detail::Writer& to) {
      detail::write(to, ids);
      detail::write(to, layers);
      detail::write(to, wait);
      detail::write(to, intent);
    }, 4);
  }

  /// Tell the daemon at once what was unmapped; each request does so before.
  void release() {
    tell_unmapped();
    const auto number = next_request();
    auto message = begun("release", number, 1);
    message.binary("", 0);
    std::string reply;
    ask(number, message.data(), "released", 0.0, reply);
  }

  /// Counts the daemon's lives.
  [[nodiscard]] std::uint64_t epoch() const noexcept { return welcome_.epoch; }
  /// The session's number, as in `shmmap top`.
  [[nodiscard]] std::uint64_t session() const noexcept { return welcome_.session; }
  [[nodiscard]] const std::string& instance() const noexcept { return welcome_.instance; }
  /// The frame of all coordinates.
  [[nodiscard]] const std::string& frame_id() const noexcept { return welcome_.frame_id; }
  /// The connection's descriptor, for event loops: readable when the daemon has ended.
  [[nodiscard]] int fd() const noexcept { return socket_.fd(); }

 private:
  using Clock = detail::Clock;

  static constexpr double greeting_s = 1.0;
  static constexpr int attempts = 8;

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

  // --- the connection ---

  void connect() {
    socket_ = detail::Socket(path_, detail::ready_of_dealer);
    const auto number = next_request();
    auto message = begun("hello", number, 4);
    message.number(1);
    message.number(4);
    message.text(options_.name);
    message.number(welcome_.session);
    socket_.send(message.data());
    std::string reply;
    const auto until = after(greeting_s);
    while (socket_.receive(reply, until)) {
      detail::Reader reader(reply);
      detail::Row row(reader);
      if (const auto tag = row.get().text(); is_answer(row, number, tag)) {
        if (tag == "error") detail::read_error(row);
        if (tag != "welcome") throw ProtocolMismatch("protocol_mismatch", "hello was answered by " + std::string(tag));
        welcome_ = detail::read_welcome(row);
        look_whose_segments();
        return;
      }
      row.end();
    }
    socket_ = detail::Socket();
    throw Unreachable("no_answer", path_ + ": the daemon does not answer", "it is stopped, hung or overloaded");
  }

  static bool is_answer(detail::Row& row, std::uint64_t number, std::string_view tag) {
    const auto found = row.get().number();
    return found == number || (found == 0 && tag == "error");
  }

  /// Send a request until it is answered; `reply` is what came.
  void ask(std::uint64_t number, const std::string& message, std::string_view tag, double wait, std::string& reply) {
    const auto deadline = after(wait + options_.patience);
    double pause = wait + 1.0;
    bool may_be_back = true;  // the first time it is asked at once
    while (true) {
      try {
        if (!socket_.is_open()) connect();
        socket_.send(message);
        const auto until = std::min(deadline, after(pause));
        pause *= 2.0;
        while (socket_.receive(reply, until)) {
          detail::Reader reader(reply);
          detail::Row row(reader);
          const auto kind = row.get().text();
          if (!is_answer(row, number, kind)) {
            row.end();
            continue;
          }
          if (kind == tag) return;
          if (kind != "error")
            throw ProtocolMismatch("protocol_mismatch", std::string(tag) + " was answered by " + std::string(kind));
          detail::read_error(row);
        }
        if (Clock::now() >= deadline)
          throw Unreachable("no_answer", path_ + ": the daemon did not answer in time", "is it stopped?");
      } catch (const Refused& error) {
        if (error.code() != "no_session" || Clock::now() >= deadline) throw;
        socket_ = detail::Socket();  // hello on a new connection takes the session over
      } catch (const Unreachable& error) {
        socket_ = detail::Socket();
        if (error.code() == "no_answer" || error.code() == "no_permission" || Clock::now() >= deadline) throw;
        if (!std::exchange(may_be_back, false)) ::poll(nullptr, 0, 20);  // nobody says when it listens again
      }
    }
  }

  // --- cells ---

  template <typename Write>
  Answer cells(std::string_view tag, const std::optional<double>& wait, const Write& write, std::size_t elements) {
    tell_unmapped();
    const auto deadline = after(wait.value_or(0.0) + options_.patience);
    auto found = one_reply(tag, wait.value_or(0.0), write, elements);
    Answer answer = std::move(found.answer);
    for (auto& [id, layer] : answer.pending) id = whole(id);
    for (auto& failure : answer.failed)
      if (failure.code != "unknown_cell") failure.id = whole(failure.id);
    std::vector<CellPtr> places(found.handles.size());
    std::vector<std::size_t> gone;
    for (std::size_t at = 0; at < places.size(); ++at) take(found.handles[at], at, places, gone, answer);
    for (int attempt = 0; !gone.empty() && attempt < attempts && Clock::now() < deadline; ++attempt)
      ask_again(found.handles, places, gone, answer);
    for (const auto at : gone) answer.pending.emplace_back(whole(found.handles[at].id), found.handles[at].layer);
    for (auto& cell : places)
      if (cell) answer.cells.push_back(std::move(cell));
    return answer;
  }

  template <typename Write>
  detail::Cells one_reply(std::string_view tag, double wait, const Write& write, std::size_t elements) {
    const auto number = next_request();
    auto message = begun(tag, number, elements);
    write(message);
    std::string reply;
    ask(number, message.data(), "cells", wait, reply);
    SHMMAP_FAILPOINT("client.replied");
    detail::Reader reader(reply);
    detail::Row row(reader);
    row.get().skip(1);
    row.get().skip(1);
    return detail::read_cells(reader, row);
  }

  void take(const detail::Handle& handle, std::size_t at, std::vector<CellPtr>& places,
            std::vector<std::size_t>& gone, Answer& answer) {
    try {
      places[at] = attached(handle);
    } catch (const SegmentError& error) {  // one cell must not cost the others
      if (error.code() == "stale_handle") gone.push_back(at);
      else if (error.code() == "segment_corrupt")
        answer.failed.push_back({whole(handle.id), handle.layer, "load_failed", error.what()});
      else throw;
    }
  }

  /// Ask anew for the handles whose segments were gone before they could be attached.
  void ask_again(std::vector<detail::Handle>& handles, std::vector<CellPtr>& places, std::vector<std::size_t>& gone,
                 Answer& answer) {
    std::vector<std::string> ids, layers;
    const auto add = [](std::vector<std::string>& to, const std::string& one) {
      if (std::find(to.begin(), to.end(), one) == to.end()) to.push_back(one);
    };
    for (const auto at : gone) add(ids, handles[at].id), add(layers, handles[at].layer);
    const std::optional<double> wait = options_.patience / 2.0;
    auto found = one_reply("selected", *wait, [&](detail::Writer& to) {
      detail::write(to, ids);
      detail::write(to, layers);
      detail::write(to, wait);
    }, 3);
    std::vector<std::size_t> still;
    for (const auto at : std::exchange(gone, {})) {
      const auto is_it = [&](const auto& one) { return one.id == handles[at].id && one.layer == handles[at].layer; };
      if (const auto handle = std::find_if(found.handles.begin(), found.handles.end(), is_it);
          handle != found.handles.end()) {
        handles[at] = *handle;
        take(handles[at], at, places, still, answer);
        continue;
      }
      const auto& failed = found.answer.failed;
      if (const auto failure = std::find_if(failed.begin(), failed.end(), is_it); failure != failed.end())
        answer.failed.push_back({whole(failure->id), failure->layer, failure->code, failure->message});
      else answer.pending.emplace_back(whole(handles[at].id), handles[at].layer);
    }
    gone = std::move(still);
  }

  std::string whole(const std::string& id) const {
    return !id.empty() && id.front() == '/' ? id : welcome_.id_prefix + id;
  }

  [[nodiscard]] const std::string& shm_dir() const {
    return options_.shm_dir.empty() ? welcome_.shm_dir : options_.shm_dir;
  }

  void look_whose_segments() {
    struct stat status {};
    const std::string path = shm_dir() + welcome_.segment_prefix + "statistics";
    owner_ = ::lstat(path.c_str(), &status) == 0 ? std::optional<uid_t>(status.st_uid) : std::nullopt;
  }

  CellPtr attached(const detail::Handle& handle) {
    auto& known = cells_[{handle.version, handle.layer}];
    if (CellPtr there = known.lock()) return there;
    CellPtr cell = attach(handle);
    known = cell;
    return cell;
  }

  [[nodiscard]] detail::Descriptor opened(const detail::Handle& handle, const std::string& path) const {
    const auto until = Clock::now() + std::chrono::milliseconds(200);
    while (true) {
      detail::Descriptor fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK));  // NOLINT
      if (fd.get() >= 0) return fd;
      if (errno != EWOULDBLOCK || Clock::now() >= until) {
        if (errno == ENOENT || errno == EWOULDBLOCK || errno == ELOOP) stale(handle);
        throw SegmentError("segment_error", path + ": " + detail::error_text(errno));
      }
      const timespec pause{0, 200'000};
      ::nanosleep(&pause, nullptr);  // the daemon looks at it in this moment, and says not when it is done
    }
  }

  [[noreturn]] static void stale(const detail::Handle& handle) {
    throw SegmentError("stale_handle", handle.segment + " (" + handle.id + ") is gone", "ask the daemon again");
  }

  CellPtr attach(const detail::Handle& handle) const {
    using detail::read_at;
    const auto fd = opened(handle, shm_dir() + welcome_.segment_prefix + handle.segment);
    SHMMAP_FAILPOINT("client.opened");
    struct stat status {};
    if (::fstat(fd.get(), &status) != 0) throw SegmentError("segment_error", detail::error_text(errno));
    if (!S_ISREG(status.st_mode) || (owner_ && status.st_uid != *owner_)) stale(handle);
    struct flock lock {};
    lock.l_type = F_RDLCK;
    lock.l_whence = SEEK_SET;
    lock.l_start = static_cast<off_t>(welcome_.session);
    lock.l_len = 1;
    static_assert(sizeof(off_t) == 8, "compile with -D_FILE_OFFSET_BITS=64");
    ::fcntl(fd.get(), F_OFD_SETLK, &lock);  // NOLINT: without it the segment is as safe, and its user unknown
    SHMMAP_FAILPOINT("client.locked");
    const auto size = static_cast<std::uint64_t>(status.st_size);
    if (handle.offset > size || handle.bytes > size - handle.offset || size - handle.offset < 4096)
      detail::corrupt(handle, "it has not the bytes of its handle");
    const auto mapping = std::make_shared<const detail::Mapping>(fd.get(), static_cast<std::size_t>(size));
    SHMMAP_FAILPOINT("client.mapped");
    const unsigned char* segment = mapping->data() + handle.offset;
    if (std::memcmp(segment, "SHMMAP\0\1", 8) != 0) detail::corrupt(handle, "it is no segment");
    if (read_at<std::uint16_t>(segment, 8) != 1) detail::corrupt(handle, "it has another version");
    if (read_at<std::uint32_t>(segment, 12) != 0x01020304U) detail::corrupt(handle, "it has another byte order");
    const auto header_bytes = read_at<std::uint64_t>(segment, 16), total = read_at<std::uint64_t>(segment, 24);
    if (header_bytes < 4096 || header_bytes > total || total > size - handle.offset)
      detail::corrupt(handle, "its sizes are wrong");
    const std::uint64_t end = header_bytes - 72;
    if (detail::crc32(segment, static_cast<std::size_t>(end)) != read_at<std::uint32_t>(segment, end))
      detail::corrupt(handle, "the header's checksum is wrong");
    auto cell = std::make_shared<Cell>();
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

  /// Tell the daemon which versions nobody here maps any more: memory can be used again at once.
  void tell_unmapped() {
    std::vector<std::uint64_t> versions;
    for (auto one = cells_.begin(); one != cells_.end();) {
      if (one->second.expired()) {
        versions.push_back(one->first.first);
        one = cells_.erase(one);
      } else {
        ++one;
      }
    }
    if (versions.empty() || !socket_.is_open()) return;
    auto message = begun("release", next_request(), 1);
    message.binary(versions.data(), versions.size() * sizeof(std::uint64_t));
    try {
      socket_.send(message.data());  // its answer is that to an id for which nobody waits
    } catch (const Unreachable&) {
      socket_ = detail::Socket();
    }
  }

  Options options_;
  std::string path_;
  detail::Socket socket_;
  detail::Welcome welcome_;
  std::uint64_t request_ = 0;
  std::optional<uid_t> owner_;
  std::map<std::pair<std::uint64_t, std::string>, std::weak_ptr<const Cell>> cells_;
};

}  // namespace shmmap

#endif  // SHMMAP_SHMMAP_HPP
