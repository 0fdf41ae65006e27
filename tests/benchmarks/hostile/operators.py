# SPDX-License-Identifier: Apache-2.0
"""Defects that are survived, and names that must not speak to an operator's terminal."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path
from typing import Final

import numpy as np

from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.report import Report
from tests.benchmarks.hostile.stage import Stage, scene
from tests.support.command_line import Shmmap
from tests.support.divided_map import random_points
from tests.support.raw_client import RawClient, circle

DEFECTS: Final = 50
"""Fewer than those that end the daemon on purpose."""


@scene("A10", "An exception that nobody expected ends neither the daemon nor its cache")
def defects(told: Report, stage: Stage) -> None:
    """50 exceptions where memory is freed, outside of any request."""
    from_now_on = stage.scratch / "defects-from-now-on"
    from_now_on.unlink(missing_ok=True)
    environment = {"SHMMAP_TEST_DEFECT": f"daemon.unlink:{DEFECTS}:{from_now_on}"}
    made = stage.new_map()
    with (
        stage.served(made.root, environment=environment) as one,
        Beside(told, one),
        RawClient(one.endpoint) as client,
    ):
        cells = len(client.area(circle(0, 0, 500)).cells)
        client.release()
        from_now_on.touch()
        client.ask("evict", [made.id(f"{x}_40.pcd") for x in range(-60, 60, 20)])
        begin_s = time.monotonic()
        counters = client.ask("stats")[4]
        while counters["zombies"] and time.monotonic() - begin_s < 30.0:
            time.sleep(0.1)
            counters = client.ask("stats")[4]
        told.tell(f"{counters['defects']} exceptions; lines in the log: {one.log.count('defect place=')}")
        told.must("all of them were counted", counters["defects"] == DEFECTS)
        told.must("what was evicted is freed in the end", counters["zombies"] == 0)
        kept = counters["cells_resident"]
        told.must("the rest of the cache is kept", kept == cells - 6, f"{kept} of {cells - 6}")


ESCAPES: Final = "\x1b]0;owned\x07\x1b[31mred\x9b2J\r\u202etxt"


def is_called_badly(orders: Orders, endpoint: str) -> None:
    """A client whose name, and whose process's name, would change the terminal; it holds a cell."""
    ctypes.CDLL(None).prctl(15, b"\x1b[31mbad\x9b\n", 0, 0, 0)  # PR_SET_NAME
    with RawClient(endpoint, name=ESCAPES) as client:
        cells = client.area(circle(0, 0, 30)).cells
        held = [os.open(client.path(cell), os.O_RDONLY) for cell in cells]
        orders.say(len(held))
        while orders.go_on(60.0):
            pass


@scene("A15", "Names that others chose do not speak to an operator's terminal")
def escapes(told: Report, stage: Stage) -> None:
    """Control characters in a client's name, a process's name, a cell's name and a broken file's."""
    made = stage.new_map()
    odd = "\x1b[31mcell\x07.pcd"
    made.corners[odd] = (200, 200)
    (made.pcd_dir / odd).write_bytes(b"no PCD")
    made.write_cell("good\x1b[2J.pcd", (220, 200), random_points(np.random.default_rng(1), (220, 200), 10))
    lines = [f"{_quoted(name)}: [{x}, {y}]" for name, (x, y) in made.corners.items()]
    text = "\n".join(["x_resolution: 20.0", "y_resolution: 20.0", *lines])
    (made.root / "pointcloud_map_metadata.yaml").write_text(text + "\n")
    (made.pcd_dir / "stray\x1b[31m.pcd").write_bytes(b"")
    with stage.served(made.root) as one, Actor(is_called_badly, one.endpoint) as actor:
        actor.said()
        with RawClient(one.endpoint) as client:
            client.area(circle(210, 210, 30))
            client.ask("reload")
        shmmap = Shmmap(one, Path(one.scratch_dir))
        verbs = (
            ("clients",), ("status",), ("ls",), ("top", "--once"), ("health",), ("doctor",), ("metrics",),
            ("show", made.id("good\x1b[2J.pcd")), ("reload",), ("inspect", str(made.pcd_dir)),
            ("query", "--circle", "210,210,30"), ("evict",), ("tail", "--no-follow"),
        )  # fmt: skip
        for words in verbs:
            done = shmmap.run(*words)
            bad = not_for_a_terminal(done.stdout + done.stderr)
            told.must(f"shmmap {words[0]} prints no control character", not bad, bad)
        bad = not_for_a_terminal(one.log)
        told.must("nor does the log", not bad, bad)


def not_for_a_terminal(text: str) -> str:
    """Which characters of a text would do something to a terminal, as Python writes them."""
    return " ".join(sorted({repr(c) for c in text if not c.isprintable() and c != "\n"}))


def _quoted(name: str) -> str:
    return '"' + "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in name) + '"'
