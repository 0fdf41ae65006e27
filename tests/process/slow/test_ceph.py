# SPDX-License-Identifier: Apache-2.0
"""A published map on a real Ceph whose daemons are killed; run with ``SHMMAP_TEST_CEPH=1`` as root.

With it tests of other files that use a bucket run on Ceph, too (Debian's ``ceph-mon ceph-osd ceph-mgr radosgw
ceph-common``)::

    SHMMAP_TEST_CEPH=1 pytest --all -n 0 tests/process/slow/test_ceph.py tests/process/slow/test_publish.py \
        tests/process/test_signed_map.py tests/process/slow/test_serving_published.py \
        tests/unit/origin/remote/test_store.py
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import publish
from tests.support.divided_map import DividedMap, make_map
from tests.support.map_stores import CEPH_PROGRAMS, BucketServer, CephServer
from tests.support.published_daemon import ALL, all_cells

if not os.environ.get("SHMMAP_TEST_CEPH"):
    pytest.skip("SHMMAP_TEST_CEPH is not set", allow_module_level=True)
if missing := [name for name in CEPH_PROGRAMS if shutil.which(name) is None]:
    pytest.skip(f"Ceph is not installed: {', '.join(missing)}", allow_module_level=True)

WARM = "0_0.pcd"


@pytest.fixture
def ceph(buckets: BucketServer) -> Iterator[CephServer]:
    """The cluster, whole again after the test."""
    assert isinstance(buckets, CephServer)
    yield buckets
    buckets.repair()


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    """Of thirty-six cells."""
    return make_map(tmp_path / "town", columns=6, rows=6, points=2000)


def columns_of(cells: shmmap.CellSet) -> dict[str, dict[str, bytes]]:
    found = {}
    for cell in cells:
        cell.verify()
        found[cell.id.rsplit("/", 1)[1]] = {name: cell[name].tobytes() for name in cell.columns}
    return found


def of_files(daemon: DaemonFactory, town: DividedMap) -> dict[str, dict[str, bytes]]:
    with shmmap.connect(daemon(town.root).endpoint) as client:
        return columns_of(client.area(ALL, wait=120.0))


@pytest.mark.parametrize("killed", [["osd.1"], ["osd.1", "osd.2"], ["client.rgw"]])
def test_daemons_of_the_store_are_killed_while_cells_are_fetched(
    ceph: CephServer, daemon: DaemonFactory, town: DividedMap, killed: list[str]
) -> None:
    """One disk of three is not missed; without two, or the gateway, only cells that are here are served."""
    url = ceph.url(f"killed-{'-'.join(killed)}/town")
    publish(town.root, url)
    right = of_files(daemon, town)
    one = daemon(url, environment=ceph.environment)
    with shmmap.connect(one.endpoint) as client:
        (warm,) = client.selected([WARM], wait=60.0)
        client.area(ALL, wait=None)
        for name in killed:
            ceph.kill(name)
        found = client.area(ALL, wait=30.0)
        assert {failure.code for failure in found.failed} <= {"offline"}
        assert columns_of(found).items() <= right.items()
        again = client.selected([WARM], wait=0.0)
        assert [cell.version for cell in again] == [warm.version]
        if len(killed) > 1 or killed == ["client.rgw"]:
            ceph.repair()
        assert columns_of(all_cells(client)) == right


def test_a_disk_is_killed_while_a_map_is_published(
    ceph: CephServer, daemon: DaemonFactory, town: DividedMap
) -> None:
    url = ceph.url("published-meanwhile/town")
    publish(town.root, url)
    for seed, name in enumerate(sorted(town.corners)[:12]):
        town.change(name, seed=seed)
    ceph.kill("osd.0")
    assert "\nversion  2\n" in publish(town.root, url)
    with shmmap.connect(daemon(url, environment=ceph.environment).endpoint) as client:
        found = client.area(ALL, wait=120.0)
    assert columns_of(found) == of_files(daemon, town)
