# SPDX-License-Identifier: Apache-2.0
"""Localization: a drive through a generated town; programs that localize, listen to poses, send scans.

``python -m tests.support.ndt_programs localize ENDPOINT SCAN X,Y,Z,R,P,Y RADIUS`` prints ``ready``, waits for
a line, attaches the whole window, aligns, prints what it found, how much memory of its own that took, and
which of the map's arrays are not shared; it keeps the map until its input ends.

``... listen ADDRESS COUNT`` receives poses over ZeroMQ and prints them as JSON; it knows only the wire.

``... send SCANS TRUTH SCAN_ADDRESS ODOMETRY_ADDRESS POSE_ADDRESS`` sends the scans of a drive to and fro, and
odometry in a frame of its own.  From one scan to the next it jumps by metres: only the odometry predicts it.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.cli.machine import warmup_alignment
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.scans.scan_file import read_scan
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher
from shmmap_clients.scans.trajectory import read_trajectory, tum_line

from shmmap.demo.program import process_memory
from shmmap.simulation.lidar import Lidar
from shmmap.simulation.town import Town

if TYPE_CHECKING:
    import pytest


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


def localize(endpoint: str, scan_file: str, words: str, radius: str) -> None:
    """Align once."""
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
            voxel_map = maps.map_at(float(guess[0]), float(guess[1]))
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


def listen(address: str, count: str) -> None:
    """Print that many poses."""
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe(b"")
    socket.connect(address)
    print(json.dumps([msgspec.msgpack.decode(socket.recv()) for _ in range(int(count))]))
    socket.close(0)
    context.term()


PERIOD_S = 0.1
_ELSEWHERE = matrix_from_pose(np.array([100.0, 50.0, -3.0, 0.3, 0.2, -1.0]))
_TIMEOUT_S = 60.0


def to_and_fro(count: int) -> list[int]:
    """Return every number below ``count`` once, from both halves in turn."""
    half = -(-count // 2)
    return [n // 2 + n % 2 * half for n in range(count)]


def send_odometry(address: str, pose_address: str, poses: NDArray[np.float64]) -> None:
    """Send a pose each period, as the wire wants them and no more; each only after the answer to the last."""
    context = zmq.Context()
    answers = context.socket(zmq.SUB)
    answers.subscribe(b"")
    answers.connect(pose_address)
    socket = context.socket(zmq.XPUB)
    socket.bind(address)
    wait(socket, "no listener for odometry")
    for number, T in enumerate(poses):
        entry = {"shmmap_pose": 1, "stamp_s": PERIOD_S * number, "T": (_ELSEWHERE @ T).ravel().tolist()}
        socket.send(msgspec.msgpack.encode(entry))
        wait(answers, f"no pose of scan {number}")
        answers.recv()
    answers.close(0)
    socket.close(0)
    context.term()


def wait(socket: zmq.Socket[bytes], otherwise: str) -> None:
    """Wait until there is something to receive."""
    if not socket.poll(int(_TIMEOUT_S * 1000)):
        raise SystemExit(otherwise)


def send(directory: str, truth: str, scan_address: str, odometry_address: str, pose_address: str) -> None:
    """Send every scan, then odometry."""
    files = sorted(Path(directory).glob("*.npz"))
    order = to_and_fro(len(files))
    poses = read_trajectory(truth).T_map_sensor[order]
    with ScanPublisher(scan_address) as publisher:
        if not publisher.wait_for_subscriber(_TIMEOUT_S):
            raise SystemExit("no listener for scans")
        for number, index in enumerate(order):
            columns = {"xyz": read_scan(files[index])}
            publisher.send(Scan(files[index].stem, PERIOD_S * number, columns))
        publisher.send(None)
        # every scan is there before its odometry, and has to wait for it
        send_odometry(odometry_address, pose_address, poses)


_HEIGHT_M = 1.8
_SEEN_DENSITY = 12.0
_LIDAR = Lidar(rings=32, azimuth_deg=0.6, farthest=45.0)


@dataclass(frozen=True)
class TownDrive:
    """Files of a drive: the map's directory, the scans' directory, their poses."""

    map_dir: Path
    scans: Path
    truth: Path
    points: NDArray[np.float32]
    poses: NDArray[np.float64]  # (N, 6) pose vectors


def make_town_drive(
    folder: Path, *, blocks: tuple[int, int], density: float, frames: int, step: float
) -> TownDrive:
    """Write a town and ``frames`` scans that the simulated LiDAR takes every ``step`` metres.

    The LiDAR looks at a denser sampling of the same town: no scan holds the map's own points.
    """
    town = Town(seed=3, blocks=blocks, density=density)
    town.write(folder / "map")
    cloud = np.concatenate([tile["xyz"] for tile in town.tiles()])
    route = town.route(length=frames * step, step=step)[:frames]
    heights = town.ground_height(route[:, 0], route[:, 1]) + _HEIGHT_M
    zeros = np.zeros(len(route))
    poses = np.stack([route[:, 0], route[:, 1], heights, zeros, zeros, route[:, 2]], axis=1)
    dense = Town(seed=3, blocks=blocks, density=_SEEN_DENSITY)
    seen = np.concatenate([tile["xyz"] for tile in dense.tiles()])
    scans = folder / "scans"
    scans.mkdir()
    lines = []
    for number, pose in enumerate(poses):
        rng = np.random.default_rng(number)
        near = seen[(np.abs(seen[:, :2] - pose[:2]) < _LIDAR.farthest).all(axis=1)]
        T = matrix_from_pose(pose)
        np.savez(scans / f"scan_{number:04}.npz", xyz=_LIDAR.scan(near, T, rng).xyz)
        lines.append(tum_line(0.1 * number, T))
    (folder / "truth.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return TownDrive(folder / "map", scans, folder / "truth.txt", cloud, poses)


def town_drive_once(
    factory: pytest.TempPathFactory, *, blocks: tuple[int, int], density: float, frames: int, step: float
) -> TownDrive:
    """Return such a drive, made once for all of pytest's processes."""
    from tests.support.compiled_programs import made_once  # not for the programs

    def make(folder: Path) -> None:
        drive = make_town_drive(folder, blocks=blocks, density=density, frames=frames, step=step)
        np.savez(folder / "drive.npz", points=drive.points, poses=drive.poses)

    folder = made_once(factory, f"drive-{blocks}-{density}-{frames}-{step}".replace(" ", ""), make)
    with np.load(folder / "drive.npz") as arrays:
        return TownDrive(
            folder / "map", folder / "scans", folder / "truth.txt", arrays["points"], arrays["poses"]
        )


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {"localize": localize, "listen": listen, "send": send}
    programs[sys.argv[1]](*sys.argv[2:])
