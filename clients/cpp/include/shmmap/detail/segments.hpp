// SPDX-License-Identifier: Apache-2.0
//
// Mapped segments: shmmap/segment/LAYOUT.md.

#ifndef SHMMAP_DETAIL_SEGMENTS_HPP
#define SHMMAP_DETAIL_SEGMENTS_HPP

#include <sys/mman.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <type_traits>

#include <shmmap/detail/socket.hpp>
#include <shmmap/errors.hpp>

#if !defined(__BYTE_ORDER__) || __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "segments are little-endian, and are read as they are"
#endif

namespace shmmap::detail {

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

/// A mapped object, whose contents do not change while it is mapped.
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

/// A text in a fixed field, padded with zero bytes.
inline std::string fixed_text(const unsigned char* data, std::size_t size) {
  const auto* text = reinterpret_cast<const char*>(data);
  return std::string(text, ::strnlen(text, size));
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

}  // namespace shmmap::detail

#endif  // SHMMAP_DETAIL_SEGMENTS_HPP
