# SPDX-License-Identifier: Apache-2.0
"""A program whose package is replaced: it uses all that is public, and prints how each use ends.

``python upgraded_program.py ENDPOINT HAS GOOD_CELL BROKEN_CELL DIRECTORY MAPPER``, with HAS ``client`` (it is
connected, nothing else) or ``all`` (a window, a live map, its mapper and an event stream, too).  It prints a
line when it is ready.  For each line that it then reads it uses everything, and prints the outcomes as JSON.
Its last line names what was loaded since.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import json
import pickle
import sys
import types
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np

import shmmap

ENDPOINT, HAS, GOOD, BROKEN = sys.argv[1:5]
Calls = dict[str, list[Callable[[Any], Any]]]
WAIT_S = [5.0]
"""How long everything waits: shortly while there is no daemon."""
POINTS = np.array([[2.0, 0.0, 0.5], [0.0, 3.0, 1.0], [4.0, 4.0, 1.5]])


def circle(radius: float = 5.0, x: float = 0.0) -> shmmap.Circle:
    return shmmap.Circle(x, 0.0, radius)


@contextlib.contextmanager
def closing(made: Any) -> Iterator[Any]:
    try:
        yield made
    finally:
        made.close()


def closed(made: Any) -> Any:
    with closing(made):
        return made


CLIENT: Calls = {
    "around": [
        lambda c: c.around(0, 0, 5, wait=WAIT_S[0]),  # complete
        lambda c: c.around(45, 45, 80, wait=0),  # incomplete
        lambda c: c.around(45, 45, 80, wait=0, strict=True),
        lambda c: c.around(-50, -50, 5, wait=WAIT_S[0]),  # a cell that cannot be read
        lambda c: c.around(-50, -50, 5, strict=True, wait=WAIT_S[0]),
        lambda c: c.around(9000, 0, 5, wait=WAIT_S[0]),  # off the map
        lambda c: c.around(9000, 0, 5, strict=True, wait=WAIT_S[0]),
        lambda c: c.around(float("nan"), 0, 5, wait=WAIT_S[0]),
        lambda c: c.around(0, 0, 5, layers="voxel(leaf=0)", wait=WAIT_S[0]),
    ],
    "area": [
        lambda c: c.area(circle(), wait=WAIT_S[0]),
        lambda c: c.area(shmmap.Box(0, 0, 5, 5), wait=WAIT_S[0]),
        lambda c: c.area(None, wait=WAIT_S[0]),
    ],
    "differential": [
        lambda c: c.differential(circle(), (), wait=WAIT_S[0]),
        lambda c: c.differential(circle(x=9e3), (), wait=WAIT_S[0]),
    ],
    "selected": [
        lambda c: c.selected(GOOD, wait=WAIT_S[0]),
        lambda c: c.selected(BROKEN, wait=WAIT_S[0]),
        lambda c: c.selected("no such cell", wait=WAIT_S[0]),
        lambda c: c.selected(["no such cell"], strict=True, wait=WAIT_S[0]),
    ],
    "points_around": [
        lambda c: c.points_around(0, 0, 5, wait=WAIT_S[0]),
        lambda c: c.points_around(9000, 0, 5, wait=WAIT_S[0]),
        lambda c: c.points_around(-50, -50, 5, wait=WAIT_S[0]),
        lambda c: c.points_around(0, 0, 5, wait=WAIT_S[0]).gather(),
        lambda c: c.points_around(0, 0, 5, wait=WAIT_S[0]).views(),
        lambda c: c.points_around(0, 0, 5, wait=WAIT_S[0]).mask(0),
    ],
    "metadata": [
        lambda c: c.metadata(),
        lambda c: c.metadata(circle(x=9e3)),
        lambda c: next(iter(c.metadata())),
    ],
    "live": [lambda c: c.live("lidar"), lambda c: c.live("radar")],
    "show": [lambda c: c.show(GOOD), lambda c: c.show("no such cell")],
    "pin": [lambda c: c.pin(GOOD), lambda c: c.pin("no such cell")],
    "evict": [lambda c: c.evict(), lambda c: c.evict(GOOD)],
    "close": [lambda _: closed(shmmap.connect(ENDPOINT)), lambda _: shmmap.connect("/nowhere/at/all.sock")],
    "shutdown": [],  # the daemon is killed instead
}
CELL: Calls = {
    "unit": [lambda c: c.unit("x"), lambda c: c.unit("none")],
    "to_torch": [],  # of other packages
    "to_open3d": [lambda _: importlib.import_module("shmmap.open3d_loading")],  # not Open3D itself
}
CELLS: Calls = {"count": [lambda c: c.count(c[0])], "index": [lambda c: c.index(c[0])]}
WINDOW: Calls = {
    "move_to": [
        lambda w: w.move_to(0, 0, wait=WAIT_S[0]),
        lambda w: w.move_to(-50, -50, wait=WAIT_S[0]),
        lambda w: w.move_to(9000, 0, wait=WAIT_S[0]),
        lambda w: w.move_to(0, 0, route=[(0, 0), (30, 0)], wait=WAIT_S[0]),
    ],
    "covers": [lambda w: w.covers(0, 0)],
    "points_around": [lambda w: w.points_around(0, 0, 5), lambda w: w.points_around(9000, 0, 5)],
    "wait_until_current": [lambda w: w.wait_until_current(WAIT_S[0])],
    "close": [
        lambda _: closed(shmmap.MapWindow(ENDPOINT, 20, timeout=WAIT_S[0])),
        lambda w: closed(shmmap.MapWindow(w.client, 20)),
    ],
}
LIVE: Calls = {
    "mapper": [lambda m: closed(m.mapper("a", timeout_s=WAIT_S[0]))],
    "save": [lambda m: m.save(timeout_s=WAIT_S[0])],
    "first_hits": [lambda m: m.first_hits(np.zeros((1, 3)), POINTS[:1])],
    "log_odds": [lambda m: m.log_odds(POINTS)],
    "move_to": [lambda m: m.move_to(0, 0, 0)],
    "voxels": [lambda m: m.voxels(), lambda m: m.voxels(scope="all"), lambda m: m.voxels("none")],
    "chunks": [
        lambda m: m.chunks(),
        lambda m: m.chunks(saved=True),
        lambda m: m.chunks(shmmap.Box(0, 0, 1, 1)),
    ],
}
MAPPER: Calls = {
    "add": [lambda m: m.add(POINTS, np.eye(4)), lambda m: m.add(POINTS[:, :2], np.eye(4))],
    "wait_applied": [lambda m: m.wait_applied(WAIT_S[0])],
    "wait_durable": [lambda m: m.wait_durable(WAIT_S[0])],
    "close": [],
}
STREAM: Calls = {
    "next": [lambda s: s.next(0)],
    "close": [lambda _: closed(shmmap.events.EventStream(ENDPOINT))],
}
LAYERS: Calls = {
    "build_layer": [lambda m: m.build_layer("ground", POINTS.astype("f4"))],
    "ground_height": [lambda m: m.ground_height([], 0, 0)],
    "canonical_layer": [lambda m: m.canonical_layer("voxel(leaf=1)")],
    "voxel_covariances": [lambda m: m.voxel_covariances(np.ones(1), np.ones((1, 6)))],
}
TOP: Calls = {
    "connect": [lambda m: closed(m.connect(ENDPOINT))],
    "read_cloud": [lambda m: m.read_cloud("/nowhere.pcd")],
    "write_pcd": [lambda m: m.write_pcd(f"{sys.argv[5]}/made.pcd", POINTS)],
}


def outcome(use: Callable[[], Any]) -> str:
    """Return how a use ends: the result's type or the error's, and the warnings."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = use()
            ended = type(found).__name__
        except shmmap.ShmmapError as error:
            ended = f"{type(error).__module__}.{type(error).__name__}"
            if isinstance(error, shmmap.errors.Replaced):
                ended += f" {error}"
        except Exception as error:  # noqa: BLE001  that is what is looked for
            ended = f"raised {type(error).__name__}: {error}"
    return " ".join([ended, *sorted({f"+{one.category.__name__}" for one in said})])


