// SPDX-License-Identifier: Apache-2.0
//
// Messages to and from the daemon: shmmap/protocol/PROTOCOL.md.

#ifndef SHMMAP_DETAIL_MESSAGES_HPP
#define SHMMAP_DETAIL_MESSAGES_HPP

#include <cstring>
#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include <shmmap/answer.hpp>
#include <shmmap/areas.hpp>
#include <shmmap/detail/columns.hpp>
#include <shmmap/detail/message_pack.hpp>
#include <shmmap/errors.hpp>

namespace shmmap::detail {

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
  const auto route = thinned(intent->route);
  to.array(route.size());
  for (const auto& [x, y] : route) {
    to.array(2);
    to.real(x);
    to.real(y);
  }
}

inline void write(Writer& to, const std::vector<std::string>& texts) {
  to.array(texts.size());
  for (const auto& text : texts) to.text(text);
}

inline void write(Writer& to, const Held& held) {
  to.array(held.layers.empty() ? 2 : 3);
  to.text(held.id);
  if (held.version) to.number(*held.version);
  else to.nil();
  if (!held.layers.empty()) write(to, held.layers);
}

inline constexpr std::uint64_t protocol_major = 3, protocol_minor = 0;
inline constexpr std::size_t max_selected = 128;  // layers of cells in a request by id
inline constexpr std::size_t max_named = 2048;    // cells that one request names as held

/// The daemon's properties in its welcome.
struct Welcome {
  std::uint64_t minor = 0, epoch = 0, session = 0;
  std::string instance, shm_dir, id_prefix, segment_prefix, frame_id, events;
};

inline Welcome read_welcome(Row& row) {
  Welcome found;
  const auto major = row.get().number();
  found.minor = row.get().number();
  if (major != protocol_major)
    throw ProtocolMismatch("protocol_mismatch",
                           "the daemon speaks protocol " + std::to_string(major) + "." + std::to_string(found.minor) +
                               ", this client " + std::to_string(protocol_major) + "." + std::to_string(protocol_minor),
                           major < protocol_major ? "update the daemon, and restart it" : "update this client");
  row.get().skip(1);  // its version
  found.instance = row.get().text();
  found.epoch = row.get().number();
  found.session = row.get().number();
  row.get().number();  // the map's version, which each answer has
  row.get().skip(1);   // the map's path
  found.frame_id = row.get().text();
  found.shm_dir = row.get().text();
  found.id_prefix = row.get().text();
  found.segment_prefix = row.get().text();
  for (int left = 5; left > 0 && row.next(); --left) row.reader().skip(1);  // cells, bounds, layers, budget, pid
  if (row.next()) found.events = row.reader().text();
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
  row.get().number();  // rows, which the segment has too
  for (double* side : {&found.min_x, &found.min_y, &found.max_x, &found.max_y}) *side = row.get().real();
  if (row.next()) found.stale = reader.boolean();
  row.end();
  return found;
}

/// The reply to a request for cells, before anything is mapped.
struct Cells {
  Answer answer;
  std::vector<Handle> handles;
  std::string next;  // where to go on, if there are more cells than one reply has
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
    if (one.next()) reader.skip(failure.holders = reader.array());
    if (one.next() && !reader.nil()) {
      Row sides(reader);
      auto& box = failure.box.emplace();
      for (double* side : {&box.min_x, &box.min_y, &box.max_x, &box.max_y}) *side = sides.get().real();
      sides.end();
    }
    one.end();
    answer.failed.push_back(std::move(failure));
  }
  if (row.next())
    for (auto left = reader.array(); left > 0; --left) answer.layers.emplace_back(reader.text());
  if (row.next()) answer.covered = reader.boolean();
  if (row.next()) answer.reason = reader.text();
  if (row.next()) found.next = reader.text();
  row.end();
  return found;
}

/// Read one page of the map's list after its versions; returns the start of the next one.
inline std::optional<std::uint64_t> read_page(Row& row, std::vector<MapCell>& cells) {
  Reader& reader = row.get();
  for (auto left = reader.array(); left > 0; --left) {
    Row one(reader);
    MapCell cell;
    cell.id = one.get().text();
    cell.version = one.get().number();
    for (double* side : {&cell.min_x, &cell.min_y, &cell.max_x, &cell.max_y}) *side = one.get().real();
    cell.source_bytes = one.get().number();
    for (auto* height : {&cell.z_min, &cell.z_max})
      if (one.next() && !reader.nil()) *height = reader.real();
    one.end();
    cells.push_back(std::move(cell));
  }
  std::optional<std::uint64_t> next;
  if (row.next() && !reader.nil()) next = reader.number();
  row.end();
  return next;
}

[[noreturn]] inline void read_error(Row& row) {
  const std::string code(row.get().text()), message(row.get().text());
  const std::string hint(row.next() ? row.reader().text() : std::string_view{});
  if (code == "bad_request") throw BadRequest(code, message, hint);
  if (code == "protocol_mismatch") throw ProtocolMismatch(code, message, hint);
  throw Refused(code, message, hint);
}

}  // namespace shmmap::detail

#endif  // SHMMAP_DETAIL_MESSAGES_HPP
