// SPDX-License-Identifier: Apache-2.0
//
// MessagePack: writing messages, and reading untrusted ones.

#ifndef SHMMAP_DETAIL_MESSAGE_PACK_HPP
#define SHMMAP_DETAIL_MESSAGE_PACK_HPP

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <utility>
#include <variant>

#include <shmmap/errors.hpp>

namespace shmmap::detail {

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

using Value = std::variant<std::uint64_t, double, bool, std::string>;

/// Reads one message; throws ProtocolMismatch for unexpected contents.
class Reader {
 public:
  explicit Reader(std::string_view data) : data_(data) {}

  /// Number of the elements of an array, which follow.
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
    if (tag >= 0xd0 && tag <= 0xd3) {  // a signed type, but not negative
      const unsigned bytes = 1U << (tag - 0xd0);
      const std::uint64_t value = big_endian(bytes);
      if ((value >> (8 * bytes - 1)) == 0) return value;
    }
    bad("a number that is not below zero");
  }
  /// A number that may be negative.
  std::int64_t integer() {
    const unsigned tag = peek();
    if (tag >= 0xe0) return static_cast<std::int8_t>(byte());
    if (tag >= 0xd0 && tag <= 0xd3) {
      byte();
      const unsigned shift = 64 - 8 * (1U << (tag - 0xd0));
      return static_cast<std::int64_t>(big_endian(1U << (tag - 0xd0)) << shift) >> shift;
    }
    return static_cast<std::int64_t>(number());
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
    if (tag >= 0xe0 || (tag >= 0xd0 && tag <= 0xd3)) return static_cast<double>(integer());
    return static_cast<double>(number());
  }
  /// Whether the next value is nil, which is then consumed.
  bool nil() {
    if (peek() != 0xc0) return false;
    byte();
    return true;
  }
  bool boolean() {
    const unsigned tag = byte();
    if (tag == 0xc2 || tag == 0xc3) return tag == 0xc3;
    bad("true or false");
  }
  /// A number, a text, true or false; any other value is skipped, and returned as an empty text.
  Value value() {
    const unsigned tag = peek();
    if (tag == 0xc2 || tag == 0xc3) return boolean();
    if (tag == 0xca || tag == 0xcb) return real();
    if (tag < 0x80 || (tag >= 0xcc && tag <= 0xcf)) return number();
    if ((tag & 0xe0U) == 0xa0 || (tag >= 0xd9 && tag <= 0xdb)) return std::string(text());
    skip(1);
    return std::string();
  }
  /// Skip `values` values of any kind.
  void skip(std::uint64_t values) {
    for (; values > 0; --values) {  // nested values are counted, without recursion
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
  /// Each value takes at least a byte, so that a larger count is invalid.
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
    const auto found = data_.substr(at_, size);
    at_ += size;
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

/// Elements of one array in a message: additional ones of a later version are skipped, missing ones have defaults.
class Row {
 public:
  explicit Row(Reader& reader) : reader_(reader), left_(reader.array()) {}
  Row(const Row&) = delete;
  Row& operator=(const Row&) = delete;
  ~Row() = default;
  /// Whether there is another element, which the reader returns next.
  bool next() { return left_ > 0 && left_-- > 0; }
  Reader& reader() { return reader_; }
  /// The next element, which has no default.
  Reader& get() {
    if (!next()) throw ProtocolMismatch("protocol_mismatch", "the daemon's message is too short");
    return reader_;
  }
  void end() { reader_.skip(std::exchange(left_, 0)); }

 private:
  Reader& reader_;
  std::uint64_t left_;
};

}  // namespace shmmap::detail

#endif  // SHMMAP_DETAIL_MESSAGE_PACK_HPP
