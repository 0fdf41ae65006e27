// SPDX-License-Identifier: Apache-2.0
// A client in C++ that does what lines say, one at a time; words are separated by tabs, what is within a word
// by spaces or semicolons.  `tests/support/cpp_client.py` says which lines there are, and reads the answers.
//
// The answer ends with a line "end"; errors are "error CODE MESSAGE".  Cells are numbered, and kept until `drop`.

#include <signal.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>

namespace {

/// Whether an environment variable names this step, `STEP:N` for the Nth time that it is come to.
bool is_named(const char* variable, const char* label, int& times) {
  const char* wanted = std::getenv(variable);
  if (wanted == nullptr) return false;
  const char* colon = std::strchr(wanted, ':');
  const std::size_t size = colon != nullptr ? static_cast<std::size_t>(colon - wanted) : std::strlen(wanted);
  if (std::strlen(label) != size || std::strncmp(label, wanted, size) != 0) return false;
  ++times;
  return colon == nullptr || times == std::atoi(colon + 1);
}

/// End the process where `SHMMAP_TEST_CRASH=STEP:N` says, as `shmmap.failpoints` does in Python; stop it each time
/// that it comes to `SHMMAP_TEST_STOP=STEP`.
void come_to(const char* label) {
  static int crashes = 0, stops = 0;
  if (is_named("SHMMAP_TEST_CRASH", label, crashes)) ::kill(::getpid(), SIGKILL);
  if (is_named("SHMMAP_TEST_STOP", label, stops)) ::kill(::getpid(), SIGSTOP);
}

}  // namespace

#define SHMMAP_FAILPOINT(label) come_to(label)

#include <iomanip>
#include <iostream>
#include <random>
#include <shmmap/shmmap.hpp>
#include <sstream>

namespace {

std::unique_ptr<shmmap::Client> client;
std::unique_ptr<shmmap::Window> window;
std::unique_ptr<shmmap::EventStream> events;
std::map<std::uint64_t, shmmap::CellPtr> kept;
std::uint64_t last_number = 0;

shmmap::Client& asked() { return window ? window->client() : *client; }

std::vector<std::string> split(const std::string& text, char at) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, at);) parts.push_back(part);
  return parts;
}

double real(const std::string& text) { return std::stod(text); }

std::optional<double> maybe(const std::string& text) {
  return text == "-" ? std::nullopt : std::optional(std::stod(text));
}

shmmap::Area area(const std::string& text) {
  const auto words = split(text, ' ');
  std::optional<shmmap::ZRange> z;
  if (words.size() > 5) z = shmmap::ZRange{real(words[words.size() - 2]), real(words[words.size() - 1])};
  if (words[0] == "box") return shmmap::Box{real(words[1]), real(words[2]), real(words[3]), real(words[4]), {}};
  if (words[0] == "square") return shmmap::Square{real(words[1]), real(words[2]), real(words[3]), z};
  return shmmap::Circle{real(words[1]), real(words[2]), real(words[3]), z};
}

void print(const std::string& role, const shmmap::CellPtr& cell) {
  auto there = std::find_if(kept.begin(), kept.end(), [&cell](const auto& one) { return one.second == cell; });
  if (there == kept.end()) there = kept.emplace(++last_number, cell).first;
  std::cout << role << "\t" << there->first << "\t" << cell->id << "\t" << cell->layer << "\t" << cell->version << "\t"
            << cell->rows << "\t" << cell->stale << "\t" << cell->frame_id << "\t" << cell->min_x << " " << cell->min_y
            << " " << cell->max_x << " " << cell->max_y << "\n";
}

template <typename Pending>
void print_missing(const Pending& pending, const std::vector<shmmap::Failure>& failed) {
  for (const auto& [id, layer] : pending) std::cout << "pending\t" << id << "\t" << layer << "\n";
  for (const auto& one : failed)
    std::cout << "failed\t" << one.id << "\t" << one.layer << "\t" << one.code << "\t" << one.message << "\n";
}

