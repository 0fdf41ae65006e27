// SPDX-License-Identifier: Apache-2.0
//
// shmmap's client: requests cells of a point-cloud map from the daemon, and maps them.
//
//     shmmap::Client client;                                    // finds the daemon as every client does
//     auto answer = client.area(shmmap::Square{x, y, 150.0});   // Autoware's area test, metres
//     for (const auto& cell : answer.cells) {
//       auto xyz = cell->column<float>("xyz");                  // rows of three, in shared memory
//       use(xyz.data(), xyz.rows());
//     }
//
// Header-only, C++17, Linux, only the C library.  The messages are specified in shmmap/protocol/PROTOCOL.md, and the
// segments in shmmap/segment/LAYOUT.md; where both are silent, this client acts like the Python client.
//
// A `Client` is one connection and one session: move it, do not share it among threads.  Cells may be used by
// any thread, outlive their client and the daemon, and are unmapped with their last owner.  The library starts no
// threads, handles no signals and has no globals.  All input is checked before use: damaged bytes cause an
// exception, not a crash.
//
// One header for each concept, in reading order.

#ifndef SHMMAP_SHMMAP_HPP
#define SHMMAP_SHMMAP_HPP

#if __cplusplus < 201703L
#error "C++17 is needed: -std=c++17"
#endif

#include <shmmap/errors.hpp>
#include <shmmap/areas.hpp>
#include <shmmap/cell.hpp>
#include <shmmap/answer.hpp>
#include <shmmap/client.hpp>
#include <shmmap/points_around.hpp>
#include <shmmap/point_cloud2.hpp>
#include <shmmap/window.hpp>
#include <shmmap/events.hpp>
#include <shmmap/statistics.hpp>

#endif  // SHMMAP_SHMMAP_HPP
