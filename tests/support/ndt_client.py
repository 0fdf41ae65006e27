# SPDX-License-Identifier: Apache-2.0
"""A localizing process: ``python -m tests.support.ndt_client ENDPOINT SCAN X,Y,Z,R,P,Y RADIUS``.

Prints ``ready``, waits for a line, attaches the whole window, aligns, prints what it found, how much memory
of its own that took, and which of the map's arrays are not shared; keeps the map until its input ends.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
from shmmap_clients.ndt_scan_matcher import NdtMatcher, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.cli.machine import warmup_alignment
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.scans.scan_file import read_scan

from shmmap.demo.process_usage import process_memory


def not_shared(voxel_map: VoxelMap) -> list[str]:
    """Return the cells' arrays that do not lie in shared memory."""
    shared = []
    for line in Path("/proc/self/maps").read_text(encoding="ascii", errors="replace").splitlines():
        where, flags, *_ = line.split()
        if flags.endswith("s"):
            shared.append(tuple(int(end, 16) for end in where.split("-")))
    found = []
    for key, cell in voxel_map.cells.items():
        for name in ("lattice", "mean", "inverse"):
            array = getattr(cell, name)
            address = array.__array_interface__["data"][0]
            if array.size and not any(begin <= address < end for begin, end in shared):
                found.append(f"{key} {name}")
    return found


def main() -> None:
    """Align once."""
    endpoint, scan_file, words, radius = sys.argv[1:5]
    scan = read_scan(scan_file)
    guess = np.array([float(word) for word in words.split(",")])
    warmup_alignment()  # loads the compiled kernels
    with NdtMatcher() as matcher:
        matcher.align(scan, matrix_from_pose(guess))  # touches the buffers
        print("ready", flush=True)
        sys.stdin.readline()
        before = process_memory(os.getpid()).private_bytes
        rules = MapRules(map_radius=float(radius), lidar_radius=50.0)
        with MapUpdater(endpoint, rules, prepare=matcher.prepare) as maps:
            voxel_map, _ = maps.map_at(float(guess[0]), float(guess[1]))
            matcher.set_map(voxel_map)
            result = matcher.align(scan, matrix_from_pose(guess))
            found = {
                "cells": len(voxel_map.cells),
                "voxels": voxel_map.voxels,
                "T_map_base": result.T_map_base.tolist(),
                "iterations": result.iterations,
                "nvtl": result.nvtl,
                "converged": result.converged,
                "not_shared": not_shared(voxel_map),
                "growth_bytes": process_memory(os.getpid()).private_bytes - before,
            }
            print(json.dumps(found), flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main()