void print(const shmmap::Answer& answer) {
  for (const auto& id : answer.removed) std::cout << "removed\t" << id << "\n";
  for (const auto version : answer.removed_versions) std::cout << "removed_version\t" << version << "\n";
  for (const auto& cell : answer.cells) print("cell", cell);
  print_missing(answer.pending, answer.failed);
  std::cout << "answer\t" << answer.epoch << "\t" << answer.map_version << "\t" << answer.covered << "\t" << answer.reason << "\n";
}

void print(const shmmap::WindowUpdate& update) {
  for (const auto& cell : update.added) print("added", cell);
  for (const auto& cell : update.kept) print("kept", cell);
  for (const auto& cell : update.changed) print("changed", cell);
  for (const auto& id : update.removed) std::cout << "removed\t" << id << "\n";
  print_missing(update.pending, update.failed);
  std::cout << "update\t" << update.current << "\t" << update.covered << "\t" << update.complete() << "\n";
}

/// Of the cells with these numbers, or of all.
void print_columns(const std::vector<std::string>& numbers) {
  std::map<std::pair<std::string, std::string>, shmmap::CellPtr> sorted;
  const auto add = [&sorted](const auto& cell) { sorted[{cell->id, cell->layer}] = cell; };
  for (const auto& number : numbers) add(kept.at(std::stoull(number)));
  if (numbers.empty())
    for (const auto& [number, cell] : kept) add(cell);
  for (const auto& [key, cell] : sorted) {
    for (const auto& column : cell->columns) {
      std::cout << cell->id << "\t" << cell->layer << "\t" << column.name << "\t" << column.dtype << "\t";
      for (const auto side : column.shape) std::cout << side << " ";
      std::cout << "\t" << column.unit << "\t"
                << shmmap::detail::crc32(static_cast<const unsigned char*>(column.data), column.nbytes) << "\n";
    }
    if (cell->lattice) {
      std::cout << cell->id << "\t" << cell->layer << "\tlattice";
      for (std::size_t axis = 0; axis < 3; ++axis)
        std::cout << "\t" << cell->lattice->leaf[axis] << " " << cell->lattice->first[axis] << " "
                  << cell->lattice->shape[axis];
      std::cout << "\n";
    }
  }
}

void print_bytes(const shmmap::Column& column) {
  std::cout << column.dtype << "\t";
  for (const auto side : column.shape) std::cout << side << " ";
  std::cout << "\t" << std::hex << std::setfill('0');
  const auto* bytes = static_cast<const unsigned char*>(column.data);
  for (std::uint64_t at = 0; at < column.nbytes; ++at) std::cout << std::setw(2) << static_cast<unsigned>(bytes[at]);
  std::cout << std::dec << "\t" << column.checksum << "\n";
}

void print_statistics(const std::string& instance, const std::string& shm_dir) {
  shmmap::StatisticsReader reader(instance, shm_dir);
  const auto found = reader.snapshot();
  constexpr std::array<const char*, 5> states{"absent", "dead", "stopped", "hung", "healthy"};
  std::cout << "state\t" << states.at(static_cast<std::size_t>(found.state)) << "\n";
  for (const auto& [name, value] : found.identity) std::cout << "identity\t" << name << "\t" << value << "\n";
  for (const auto& one : found.counters)
    std::cout << "counter\t" << one.name << "\t" << one.unit << "\t" << (one.is_gauge ? "gauge" : "counter") << "\t"
              << one.help << "\t" << one.value << "\n";
  for (const auto& one : found.histograms) {
    std::cout << "histogram\t" << one.name << "\t" << one.sum_ns << "\t" << one.quantile(0.99) << "\t";
    for (const auto count : one.counts) std::cout << count << " ";
    std::cout << "\n";
  }
}

