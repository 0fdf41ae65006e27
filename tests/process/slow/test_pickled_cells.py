# SPDX-License-Identifier: Apache-2.0
"""Cells that go to other processes: as handles, attached there; what is gone is an error, no wait."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import multiprocessing.forkserver
import multiprocessing.resource_tracker
import os
import pickle
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.client import handed_over
from shmmap.errors import BadRequest, StaleHandle
from tests.support.daemon_process import ROOT, DaemonProcess, until
from tests.support.pages import read_page
from tests.support.process_costs import mappings_under

METHODS = ("fork", "spawn", "forkserver")
EXAMPLES = {
    "pool": r"32 cells, the highest point at \d+\.\d+ m",
    "ask": r"\[\d+, \d+, \d+\]",
    "together": r"\{-40: \d+, 0: \d+, 40: \d+\}",
    "keep": r"500 points of -?\d+_-?\d+\.pcd",
}


@pytest.fixture(autouse=True)
def no_helpers_left(standing: DaemonProcess) -> Iterator[None]:
    """End the processes that `multiprocessing` keeps, before the daemon is judged."""
    del standing
    yield
    gc.collect()  # what a pool leaves to be collected begins the helpers again
    multiprocessing.forkserver._forkserver._stop()  # type: ignore[attr-defined]
    multiprocessing.resource_tracker._resource_tracker._stop()  # type: ignore[attr-defined]


@pytest.fixture
def client(standing: DaemonProcess) -> Iterator[shmmap.Client]:
    with shmmap.connect(standing.endpoint) as made:
        yield made


def described(cell: shmmap.Cell) -> tuple[Any, ...]:
    return (
        cell.id, cell.name, cell.layer, cell.version, cell.box, cell.points, cell.segment, cell.offset,
        {name: values.tobytes() for name, values in cell.columns.items()}, cell.origin, cell.z_bounds,
    )  # fmt: skip


def mapped_here(cell: shmmap.Cell) -> bool:
    """Whether the cell's columns are shared memory, and cannot be written."""
    maps = Path("/proc/self/maps").read_text()
    return cell.segment.lstrip("/") in maps and not cell.xyz.flags.writeable


def answer(cell: shmmap.Cell) -> tuple[bool, tuple[Any, ...]]:
    return mapped_here(cell), described(cell)


def test_a_cell_is_its_handle(standing: DaemonProcess, client: shmmap.Client) -> None:
    cells = client.around(0, 0, 15, layers=("points", "voxel(leaf=2.0)"), wait=60)
    assert cells.complete
    for cell in cells:
        data = pickle.dumps(cell)
        assert len(data) < 700
        again = pickle.loads(data)
        assert again is not cell
        assert described(again) == described(cell)
        assert mapped_here(again)
        again.verify()
        assert pickle.loads(data) is again, "mapped once"
    before = mappings_under(standing.shm_dir)
    del again
    assert mappings_under(standing.shm_dir) == before - 1


@pytest.mark.parametrize("method", METHODS)
def test_pools(client: shmmap.Client, method: str) -> None:
    cells = client.around(0, 0, 15)
    wanted = [(True, described(cell)) for cell in cells]
    context = multiprocessing.get_context(method)
    with context.Pool(1) as pool:
        assert pool.map(answer, cells) == wanted
    with ProcessPoolExecutor(1, mp_context=context) as executor:
        assert list(executor.map(answer, cells)) == wanted


def test_sets_of_cells(client: shmmap.Client) -> None:
    cells = client.selected(["0_0.pcd", "no_such.pcd", "0_20.pcd"], wait=60)
    again = pickle.loads(pickle.dumps(cells))
    assert [described(cell) for cell in again] == [described(cell) for cell in cells]
    assert [(str(one), one.cell_id, one.code) for one in again.failed] == [
        (str(one), one.cell_id, one.code) for one in cells.failed
    ]
    assert (again.epoch, again.map_version, again.complete) == (cells.epoch, cells.map_version, False)
    near = client.points_around(3.0, 4.0, 12.0)
    again_near = pickle.loads(pickle.dumps(near))
    assert np.array_equal(again_near.gather(), near.gather())
    assert repr(again_near) == repr(near)