def uses_of(label: str, thing: Any, calls: Calls) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield every use of an object: each public attribute, called where that is a method."""
    for name in dir(thing):
        if name.startswith("_"):
            continue
        static = getattr(type(thing), name, None)
        if isinstance(thing, types.ModuleType) or not callable(static):
            yield f"{label}.{name}", partial(getattr, thing, name)
            for number, call in enumerate(calls.get(name, ())):
                yield f"{label}.{name}#{number}", partial(call, thing)
            continue
        for number, call in enumerate(calls.get(name, [methodcaller(name)])):
            yield f"{label}.{name}#{number}", partial(call, thing)
    yield f"repr({label})", lambda: repr(thing)
    for name in ("__len__", "__iter__"):
        if hasattr(type(thing), name) and label != "stream":
            yield f"{label}.{name}", partial(methodcaller(name), thing)


def handed_over(cell: Any) -> Any:
    return pickle.loads(pickle.dumps(cell))


def uses_of_cells(cells: Iterable[Any]) -> Iterator[tuple[str, Callable[[], Any]]]:
    for cell in cells:
        yield "pickled", partial(handed_over, cell)
        yield "pickled copy", partial(handed_over, cell.copy())
        yield "copied", partial(copy.copy, cell)
        yield "stale pickle", lambda: pickle.loads(STALE)


def names_of(module: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the uses of a module of public names, and of a name that it does not have."""
    yield module, lambda: getattr(shmmap, module)
    found = sys.modules.get(f"shmmap.{module}")
    for name in found.__all__ if found is not None else ():
        yield f"{module}.{name}", partial(getattr, found, name)


