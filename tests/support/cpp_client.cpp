// SPDX-License-Identifier: Apache-2.0
// A client in C++ that does what it is told, a line at a time; words are separated by tabs.
//
//   connect ENDPOINT                        area X Y RADIUS LAYERS WAIT          selected IDS LAYERS WAIT
//   differential X Y RADIUS LAYERS WAIT     with the versions of the cells that it keeps
//   columns      of what it keeps, with a CRC-32 of their bytes
//   drop         let go of everything       fuzz SEED COUNT HEX    mutate a `cells` reply so many times
//
// The answer ends with a line "end"; errors are "error CODE MESSAGE".

#include <cstdio>
#include <iostream>
#include <random>
#include <shmmap/shmmap.hpp>
#include <sstream>

namespace {

std::map<std::pair<std::string, std::string>, shmmap::CellPtr> kept;
std::unique_ptr<shmmap::Client> client;

std::vector<std::string> split(const std::string& text, char at) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, at);) parts.push_back(part);
  return parts;
}

void take(const shmmap::Answer& answer) {
  for (const auto& id : answer.removed) std::cout << "removed\t" << id << "\n";
  for (const auto version : answer.removed_versions) {
    std::cout << "removed_version\t" << version << "\n";
    for (auto one = kept.begin(); one != kept.end();)
      one = one->second->version == version ? kept.erase(one) : std::next(one);
  }
  for (const auto& cell : answer.cells) {
    std::cout << "cell\t" << cell->id << "\t" << cell->layer << "\t" << cell->version << "\t" << cell->rows << "\t"
              << cell->stale << "\t" << cell->frame_id << "\n";
    kept[{cell->id, cell->layer}] = cell;
  }
  for (const auto& [id, layer] : answer.pending) std::cout << "pending\t" << id << "\t" << layer << "\n";
  for (const auto& one : answer.failed)
    std::cout << "failed\t" << one.id << "\t" << one.layer << "\t" << one.code << "\t" << one.message << "\n";
  std::cout << "answer\t" << answer.epoch << "\t" << answer.map_version << "\t" << answer.covered << "\n";
}

void print_columns() {
  for (const auto& [key, cell] : kept) {
    for (const auto& column : cell->columns) {
      std::cout << cell->id << "\t" << cell->layer << "\t" << column.name << "\t" << column.dtype << "\t";
      for (const auto side : column.shape) std::cout << side << " ";
      std::cout << "\t" << column.unit << "\t"
                << shmmap::detail::crc32(static_cast<const unsigned char*>(column.data), column.nbytes) << "\n";
    }
  }
}

/// Mutate a message again and again; whatever comes of it is an answer or an error.
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
      row.get().skip(1);
      row.get().skip(1);
      shmmap::detail::read_cells(reader, row);
      ++read;
    } catch (const shmmap::Error&) {
    }
  }
  std::cout << "read\t" << read << "\n";
}

void obey(const std::vector<std::string>& words) {
  const auto& what = words.at(0);
  const auto circle = [&] {
    return shmmap::Circle{std::stod(words.at(1)), std::stod(words.at(2)), std::stod(words.at(3))};
  };
  const auto wait = [&](std::size_t at) {
    return words.at(at) == "-" ? std::nullopt : std::optional<double>(std::stod(words.at(at)));
  };
  if (what == "connect") {
    client = std::make_unique<shmmap::Client>(shmmap::Options{words.at(1), "cpp"});
    std::cout << "session\t" << client->session() << "\t" << client->epoch() << "\n";
  } else if (what == "area") {
    take(client->area(circle(), split(words.at(4), ';'), wait(5)));
  } else if (what == "differential") {
    std::vector<std::uint64_t> versions;
    for (const auto& [key, cell] : kept) versions.push_back(cell->version);
    take(client->differential(circle(), {}, versions, split(words.at(4), ';'), wait(5)));
  } else if (what == "selected") {
    take(client->selected(split(words.at(1), ';'), split(words.at(2), ';'), wait(3)));
  } else if (what == "columns") {
    print_columns();
  } else if (what == "drop") {
    kept.clear();
    client->release();
  } else if (what == "fuzz") {
    fuzz(static_cast<unsigned>(std::stoul(words.at(1))), std::stoi(words.at(2)), words.at(3));
  } else {
    std::cout << "unknown\t" << what << "\n";
  }
}

}  // namespace

int main() {
  for (std::string line; std::getline(std::cin, line);) {
    try {
      obey(split(line, '\t'));
    } catch (const shmmap::Error& error) {
      std::cout << "error\t" << error.code() << "\t" << error.what() << "\n";
    }
    std::cout << "end" << std::endl;
  }
}