def evicted(client: shmmap.Client) -> bytes:
    """Return a cell that was pickled, and dropped and evicted since."""
    data = pickle.dumps(client.selected("0_0.pcd", wait=60)[0])
    client.evict()
    until(lambda: not attaches(data))
    return data


def attaches(data: bytes) -> bool:
    try:
        pickle.loads(data)
    except StaleHandle:
        return False
    return True


def use(cell: shmmap.Cell) -> float:
    return float(cell.xyz.sum())


@pytest.mark.parametrize("method", METHODS[:2])
def test_what_is_gone_is_an_error_and_no_process_waits(client: shmmap.Client, method: str) -> None:
    data = evicted(client)
    gone: Any = [_Pickled(data)]
    with pytest.raises(StaleHandle, match=r"0_0\.pcd \(points\): the segment .* is gone .*cell\.copy\(\)"):
        pickle.loads(data)
    context = multiprocessing.get_context(method)
    with context.Pool(1) as pool:
        with pytest.raises(StaleHandle, match=r"cell\.copy\(\)"):
            pool.map(pickle.loads, [data])
        with pytest.raises(StaleHandle, match=r"cell\.copy\(\)"):
            pool.map(use, gone)
        assert pool.map(abs, [-1]) == [1], "the pool works"


class _Pickled:
    """Pickles as what it has."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def __reduce__(self) -> Any:
        function, arguments = _parts(self._data)
        return function, arguments


def _parts(data: bytes) -> tuple[Any, Any]:
    """Return what a pickled cell calls when it is unpickled, and with what."""
    found: list[Any] = []

    class Finder(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            real = super().find_class(module, name)
            if name != "_take":
                return real
            return lambda *arguments: found.append((real, arguments))

    import io

    Finder(io.BytesIO(data)).load()
    return found[0]  # type: ignore[no-any-return]


def test_retired_and_still_in_use_is_attached(client: shmmap.Client) -> None:
    cell = client.selected("0_0.pcd", wait=60)[0]
    data, wanted = pickle.dumps(cell), described(cell)
    client.evict()
    assert described(pickle.loads(data)) == wanted


def test_another_machine_and_another_run_of_this_one(
    client: shmmap.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = client.selected("0_0.pcd", wait=60)[0]
    data = pickle.dumps(cell)
    private = pickle.dumps(cell.copy())
    monkeypatch.setattr(handed_over, "_boot", lambda: "11111111-2222-3333-4444-555555555555")
    with pytest.raises(StaleHandle, match="another machine, or before this one was restarted"):
        pickle.loads(data)
    assert described(pickle.loads(private))[:6] == described(cell)[:6]


def test_another_run_of_the_daemon(served: DaemonProcess, tmp_path: Path) -> None:
    """From a file that was written when an earlier daemon ran."""
    with shmmap.connect(served.endpoint) as client:
        (tmp_path / "cell").write_bytes(pickle.dumps(client.selected("0_0.pcd", wait=60)[0]))
    served.stop()
    served.start()
    with shmmap.connect(served.endpoint) as client:
        assert client.around(0, 0, 50).complete
        with pytest.raises(StaleHandle, match=r"its daemon stopped \(keep the cell"):
            pickle.loads((tmp_path / "cell").read_bytes())


def test_a_name_that_another_segment_has_now(standing: DaemonProcess, client: shmmap.Client) -> None:
    first, second = client.selected(["0_0.pcd", "0_20.pcd"], wait=60)
    data = pickle.dumps(first)
    function, (boot, shm_dir, slot, epoch, cell_id, handle) = _parts(data)
    for other in ((epoch + 1, handle), (epoch, _renamed(handle, second.segment))):
        with pytest.raises(StaleHandle, match="is gone since it was pickled"):
            function(boot, shm_dir, slot, other[0], cell_id, other[1])


def _renamed(handle: Any, segment: str) -> Any:
    values = {name: getattr(handle, name) for name in handle.__struct_fields__}
    return type(handle)(**{**values, "segment": segment})


def test_the_directory_may_have_another_name_here(
    standing: DaemonProcess, client: shmmap.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = pickle.dumps(client.selected("0_0.pcd", wait=60)[0])
    (tmp_path / "elsewhere").symlink_to(standing.shm_dir)
    monkeypatch.setenv("SHMMAP_SHM_DIR", str(tmp_path / "elsewhere"))
    assert pickle.loads(data).points == 500
    monkeypatch.setenv("SHMMAP_SHM_DIR", str(tmp_path))
    handed_over._attacher.__init__()  # type: ignore[misc]
    with pytest.raises(StaleHandle, match=f"no daemon's segments are in {tmp_path}, as this process sees it"):
        pickle.loads(data)


def test_copies(client: shmmap.Client) -> None:
    cell = client.selected("0_0.pcd", wait=60)[0]
    assert copy.copy(cell) is cell
    assert copy.deepcopy([cell])[0] is cell
    private = cell.copy()
    assert described(private)[:6] == described(cell)[:6]
    assert private.segment == ""
    assert not np.shares_memory(private.xyz, cell.xyz)
    private.xyz[0] = 1e3
    assert cell.xyz[0, 0] != 1e3
    for again in (pickle.loads(pickle.dumps(private)), copy.deepcopy(private), private.copy()):
        assert again.xyz.tobytes() == private.xyz.tobytes()
        assert not np.shares_memory(again.xyz, private.xyz)
    buffers: list[pickle.PickleBuffer] = []
    small = pickle.dumps(private, protocol=5, buffer_callback=buffers.append)
    assert len(small) < 2000, "its points go beside the pickle"
    assert pickle.loads(small, buffers=buffers).xyz.tobytes() == private.xyz.tobytes()
    del cell
    client.evict()
    assert private.header.rows == 500


def test_threads_unpickle_at_once(client: shmmap.Client) -> None:
    cells = client.around(0, 0, 50)
    data = [pickle.dumps(cell) for cell in cells] * 4
    found: list[bool] = []
    threads = [
        threading.Thread(target=lambda: found.extend(pickle.loads(one).points == 500 for one in data))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [True] * len(data) * 4


@pytest.mark.parametrize("what", ["client", "window", "events", "session"])
def test_what_cannot_be_pickled_says_what_to_do(client: shmmap.Client, what: str) -> None:
    makers: dict[str, Callable[[], Any]] = {
        "client": lambda: client,
        "window": lambda: shmmap.MapWindow(client, 20.0),
        "events": lambda: shmmap.events.EventStream(client.endpoint),
        "session": lambda: client.session,
    }
    made = makers[what]()
    acts: tuple[Any, ...] = (pickle.dumps, copy.copy, copy.deepcopy)
    for act in acts:
        with pytest.raises(TypeError, match=r"cannot be pickled: .*in each process"):
            act(made)
    if what in ("window", "events"):
        made.close()


def test_a_client_for_a_spawned_process(client: shmmap.Client) -> None:
    with pytest.raises(TypeError, match="a Client cannot be pickled"):
        multiprocessing.get_context("spawn").Process(target=use, args=(client,)).start()


def test_after_a_fork_a_cell_that_was_handed_over_still_works(client: shmmap.Client) -> None:
    data = pickle.dumps(client.selected("0_0.pcd", wait=60)[0])
    again = pickle.loads(data)
    pid = os.fork()
    if pid == 0:
        same = pickle.loads(data)
        os._exit(0 if same.points == again.points == 500 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples(standing: DaemonProcess, tmp_path: Path, name: str) -> None:
    page = read_page("shmmap/client/MULTIPROCESSING.md")
    assert page.fences == len(EXAMPLES)
    (tmp_path / "example.py").write_text("\n".join(page.blocks[name]) + "\n")
    done = subprocess.run(
        [sys.executable, "example.py"],
        capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False,
        env={**os.environ, "SHMMAP_ENDPOINT": standing.endpoint, "PYTHONPATH": f"{ROOT}:{ROOT}/clients"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(EXAMPLES[name], done.stdout.strip()), done.stdout


def test_a_closed_client_is_a_clear_error_in_the_child_too(client: shmmap.Client) -> None:
    client.close()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            client.metadata()
        except BadRequest:
            code = 0
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
