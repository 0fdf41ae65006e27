// SPDX-License-Identifier: Apache-2.0
// A vehicle's control loop with a window, for the benchmark `control_loop` and for tests:
//
//   control_loop ENDPOINT RADIUS TIMEOUT
//
// Reads lines.  "go STEPS WAIT PERIOD": that many rounds of PERIOD seconds each, 0.1 m along x in each; prints how long
// each `move_to` took, and after it a sleep of WAIT seconds alone (nanoseconds), how often each error came, how many
// updates were current, and the cells that came and went.  "complete SECONDS": waits, and prints the cells.

#include <chrono>
#include <cstdio>
#include <iostream>
#include <map>
#include <shmmap/shmmap.hpp>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

double x = 0.0;
std::map<std::string, std::uint64_t> held;  // as updates say

long long nanoseconds(Clock::duration span) { return std::chrono::nanoseconds(span).count(); }

Clock::duration span_of(double seconds) {
  return std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
}

std::string move(shmmap::Window& window, double wait, std::size_t& current) {
  try {
    const auto update = window.move_to({x, 0.0, 10.0}, wait);
    for (const auto& id : update.removed) held.erase(id);
    for (const auto* cells : {&update.added, &update.changed})
      for (const auto& cell : *cells) held[cell->id] = cell->version;
    current += update.current ? 1 : 0;
    return "-";
  } catch (const shmmap::Error& error) {
    return error.code();
  }
}

void go(shmmap::Window& window, int steps, double wait, double period) {
  std::vector<long long> moves, sleeps;
  std::map<std::string, int> codes;
  std::size_t current = 0;
  auto next = Clock::now();
  for (int step = 0; step < steps; ++step) {
    x += 0.1;
    const auto began = Clock::now();
    ++codes[move(window, wait, current)];
    const auto moved = Clock::now();
    std::this_thread::sleep_for(span_of(wait));
    const auto slept = Clock::now();
    moves.push_back(nanoseconds(moved - began));
    sleeps.push_back(nanoseconds(slept - moved));
    next += span_of(period);
    std::this_thread::sleep_until(next);
  }
  for (const auto* one : {&moves, &sleeps}) {
    for (const auto span : *one) std::cout << span << " ";
    std::cout << "\n";
  }
  for (const auto& [code, count] : codes) std::cout << code << " " << count << " ";
  std::cout << "\n" << current << "\n";
}

}  // namespace

int main(int count, char** words) {
  if (count != 4) return 2;
  shmmap::Options options;
  options.endpoint = words[1];
  options.name = "control loop";
  options.timeout = std::stod(words[3]);
  shmmap::WindowOptions kept;
  kept.radius = std::stod(words[2]);
  kept.update_distance = 0.0;  // it asks in each round
  shmmap::Window window(options, kept);
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream in(line);
    std::string what;
    double one = 0.0, other = 0.0, third = 0.0;
    in >> what >> one >> other >> third;
    if (what == "go") {
      go(window, static_cast<int>(one), other, third);
    } else {
      const bool is_complete = window.wait_until_complete(one);
      std::size_t current = 0;
      const auto code = move(window, 0.0, current);
      std::cout << is_complete << " " << code << " " << x << "\n";
      for (const auto& [id, version] : held) std::cout << id << " " << version << " ";
      std::cout << "\n";
    }
    std::cout << std::flush;
  }
}