void print(const shmmap::Happening& happening) {
  if (const auto* missed = std::get_if<shmmap::MissedEvents>(&happening)) {
    std::cout << "missed\t" << missed->epoch << "\t" << missed->first << "\t" << missed->last << "\n";
    return;
  }
  const auto& event = std::get<shmmap::Event>(happening);
  std::cout << "event\t" << event.kind << "\t" << event.seq << "\t" << event.epoch << "\t" << event.unix_ns;
  for (const auto& [name, value] : event.fields) {
    std::cout << "\t" << name << "=";
    std::visit([](const auto& one) { std::cout << std::setprecision(17) << one; }, value);
  }
  std::cout << "\n";
}

/// Mutate a message many times; each must give an answer or an error.
void fuzz(unsigned seed, int count, const std::string& hex) {
  std::string message;
  for (std::size_t at = 0; at + 1 < hex.size(); at += 2)
    message.push_back(static_cast<char>(std::stoi(hex.substr(at, 2), nullptr, 16)));
  std::mt19937 random(seed);
  const auto below = [&random](std::size_t limit) { return std::uniform_int_distribution<std::size_t>(0, limit - 1)(random); };
  int read = 0;
  for (int number = 0; number < count; ++number) {
    std::string changed = message;
    for (auto left = 1 + below(4); left > 0; --left) {
      switch (below(4)) {
        case 0: changed[below(changed.size())] = static_cast<char>(below(256)); break;
        case 1: changed.resize(1 + below(changed.size())); break;
        case 2: changed.insert(below(changed.size()), 1 + below(8), static_cast<char>(below(256))); break;
        default: {
          const auto from = below(changed.size());
          changed.erase(from, 1 + below(8));
          if (changed.empty()) changed = message;
        }
      }
    }
    // in memory of its own, so that a byte too far is noticed
    const std::vector<char> exact(changed.begin(), changed.end());
    try {
      shmmap::detail::Reader reader(std::string_view(exact.data(), exact.size()));
      shmmap::detail::Row row(reader);
      const auto kind = row.get().text();
      if (kind == "cells" || kind == "metadata_page") row.get().skip(1);
      if (kind == "metadata_page") {
        row.get().number(), row.get().number();
        std::vector<shmmap::MapCell> cells;
        shmmap::detail::read_page(row, cells);
      } else if (kind == "cells") {
        shmmap::detail::read_cells(reader, row);
      } else {  // an event
        shmmap::detail::Reader again(std::string_view(exact.data(), exact.size()));
        shmmap::detail::Row whole(again);
        shmmap::detail::read_event(whole);
      }
      ++read;
    } catch (const shmmap::Error&) {
    }
  }
  std::cout << "read\t" << read << "\n";
}

