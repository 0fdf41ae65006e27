# SPDX-License-Identifier: Apache-2.0
"""A client of a live map that becomes another account, where that could not start a Python itself.

    python -m tests.support.other_account UID GID GROUP,GROUP ENDPOINT map|read

All that it may have to import is imported before.  ``map`` sends the first scans of
`tests.support.live_drive` and says up to which they are durable; ``read`` says what it read, by list and
by point.  Both say the code of the error where there is one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence

import numpy as np

import shmmap
from shmmap.chunks.marking import Marker
from shmmap.client.live.live_map import LiveMap
from shmmap.errors import ShmmapError
from tests.support.daemon_process import ROOT
from tests.support.live_drive import FILTER, RESOLUTION, drive
from tests.support.live_reference import held

SCANS = 3


def as_client(uid: int, groups: Sequence[int], endpoint: str, action: str) -> object:
    """Run this as a program, in these groups and no others; returns what it says."""
    command = [
        sys.executable,
        "-m",
        "tests.support.other_account",
        str(uid),
        str(groups[0]),
        ",".join(map(str, groups)),
        endpoint,
        action,
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found: object = json.loads(done.stdout)
    return found


def _map(live: LiveMap, name: str, scans: int) -> int:
    with live.mapper(name, FILTER) as mapper:
        for points, pose in drive(scans):
            mapper.add(points, pose)
        mapper.wait_applied()
        return mapper.wait_durable() if scans else 0


def _read(live: LiveMap) -> list[int]:
    there = held(live, "memory")
    places = (np.array(list(there)).reshape(-1, 3) + 0.5) * RESOLUTION
    log_odds = live.log_odds(places)
    return [len(there), sum(there.values()), int(log_odds.sum())]


def main() -> None:
    """Become that account, and try."""
    uid, gid, groups, endpoint, action = sys.argv[1:6]
    with shmmap.connect(endpoint) as client:
        live = client.live("lidar")
        _map(live, "rehearsal", 0)
        _read(live)
        Marker(RESOLUTION, FILTER).mark(*drive(1)[0])
    os.setgroups([int(group) for group in groups.split(",")])
    os.setresgid(*[int(gid)] * 3)
    os.setresuid(*[int(uid)] * 3)
    os.umask(0o077)
    try:
        with shmmap.connect(endpoint) as client:
            live = client.live("lidar")
            print(json.dumps(_map(live, "front", SCANS) if action == "map" else _read(live)))
    except ShmmapError as error:
        print(json.dumps(error.code))


if __name__ == "__main__":
    main()
