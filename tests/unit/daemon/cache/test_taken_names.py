# SPDX-License-Identifier: Apache-2.0
"""In /dev/shm any user may make and remove files, also under the names that the daemon needs.

A directory stands for a foreign file here: it cannot be replaced by renaming either, not even by root.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from shmmap.daemon.records import Resident
from shmmap.protocol.messages import Selected
from shmmap.segment.names import retired_name
from shmmap.statistics.reader import read_statistics
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import InnerDaemon

Inner = Callable[..., InnerDaemon]


def load(one: InnerDaemon, request: int) -> Resident:
    one.ask(one.session(), Selected(request, ("0_0.pcd",), wait=30.0))
    assert len(one.cells_of(request).cells) == 1
    return one.cache.warm.layers["points"][one.cache.index_of("0_0.pcd") or 0]


@contextmanager
def taken(one: InnerDaemon, name: str) -> Iterator[None]:
    os.mkdir(f"{one.shm_dir}{name}")
    yield
    os.rmdir(f"{one.shm_dir}{name}")


def shown(one: InnerDaemon) -> dict[str, str]:
    """Segments and their states in the statistics."""
    one.events.flush()
    one.statistics.beat()
    return {cell.segment: cell.state for cell in read_statistics("inner", one.shm_dir).cells}


def test_the_name_of_a_retired_segment(inner: Inner, small_map: DividedMap) -> None:
    """It retires under another one, is shown under that, comes back, and is freed in the end."""
    one = inner(small_map.root)
    first = load(one, 1)
    old = first.name
    with taken(one, retired_name(old)), open(f"{one.shm_dir}{old}", "rb"):
        one.reclaimer.retire(first, one.now_s())
        assert first.name != old
        assert Path(f"{one.shm_dir}{retired_name(first.name)}").exists()
        assert shown(one) == {first.name.rpartition(".")[2]: "zombie"}
        assert load(one, 2) is first
        assert shown(one) == {first.name.rpartition(".")[2]: "resident"}
        assert Path(f"{one.shm_dir}{first.name}").exists()
    one.reclaimer.retire(first, one.now_s())
    one.run_until(lambda: not one.ledger.retired)
    assert (one.ledger.retired_bytes, one.ledger.resident_bytes, shown(one)) == (0, 0, {})
    assert [name for name in os.listdir(one.shm_dir) if not name.endswith("statistics")] == []


def test_the_name_it_had_before(inner: Inner, small_map: DividedMap) -> None:
    """It cannot come back, so that the cell is loaded again; the retired one goes when its reader does."""
    one = inner(small_map.root)
    first = load(one, 1)
    with open(f"{one.shm_dir}{first.name}", "rb"):
        one.reclaimer.retire(first, one.now_s())
        with taken(one, first.name):
            assert load(one, 2) is not first
        assert one.ledger.retired
    one.run_until(lambda: not one.ledger.retired)


def test_what_others_cut_short_never_comes_back(inner: Inner, small_map: DividedMap) -> None:
    """Its cell is loaded again at once, although the damaged segment is still mapped by a reader."""
    one = inner(small_map.root)
    first = load(one, 1)
    path = f"{one.shm_dir}{first.name}"
    with open(path, "rb"):
        os.chmod(path, 0o600)  # an ordinary user may not write what it made read-only
        os.truncate(path, 0)
        assert one.cache.lost.retire_if_lost(first, one.now_s())
        assert load(one, 2) is not first
    one.run_until(lambda: not one.ledger.retired)


def test_names_that_vanish(inner: Inner, small_map: DividedMap) -> None:
    """The cell is loaded again; names of others do not matter, and retired ones are expected to go."""
    one = inner(small_map.root)
    first, lost = load(one, 1), one.cache.lost
    assert lost.vanished() == set()
    Path(one.shm_dir, "shmmap.other.1").write_bytes(b"")
    Path(one.shm_dir, "shmmap.other.1").unlink()
    Path(one.path_of(first.name.rpartition(".")[2])).unlink()
    one.run_until(lambda: not one.cache.is_in_service(first))
    assert load(one, 2) is not first
