# SPDX-License-Identifier: Apache-2.0
"""Layers are computed before anyone asks for them: with real loaders, into a real disk cache."""

from __future__ import annotations

import os
import select
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from shmmap.daemon.loading.preparer import AGAIN_S, ENDING_S, MAX_TRIES, RETRY_S
from shmmap.errors import ConfigError
from shmmap.layers.spec import canonical_layer
from shmmap.protocol.messages import Area, CircleMessage, Intent, Selected
from tests.support.connections import says
from tests.support.daemon_process import stop
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon

LAYER = canonical_layer("crop(z_max=4.0)")
OTHER = canonical_layer("sample(every=2)")
CELLS = 16


def count(one: InnerDaemon, name: str) -> int:
    return int(one.statistics.values[name])


def progress(one: InnerDaemon) -> tuple[int, int, int]:
    """Layers that are in the cache, that cannot be made, and that this run computed."""
    return tuple(count(one, name) for name in ("prepare_done", "prepare_failed", "layers_prepared"))  # type: ignore[return-value]


def run_to_end(one: InnerDaemon) -> None:
    """Turn until every layer is made or left out."""
    one.run_until(
        lambda: count(one, "prepare_done") + count(one, "prepare_failed") == count(one, "prepare_cells")
    )
    one.turn()


def test_every_cell_gets_its_layers_and_no_memory_is_taken(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root, prepare=(LAYER, OTHER))
    assert count(one, "prepare_cells") == 2 * CELLS
    run_to_end(one)
    assert progress(one) == (2 * CELLS, 0, 2 * CELLS)
    assert (one.ledger.resident_count, one.ledger.reserved_bytes, count(one, "loads_started")) == (0, 0, 0)
    reply = one.cells_for(Area(1, EVERYWHERE, (LAYER, OTHER), wait=60.0))
    assert len(reply.cells) == 2 * CELLS
    assert (count(one, "layers_computed"), count(one, "loads_from_cache")) == (0, 2 * CELLS)


def test_a_restart_computes_nothing_again(inner: Inner, small_map: DividedMap) -> None:
    first = inner(small_map.root, prepare=(LAYER,))
    first.run_until(lambda: count(first, "prepare_done") == 5)
    assert first.memory.preparer is not None
    first.memory.preparer.close()
    second = inner(small_map.root, prepare=(LAYER,))
    run_to_end(second)
    done, failed, computed = progress(second)
    assert (done, failed) == (CELLS, 0)
    assert computed in (CELLS - 5, CELLS - 6), "one may have been under way"


def test_another_state_of_the_map_has_its_changed_cells_made(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root, prepare=(LAYER,))
    run_to_end(one)
    small_map.change("0_0.pcd", 3)
    small_map.remove_cell("-20_0.pcd")
    small_map.write_metadata()
    one.reload()
    one.run_until(lambda: count(one, "prepare_cells") == CELLS - 1)
    run_to_end(one)
    assert progress(one) == (CELLS - 1, 0, CELLS + 1)


def test_nothing_is_prepared_while_anything_loads(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root, prepare=(LAYER,))
    with one.loaders_standing_still():
        one.ask(one.session(), Selected(1, ("0_0.pcd",), wait=60.0))
        one.run_until(lambda: any(load.is_running for load in one.loads.by_key.values()))
        before = progress(one)
        for _ in range(20):  # at most what was under way is finished
            one.turn()
        assert progress(one)[0] <= before[0] + 1
        at_rest = progress(one)
        for _ in range(20):
            one.turn()
        assert progress(one) == at_rest != (CELLS, 0, CELLS)
    assert len(one.cells_of(1).cells) == 1
    run_to_end(one)
    assert progress(one)[:2] == (CELLS, 0)


def test_what_a_moving_client_will_need_comes_first(inner: Inner, tmp_path: Path) -> None:
    street = make_map(tmp_path / "street", columns=20, rows=1, points=60)
    one = inner(street.root, prefetch_share=0.5, prepare=(LAYER,))
    session = one.session()
    says(session, Intent(-190.0, -10.0, vx=10.0, route=((-190.0, -10.0), (200.0, -10.0))), one.now_s())
    preparer = one.memory.preparer
    assert preparer is not None
    given = 0

    def done() -> bool:
        nonlocal given
        if preparer._number > given:  # the last task of a turn
            given = preparer._number
            assert not one.loads.by_key
            assert (
                one.scheduler.prefetcher.next_s > one.now_s() or not one.scheduler.prefetcher.prefetch.paths
            )
        return count(one, "prepare_done") == 20

    one.ask(session, Area(1, CircleMessage(-190.0, -10.0, 30.0), wait=60.0))
    one.run_until(done)
    assert count(one, "prefetch_started") > 3
    assert progress(one) == (20, 0, 20)


