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
// threads, handles signals or keeps globals.  Whatever is read is checked first; damaged bytes cost an
// exception, no crash.
//
// One header for each concept, in the order in which they explain each other.

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
