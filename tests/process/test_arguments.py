# SPDX-License-Identifier: Apache-2.0
"""What a program gives that makes no sense: an error of ours, in words, and no other below it."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.errors import BadRequest, NoSocket, ShmmapError
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map

Factory = Callable[..., DaemonProcess]

NAN = float("nan")
ARGUMENTS: dict[str, Callable[[shmmap.Client], object]] = {
    "timeout nan": lambda c: shmmap.connect(c.endpoint, timeout=NAN),
    "timeout none": lambda c: shmmap.connect(c.endpoint, timeout=None),  # type: ignore[arg-type]
    "timeout text": lambda c: shmmap.connect(c.endpoint, timeout="5s"),  # type: ignore[arg-type]
    "timeout list": lambda c: shmmap.connect(c.endpoint, connect_timeout=[5]),  # type: ignore[arg-type]
    "timeout huge": lambda c: shmmap.connect(c.endpoint, timeout=10**400),
    "endpoint number": lambda _: shmmap.connect(5),  # type: ignore[arg-type]
    "endpoint zero byte": lambda _: shmmap.connect("/a\0b"),
    "instance number": lambda _: shmmap.connect(instance=5),  # type: ignore[arg-type]
    "instance slash": lambda _: shmmap.connect(instance="a/b"),
    "instance and endpoint": lambda c: shmmap.connect(c.endpoint, instance="a"),
    "instance and client": lambda c: shmmap.MapWindow(c, 5.0, instance="a"),
    "x none": lambda c: c.around(None, 0),  # type: ignore[arg-type]
    "x text": lambda c: c.around("a", 0),  # type: ignore[arg-type]
    "x list": lambda c: c.around([1.0], 0),  # type: ignore[arg-type]
    "x array": lambda c: c.around(np.zeros(1), 0),  # type: ignore[arg-type]
    "x nan": lambda c: c.around(NAN, 0),
    "x huge": lambda c: c.around(10**400, 0),
    "x complex": lambda c: c.around(1j, 0),  # type: ignore[arg-type]
    "radius list": lambda c: c.points_around(0, 0, [3]),  # type: ignore[arg-type]
    "z number": lambda c: c.around(0, 0, z=5),  # type: ignore[arg-type]
    "z texts": lambda c: c.around(0, 0, z=("a", "b")),  # type: ignore[arg-type]
    "z three": lambda c: c.points_around(0, 0, 5, z=(1, 2, 3)),  # type: ignore[arg-type]
    "wait nan": lambda c: c.around(0, 0, wait=NAN),
    "wait text": lambda c: c.around(0, 0, wait="1"[:0] or "long"),  # type: ignore[arg-type]
    "layers none": lambda c: c.around(0, 0, layers=None),  # type: ignore[arg-type]
    "layers numbers": lambda c: c.around(0, 0, layers=[1, 2]),  # type: ignore[list-item]
    "ids none": lambda c: c.selected(None),  # type: ignore[arg-type]
    "ids cells": lambda c: c.selected(c.metadata()),  # type: ignore[arg-type]
    "held numbers": lambda c: c.differential(shmmap.Circle(0, 0, 5), [1]),  # type: ignore[list-item]
    "held triples": lambda c: c.differential(shmmap.Circle(0, 0, 5), [("a", 1, 2)]),  # type: ignore[list-item]
    "held beyond": lambda c: c.differential(shmmap.Circle(0, 0, 5), [("a", 1 << 70)]),
    "pose number": lambda c: c.area(shmmap.Circle(0, 0, 5), pose=1.0),  # type: ignore[arg-type]
    "pose object": lambda c: c.area(shmmap.Circle(0, 0, 5), pose=(object(), 0)),  # type: ignore[arg-type]
    "route alone": lambda c: c.selected(["0_0.pcd"], route=[(0.0, 0.0), (5.0, 0.0)]),
    "box text": lambda c: c.area(shmmap.Box("a", 0, 1, 1)),  # type: ignore[arg-type]
    "window radius": lambda c: shmmap.MapWindow(c, None),  # type: ignore[arg-type]
    "window layers": lambda c: shmmap.MapWindow(c, 5.0, layers=5),  # type: ignore[arg-type]
    "window shape": lambda c: shmmap.MapWindow(c, 5.0, shape=["circle"]),  # type: ignore[arg-type]
    "window z": lambda c: shmmap.MapWindow(c, 5.0, z=3),  # type: ignore[arg-type]
    "window timeout": lambda c: shmmap.MapWindow(c, 5.0, timeout=[1]),  # type: ignore[arg-type]
    "window distance": lambda c: shmmap.MapWindow(c, 5.0, update_distance=None),  # type: ignore[arg-type]
    "window interval": lambda c: shmmap.MapWindow(c, 5.0, refresh_interval=NAN),
    "move x": lambda c: shmmap.MapWindow(c, 5.0, background=False).move_to(None, 0),  # type: ignore[arg-type]
    "move wait": lambda c: shmmap.MapWindow(c, 5.0, background=False).move_to(0, 0, wait=[1]),  # type: ignore[arg-type]
    "wait until": lambda c: shmmap.MapWindow(c, 5.0, background=False).wait_until_current(None),  # type: ignore[arg-type]
    "covers": lambda c: shmmap.MapWindow(c, 5.0, background=False).covers("a", 0),  # type: ignore[arg-type]
    "events since": lambda c: shmmap.events.EventStream(c.endpoint, since="x"),  # type: ignore[arg-type]
    "events timeout": lambda c: shmmap.events.EventStream(c.endpoint, timeout=None),  # type: ignore[arg-type]
}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[shmmap.Client]:
    from shmmap.testing.daemon_process import DaemonProcess as Plain

    made = make_map(tmp_path_factory.mktemp("arguments") / "map", columns=2, rows=2)
    with Plain(made.root) as one, shmmap.connect(one.endpoint) as made_client:
        yield made_client


@pytest.mark.parametrize("name", ARGUMENTS)
def test_an_argument_that_makes_no_sense(client: shmmap.Client, name: str) -> None:
    with pytest.raises(BadRequest) as caught:
        ARGUMENTS[name](client)
    assert len(str(caught.value)) > 10
    said = "".join(traceback.format_exception(caught.value))
    assert said.count("Traceback") == 1, "no other error below it"


def test_numbers_of_any_kind_are_numbers(client: shmmap.Client) -> None:
    whole = client.around(0.0, 0.0, 5.0)
    assert len(client.around(0, 0, 5, wait=math.inf)) == len(whole)
    kinds: tuple[Any, ...] = (int, np.float32, np.float64, np.int16, np.array)
    for kind in kinds:
        assert len(client.around(kind(0), kind(0), kind(5), wait=kind(5))) == len(whole)
    assert len(client.around(0, 0, 5, z=np.array([-50.0, 50.0]))) == len(whole)  # type: ignore[arg-type]
    assert len(client.around(0, 0, 5, layers=np.array(["points"]))) == len(whole)  # type: ignore[arg-type]


def test_nothing_is_covered_before_any_answer(client: shmmap.Client) -> None:
    """The daemon stands still: what it would say is not known."""
    with shmmap.MapWindow(client, 5.0) as window:
        assert not window.complete
        assert not window.covers(0, 0)
        assert not window._follower.state.covered
    closed = window._follower.state
    assert not closed.covered


# --- which daemon -------------------------------------------------------------------------------------


def test_an_instance_by_its_name(daemon: Factory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = daemon(make_map(tmp_path / "map", columns=2, rows=2).root)
    name = Path(one.endpoint).name.removesuffix(".sock")
    monkeypatch.delenv("SHMMAP_ENDPOINT", raising=False)
    monkeypatch.setenv("SHMMAP_RUNTIME_DIR", str(Path(one.endpoint).parent))
    for options in ({"endpoint": name}, {"instance": name}):
        with shmmap.connect(**options) as client:  # type: ignore[arg-type]
            assert client.endpoint == one.endpoint
    with shmmap.MapWindow(name, 5.0) as window, shmmap.MapWindow(radius=5.0, instance=name) as other:
        assert window.client.endpoint == other.client.endpoint == one.endpoint
    for stream in (shmmap.events.EventStream(name), shmmap.events.EventStream(instance=name)):
        assert stream.path == one.endpoint
        stream.close()
    monkeypatch.setenv("SHMMAP_ENDPOINT", "/no/such/directory/here.sock")
    with shmmap.connect(instance=name) as client:
        assert client.endpoint == one.endpoint, "what is said goes before what is set"
    monkeypatch.chdir(Path(one.endpoint).parent)
    for path in (Path(one.endpoint).name, Path(one.endpoint), f"./{Path(one.endpoint).name}"):
        with shmmap.connect(path) as client:
            assert client.endpoint == one.endpoint, "a path is a path"


def test_an_instance_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHMMAP_RUNTIME_DIR", str(tmp_path))
    for ask in (
        lambda: shmmap.connect("u1"),
        lambda: shmmap.MapWindow("u1"),
        lambda: shmmap.events.EventStream("u1"),
    ):
        with pytest.raises(NoSocket, match=r"/u1\.sock: there is no socket \(.*connect\(instance=") as caught:
            ask()
        assert "".join(traceback.format_exception(caught.value)).count("Traceback") == 1


@pytest.mark.parametrize("nbytes", [100, 101, 104, 107, 108])
def test_long_paths(tmp_path: Path, nbytes: int) -> None:
    """The daemon has a second socket whose name is seven bytes longer."""
    path = "/tmp/" + "x" * (nbytes - len("/tmp/.sock")) + ".sock"
    assert len(path) == nbytes
    made = make_map(tmp_path / "map", columns=1, rows=1)
    command = [sys.executable, "-m", "shmmap.cli", "serve", str(made.root), "--shm-dir", str(tmp_path)]
    command += ["--budget", "nonsense" if nbytes == 100 else "64M", "--endpoint", path]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)
    if nbytes > 100:
        assert done.returncode in (2, 78)
        assert (
            f"has {nbytes} bytes, and at most 100 may be used: a socket address holds 107, 7 more"
            in done.stderr
        )
        assert "hint: use a shorter directory or name" in done.stderr
    else:
        assert "socket path" not in done.stderr
    if nbytes <= 107:
        with pytest.raises(NoSocket):
            shmmap.connect(path)
    else:
        with pytest.raises(BadRequest, match="has 108 bytes, and at most 107 may be used"):
            shmmap.connect(path)


def test_a_long_runtime_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SHMMAP_ENDPOINT", raising=False)
    monkeypatch.setenv("SHMMAP_RUNTIME_DIR", "/tmp/" + "x" * 110)
    for ask in (shmmap.connect, lambda: shmmap.connect("u1"), lambda: shmmap.MapWindow(instance="u1")):
        with pytest.raises(BadRequest, match="at most 107 may be used"):
            ask()


@pytest.mark.parametrize("kind", ["nothing", "a file", "a directory", "no permission"])
def test_errors_have_no_others_below_them(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "s.sock"
    if kind == "a file":
        path.write_text("")
    elif kind == "a directory":
        path.mkdir()
    code = f"import shmmap; shmmap.connect({str(path)!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.stderr.count("Traceback") == 1
    assert "During handling" not in done.stderr
    assert "direct cause" not in done.stderr
    assert os.path.basename(path) in done.stderr.splitlines()[-1]
    assert issubclass(NoSocket, ShmmapError)
