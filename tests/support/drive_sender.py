# SPDX-License-Identifier: Apache-2.0
"""Sends the scans of a drive to and fro, and odometry in a frame of its own, over two ZeroMQ endpoints.

From one scan to the next it jumps by metres, which no prediction but the odometry's can follow.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import matrix_from_pose
from shmmap_clients.scans.scan_file import read_scan
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher
from shmmap_clients.scans.trajectory import read_trajectory

PERIOD_S = 0.1
_ELSEWHERE = matrix_from_pose(np.array([100.0, 50.0, -3.0, 0.3, 0.2, -1.0]))
_PATIENCE_S = 60.0


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
    wait(socket, "nobody wants odometry")
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
    if not socket.poll(int(_PATIENCE_S * 1000)):
        raise SystemExit(otherwise)


def main() -> None:
    """Send ``SCANS TRUTH SCAN_ADDRESS ODOMETRY_ADDRESS``; poses come back at ``POSE_ADDRESS``."""
    directory, truth, scan_address, odometry_address, pose_address = sys.argv[1:]
    files = sorted(Path(directory).glob("*.npz"))
    order = to_and_fro(len(files))
    poses = read_trajectory(truth).T_map_sensor[order]
    with ScanPublisher(scan_address) as publisher:
        if not publisher.wait_for_subscriber(_PATIENCE_S):
            raise SystemExit("nobody wants scans")
        for number, index in enumerate(order):
            columns = {"xyz": read_scan(files[index])}
            publisher.send(Scan(files[index].stem, PERIOD_S * number, columns))
        publisher.send(None)
        # every scan is there before its odometry, and has to wait for it
        send_odometry(odometry_address, pose_address, poses)


if __name__ == "__main__":
    main()