@pytest.mark.parametrize("how", ["broken", "crash"])
def test_a_cell_that_cannot_be_made_is_named_once(
    inner: Inner,
    small_map: DividedMap,
    how: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if how == "broken":
        (small_map.pcd_dir / "0_0.pcd").write_bytes(b"VERSION 0.7\nnonsense\n")
    else:
        monkeypatch.setenv("SHMMAP_TEST_WORKER", "crash:0_0.pcd")
    one = inner(small_map.root, prepare=(LAYER,))
    run_to_end(one)
    assert progress(one)[:2] == (CELLS - 1, 1)
    small_map.change("-20_0.pcd", 3)
    one.reload()
    one.run_until(lambda: count(one, "layers_prepared") == CELLS)
    run_to_end(one)
    assert progress(one)[:2] == (CELLS - 1, 1)
    named = [line for line in caplog.messages if "layer not prepared" in line]
    assert len(named) == 1
    assert "0_0.pcd" in named[0]
    assert LAYER in named[0]


def test_a_cell_that_is_mended_is_made(inner: Inner, small_map: DividedMap) -> None:
    (small_map.pcd_dir / "0_0.pcd").write_bytes(b"VERSION 0.7\nnonsense\n")
    one = inner(small_map.root, prepare=(LAYER,))
    run_to_end(one)
    small_map.change("0_0.pcd", 3)
    one.reload()
    one.run_until(lambda: count(one, "prepare_failed") == 0)
    run_to_end(one)
    assert progress(one) == (CELLS, 0, CELLS)


def test_a_cache_that_is_too_small_ends_it(
    inner: Inner, small_map: DividedMap, caplog: pytest.LogCaptureFixture
) -> None:
    one = inner(small_map.root, prepare=(LAYER,), cache_bytes=40_000)
    one.run_until(lambda: count(one, "prepare_short") == 1)
    done = progress(one)[0]
    assert 0 < done < CELLS
    for _ in range(5):
        one.turn()
    assert progress(one)[0] == done
    assert "the disk cache is too small" in caplog.text


def test_a_directory_that_cannot_be_written_is_tried_again(
    inner: Inner, small_map: DividedMap, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = tmp_path / "cache"
    cache.mkdir()
    (cache / "layers").write_text("no directory")
    one = inner(small_map.root, prepare=(LAYER,))
    one.run_until(lambda: count(one, "prepare_short") == 2)
    one.offset_s += RETRY_S
    one.run_until(lambda: one.memory.preparer is not None and one.memory.preparer.next_s > one.now_s())
    os.unlink(cache / "layers")
    one.offset_s += RETRY_S
    run_to_end(one)
    assert (*progress(one), count(one, "prepare_short")) == (CELLS, 0, CELLS, 0)
    assert caplog.text.count("layers not prepared") == 1


def test_a_layer_that_looks_into_too_many_cells_is_refused(inner: Inner, tmp_path: Path) -> None:
    fine = make_map(tmp_path / "fine", columns=13, rows=13, points=2, size=10)
    with pytest.raises(ConfigError, match="would look into about") as failure:
        inner(fine.root, prepare=(canonical_layer("normals(radius=50.0)"),))
    assert failure.value.key == "prepare"


def test_a_loader_that_takes_too_long_holds_nothing_up(inner: Inner, small_map: DividedMap) -> None:
    """The others go on as soon as it has exited, not after the pause for what cannot be started."""
    one = inner(small_map.root, prepare=(LAYER,))
    preparer = one.memory.preparer
    assert preparer is not None
    one.run_until(lambda: any(worker.ready for worker in preparer._pool))
    (worker,) = preparer._pool
    stop(worker.pid)
    one.run_until(lambda: not select.select([worker.fd], [], [], 0)[0])
    one.stop_clock()
    one.offset_s += preparer._pool.deadline_s + 1.0
    for _ in range(2):  # it is killed, and the next layer is to be handed out at once
        preparer.run_step(one.now_s())
    assert count(one, "worker_crashes") == 1
    one.run_until(lambda: not preparer._pool.is_ending)
    one.offset_s += ENDING_S
    run_to_end(one)
    assert progress(one)[:2] == (CELLS - 1, 1)


def test_what_a_loader_was_killed_at_is_tried_again(inner: Inner, small_map: DividedMap) -> None:
    """After all others, and a while; then nothing is left to do."""
    one = inner(small_map.root, prepare=(LAYER,))
    preparer = one.memory.preparer
    assert preparer is not None
    one.run_until(lambda: any(worker.ready for worker in preparer._pool))
    (worker,) = preparer._pool
    stop(worker.pid)
    one.run_until(lambda: preparer._current is not None and not select.select([worker.fd], [], [], 0)[0])
    os.kill(worker.pid, signal.SIGKILL)
    one.run_until(lambda: count(one, "worker_crashes") == 1)
    run_to_end(one)
    assert (*progress(one)[:2], count(one, "prepare_retries")) == (CELLS - 1, 1, 1)
    assert len(preparer._pool) == 0
    one.offset_s += AGAIN_S
    one.run_until(lambda: count(one, "prepare_done") == CELLS)
    one.turn()
    assert (*progress(one), count(one, "prepare_retries")) == (CELLS, 0, CELLS, 0)
    assert preparer.next_s == float("inf")
    small_map.change("0_0.pcd", 3)
    one.reload()
    one.run_until(lambda: count(one, "layers_prepared") == CELLS + 1)


def test_what_kills_each_loader_is_left_out(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "crash:0_0.pcd")
    one = inner(small_map.root, prepare=(LAYER,))
    preparer = one.memory.preparer
    assert preparer is not None
    for crashes in range(1, MAX_TRIES + 1):
        one.run_until(lambda: count(one, "worker_crashes") == crashes)  # noqa: B023
        run_to_end(one)
        assert progress(one)[:2] == (CELLS - 1, 1)
        assert count(one, "prepare_retries") == (crashes < MAX_TRIES)
        one.offset_s += AGAIN_S
    one.run_until(lambda: preparer.next_s == float("inf"))
    assert caplog.text.count("layer not prepared") == 1


def test_its_loader_is_gone_when_all_is_done(
    inner: Callable[..., InnerDaemon], small_map: DividedMap
) -> None:
    one = inner(small_map.root, prepare=(LAYER,))
    run_to_end(one)
    assert one.memory.preparer is not None
    assert len(one.memory.preparer._pool) == 0
    assert one.memory.preparer.next_s == float("inf")
    shutil.rmtree(small_map.root)
