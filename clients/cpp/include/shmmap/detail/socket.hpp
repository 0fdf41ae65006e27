// SPDX-License-Identifier: Apache-2.0
//
// One connection: ZMTP 3.0 over a Unix socket, without a library.

#ifndef SHMMAP_DETAIL_SOCKET_HPP
#define SHMMAP_DETAIL_SOCKET_HPP

#include <poll.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <string>
#include <string_view>
#include <system_error>
#include <utility>

#include <shmmap/errors.hpp>

namespace shmmap::detail {

using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

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

/// One connection that speaks ZMTP 3.0 with the NULL mechanism, as in PROTOCOL.md.
class Socket {
 public:
  static constexpr std::uint64_t max_bytes = std::uint64_t{1} << 30;  // largest message
  static constexpr std::size_t read_bytes = std::size_t{1} << 16;      // least size of a read
  static constexpr std::size_t keep_bytes = std::size_t{1} << 20;      // largest unused buffer to keep

  Socket() = default;

  /// Connect and send the greeting; throws Unreachable.
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
  /// Whether the peer is still connected, as far as the kernel knows.
  [[nodiscard]] bool stands() const noexcept {
    pollfd one{fd_.get(), POLLRDHUP, 0};
    return is_open() && ::poll(&one, 1, 0) == 0;
  }

  /// Queue a message for sending.
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

  /// The next message; false if none arrives by then.  Data that has arrived by then is always read, followed by at
  /// most one further read.  Throws Unreachable if the connection has ended.
  bool receive(std::string& message, Clock::time_point until) {
    for (bool is_over = false;; is_over = Clock::now() >= until) {
      write_some();
      while (parse(message)) {
        if (complete_) return true;
      }
      if (is_over || !is_ready(until)) return false;
      read_some();
    }
  }

 private:
  [[noreturn]] void refused(int number) const {
    switch (number) {
      case ENOENT:
      case ENOTDIR:
        throw Unreachable("no_socket", path_ + ": there is no socket",
                          "start a daemon with `shmmap serve MAP`, or say which: SHMMAP_ENDPOINT, or SHMMAP_INSTANCE "
                          "with SHMMAP_RUNTIME_DIR");
      case ECONNREFUSED:
        throw Unreachable("stale_socket", path_ + ": the daemon that made this socket is gone", "start it again");
      case EACCES:
        throw Unreachable("no_permission", path_ + ": this user may not connect",
                          "join the group that the daemon was started with (--group), then log in again");
      case EAGAIN:
        throw Unreachable("no_answer", path_ + ": the daemon accepts no connection just now", "it is hung or overloaded");
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

  /// Read arrived data, if any, and append it to the data not taken yet.
  void read_some() {
    if (start_ == end_) {
      start_ = end_ = 0;
      if (input_.size() > keep_bytes) input_ = {};
    } else if (start_ > read_bytes) {
      input_.erase(0, start_);
      end_ -= std::exchange(start_, 0);
    }
    const auto missing = wanted_ - std::min(wanted_, end_ - start_);  // of the frame; memory grows with received bytes
    const auto room = std::clamp<std::size_t>(missing, read_bytes, 16 * read_bytes);
    if (input_.size() < end_ + room) input_.resize(end_ + room);
    const auto got = ::recv(fd_.get(), &input_[end_], input_.size() - end_, 0);
    if (got > 0) end_ += static_cast<std::size_t>(got);
    else if (got == 0) lost("the daemon has closed the connection");
    else if (errno != EAGAIN && errno != EINTR) lost("the connection is over: " + error_text(errno));
  }

  /// Wait until the socket is readable or writable; false on timeout.
  bool is_ready(Clock::time_point until) const {
    pollfd one{fd_.get(), static_cast<short>(POLLIN | (output_.empty() ? 0 : POLLOUT)), 0};
    while (true) {
      const auto left = std::max<std::int64_t>(
          0, std::chrono::duration_cast<std::chrono::nanoseconds>(until - Clock::now()).count());
      timespec span{};
      span.tv_sec = left / 1'000'000'000;
      span.tv_nsec = left % 1'000'000'000;
      if (::ppoll(&one, 1, &span, nullptr) > 0) return true;
      if (Clock::now() >= until) return false;
    }
  }

  /// Take the next frame of the received data; `complete_` is whether it was a message, not a command.
  bool parse(std::string& message) {
    const auto input = std::string_view(input_).substr(start_, end_ - start_);
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
    if ((flags & ~6U) != 0 || size > max_bytes) lost("what came is no message of a daemon");
    if (input.size() - head < size) {
      wanted_ = head + size;
      return false;
    }
    const auto body = input.substr(head, size);
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
  std::size_t start_ = 0, end_ = 0, wanted_ = 0;  // range of `input_` not taken yet; size of its next frame
  bool greeted_ = false, complete_ = false;
  Descriptor fd_;
};

inline constexpr std::string_view ready_of_dealer{
    "\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06" "DEALER", 30};
inline constexpr std::string_view ready_of_subscriber{  // subscribes to everything
    "\x04\x19\x05READY\x0bSocket-Type\0\0\0\x03" "SUB" "\0\x01\x01", 30};

}  // namespace shmmap::detail

#endif  // SHMMAP_DETAIL_SOCKET_HPP
