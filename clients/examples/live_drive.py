# SPDX-License-Identifier: Apache-2.0
"""Map a drive through a generated town with too little memory, and kill daemon and mapper on the way.

    python3 live_drive.py town_map         # a new directory; it starts daemons of its own

In the end each voxel is as in a map of the same scans that has memory enough, and whose programs live.
"""

from __future__ import annotations

import itertools
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.simulation.lidar import Lidar, LidarDrive
from shmmap.simulation.town import Town
from shmmap.testing.daemon_process import DaemonProcess

LIDAR = Lidar(rings=16, azimuth_deg=1.5, farthest=25.0)
DRIVE = LidarDrive(Town(seed=4, blocks=(3, 3)), length=300.0, step=7.0, lidar=LIDAR, density=4.0)


def add_scans(endpoint: str) -> None:
    """Add the scans that the map lacks: the daemon knows how many it has of this mapper."""
    rules = shmmap.live.ScanFilter(min_range=1.0, max_range=20.0)
    with shmmap.connect(endpoint) as client, client.live("town").mapper("roof", rules) as mapper:
        for scan in itertools.islice(DRIVE.scans(), mapper.applied, None):
            mapper.add(scan.xyz, scan.T_map_sensor)
        mapper.wait_applied()


def drive(folder: Path, budget: str, *deaths: str) -> NDArray[np.int64]:
    """Map the drive, with deaths on the way; return index and log-odds of each voxel in the files, (N, 4)."""
    settings = folder.with_suffix(".toml")
    settings.write_text(f'[live.town]\npath = "{folder}"\nresolution = 0.2\n', encoding="utf-8")
    options = ("--config", str(settings), "--live-budget", budget)
    with DaemonProcess("", *options) as daemon, shmmap.connect(daemon.endpoint) as client:
        live, starts = client.live("town"), deaths.count("mapper") + 1
        runs = [multiprocessing.Process(target=add_scans, args=(daemon.endpoint,)) for _ in range(starts)]
        runs[0].start()
        for scan, dies in zip(itertools.count(12, 12), deaths):
            while live.status().scans < scan:
                time.sleep(0.01)
            print(f"after {scan} scans the {dies} is killed")
            if dies == "mapper":
                runs[0].kill()
                runs.pop(0).join()
                runs[0].start()
            else:
                daemon.kill()
                daemon.start()
        runs[0].join()
        if runs[0].exitcode:
            sys.exit("the mapper failed")
        files, state = live.save(), live.status()
        print(f"{files} chunks, {state.chunks} of them in memory, {state.bytes / 2**20:.1f} MiB")
    with DaemonProcess("", *options[:2]) as daemon, shmmap.connect(daemon.endpoint) as client:
        lists = [client.live("town").voxels(kind, scope="all") for kind in ("occupied", "free")]
    rows = np.concatenate([np.column_stack([one.indices, one.log_odds]) for one in lists])
    return rows[np.lexsort(rows.T)].astype(np.int64)


if __name__ == "__main__":
    found = drive(path := Path(sys.argv[1]).absolute(), "4M", "mapper", "daemon")
    same = np.array_equal(found, drive(path.with_name(f"{path.name}-whole"), "256M"))
    print(f"{len(found)} voxels, {'each' if same else 'NOT each'} as without a death, and with memory enough")
    print(f"see them: shmmap view {path} --image {path}.png")
    sys.exit(not same)