def walk() -> dict[str, str]:
    uses = [*uses_of("client", client, CLIENT), *uses_of("cells", CELLS_HELD, CELLS)]
    uses += [*uses_of("cell", CELLS_HELD[0], CELL), *uses_of_cells(CELLS_HELD[:1])]
    if HAS == "all":
        uses += [*uses_of("window", window, WINDOW), *uses_of("live", live, LIVE)]
        uses += [*uses_of("mapper", mapper, MAPPER), *uses_of("stream", stream, STREAM)]
        uses += [*uses_of("update", UPDATE, {}), *uses_of("around", AROUND, {"mask": [lambda p: p.mask(0)]})]
    uses += [
        *uses_of("shmmap", shmmap, TOP),
        ("dir", lambda: dir(shmmap)),
        ("hasattr", lambda: hasattr(shmmap, "x")),
    ]
    uses += [("wrapped", lambda: hasattr(shmmap, "__wrapped__"))]
    for module in ("errors", "layers", "live", "events"):
        uses += names_of(module)
    if "shmmap.layers" in sys.modules:
        uses += [(f"layers.{name}()", partial(call, shmmap.layers)) for name, (call,) in LAYERS.items()]
    return {name: outcome(use) for name, use in uses}


def loaded() -> set[str]:
    return {name for name in sys.modules if name.partition(".")[0] in ("shmmap", "shmmap_clients")}


client = shmmap.connect(ENDPOINT, timeout=2, connect_timeout=10, name=HAS)
CELLS_HELD = client.around(0, 0, 5)
OTHER = client.selected(GOOD)[0]
STALE = pickle.dumps(OTHER).replace(
    OTHER.segment.encode(), b"shmmap.none.0123456789abcdef"[: len(OTHER.segment)]
)
if HAS == "all":
    window = shmmap.MapWindow(client, 20)
    UPDATE = window.move_to(0, 0, wait=5)
    AROUND = client.points_around(0, 0, 5)
    live = client.live("lidar")
    mapper = live.mapper(sys.argv[6], timeout_s=5)
    stream = shmmap.events.EventStream(ENDPOINT)
print("ready", flush=True)
before = loaded()
for line in sys.stdin:
    if line == "end\n":
        break
    if line == "dead\n":
        WAIT_S[0] = client.session.timeout_s = 0.02
        vars(sys.modules["shmmap.client.client"]).update(RELOAD_S=0, RELOAD_CELL_S=0)
        if HAS == "all":
            vars(sys.modules["shmmap.client.live.live_map"]).update(LIST_S=0)
    else:
        WAIT_S[0] = client.session.timeout_s = 10
    print(json.dumps(walk()), flush=True)
print(
    json.dumps([sorted(loaded() - before), shmmap.__version__, str(Path(shmmap.__file__).parent)]), flush=True
)