void obey(const std::vector<std::string>& words) {
  const auto& what = words.at(0);
  if (what == "connect") {
    client = std::make_unique<shmmap::Client>(shmmap::Options{words.at(1), words.at(2), {}, real(words.at(3))});
    std::cout << "session\t" << client->session() << "\t" << client->epoch() << "\n";
  } else if (what == "area") {
    print(asked().area(area(words.at(1)), split(words.at(2), ';'), maybe(words.at(3))));
  } else if (what == "differential") {
    std::vector<shmmap::Held> held;
    for (std::size_t at = 4; at < words.size(); ++at) {
      const auto parts = split(words[at], ';');
      shmmap::Held one{parts.at(0)};
      if (parts.size() > 1) one.version = std::stoull(parts[1]);
      if (parts.size() > 2) one.layers = {parts[2]};
      held.push_back(std::move(one));
    }
    std::vector<std::uint64_t> versions;
    if (held.empty())
      for (const auto& [number, cell] : kept) versions.push_back(cell->version);
    print(asked().differential(area(words.at(1)), held, versions, split(words.at(2), ';'), maybe(words.at(3))));
  } else if (what == "selected") {
    print(asked().selected(split(words.at(1), ';'), split(words.at(2), ';'), maybe(words.at(3))));
  } else if (what == "metadata") {
    const auto listing = asked().metadata(words.size() > 1 ? std::optional(area(words[1])) : std::nullopt);
    for (const auto& cell : listing.cells)
      std::cout << "cell\t" << cell.id << "\t" << cell.version << "\t" << cell.min_x << "\t" << cell.min_y << "\t"
                << cell.max_x << "\t" << cell.max_y << "\t" << cell.source_bytes << "\t" << cell.z_min.value_or(0.0)
                << "\t" << cell.z_max.value_or(0.0) << "\n";
    std::cout << "listing\t" << listing.epoch << "\t" << listing.map_version << "\n";
  } else if (what == "window") {
    shmmap::WindowOptions options;
    options.radius = real(words.at(1));
    options.layers = split(words.at(2), ';');
    options.shape = words.at(3) == "square" ? shmmap::Shape::square : shmmap::Shape::circle;
    options.update_distance = real(words.at(4));
    options.refresh_interval = real(words.at(5));
    options.retention = shmmap::Retention{real(words.at(6)), real(words.at(7)), real(words.at(8))};
    if (words.size() > 10) options.z = shmmap::ZRange{real(words[9]), real(words[10])};
    window = std::make_unique<shmmap::Window>(std::move(*client), options);
    client.reset();
  } else if (what == "move") {
    shmmap::Intent pose{real(words.at(1)), real(words.at(2)), real(words.at(3)), real(words.at(4)), maybe(words.at(5))};
    for (std::size_t at = 7; at < words.size(); ++at) {
      const auto parts = split(words[at], ' ');
      pose.route.push_back({real(parts.at(0)), real(parts.at(1))});
    }
    const auto wait = maybe(words.at(6));
    print(window->move_to(pose, wait.value_or(5.0)));
  } else if (what == "state") {
    const auto error = window->error();
    std::cout << "state\t" << window->complete() << "\t" << (error ? error->code() : "-") << "\t"
              << window->stale_since().has_value() << "\t" << window->map_version() << "\n";
    for (const auto& cell : window->cells()) print("cell", cell);
  } else if (what == "covers") {
    std::cout << "covers\t" << window->covers(real(words.at(1)), real(words.at(2)), real(words.at(3))) << "\n";
  } else if (what == "around") {
    const auto near = window->points_around(real(words.at(1)), real(words.at(2)), real(words.at(3)),
                                            words.size() > 4 ? words[4] : "");
    for (const auto& one : near.cells) print(one.whole ? "whole" : "part", one.cell);
    std::cout << "around\t" << near.covered << "\t" << (words.size() > 5 ? near.count() : 0) << "\n";
  } else if (what == "columns") {
    print_columns({words.begin() + 1, words.end()});
  } else if (what == "bytes") {
    print_bytes(kept.at(std::stoull(words.at(1)))->named(words.at(2)));
  } else if (what == "drop") {
    if (words.size() == 1) kept.clear();
    for (std::size_t at = 1; at < words.size(); ++at) kept.erase(std::stoull(words[at]));
  } else if (what == "release") {
    asked().release();
  } else if (what == "close") {
    window.reset();
    client.reset();
    events.reset();
  } else if (what == "statistics") {
    print_statistics(words.at(1), words.at(2));
  } else if (what == "events") {
    events = std::make_unique<shmmap::EventStream>(shmmap::Options{words.at(1), "events", {}, 60.0}, maybe(words.at(2)));
  } else if (what == "epoch") {
    std::cout << "epoch\t" << events->epoch() << "\n";
  } else if (what == "next") {
    if (const auto happening = events->next(real(words.at(1)))) print(*happening);
  } else if (what == "fuzz") {
    fuzz(static_cast<unsigned>(std::stoul(words.at(1))), std::stoi(words.at(2)), words.at(3));
  } else {
    std::cout << "unknown\t" << what << "\n";
  }
}

}  // namespace

int main() {
  std::cout << std::setprecision(17);
  for (std::string line; std::getline(std::cin, line);) {
    try {
      obey(split(line, '\t'));
    } catch (const shmmap::Error& error) {
      std::cout << "error\t" << error.code() << "\t" << error.what() << "\n";
    }
    std::cout << "end" << std::endl;
  }
}
