# SPDX-License-Identifier: Apache-2.0
"""The README is true: its commands and programs run as they stand, its links lead somewhere.

The lines that make a virtual environment are run by ``.ci/run``, exactly as they stand, too.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT, processes_marked, wait_ended, wait_readable

README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(name: str) -> list[str]:
    """Lines of the fenced block that follows the comment ``<!-- name -->``."""
    (found,) = re.findall(rf"^<!-- {name} -->\n```\w+\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    return str(found).splitlines()


def test_two_lines_do_everything() -> None:
    lines = [line for line in README.splitlines() if line.startswith("python3 -m venv ")]
    demo, tests, client_only = lines
    assert demo.endswith(" .venv/bin/shmmap demo")
    assert tests.endswith(" .venv/bin/pytest -q")
    assert block("client-only") == [client_only]
    assert "--no-deps" in client_only


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)", README)
    assert links
    for link in links:
        assert "://" in link or (ROOT / link).is_file(), link


def test_every_block_is_tested() -> None:
    assert set(re.findall(r"^<!-- (.+) -->$", README, re.MULTILINE)) == {
        "server", "user", "points", "window", "layers", "client-only", "benchmarks",
    }  # fmt: skip
    # the two lines have no name
    assert README.count("\n```sh\n") + README.count("\n```python\n") == 7 + 2


def test_benchmarks_start() -> None:
    install, *runs = block("benchmarks")
    assert install.endswith("'.[test]'")
    assert {f"`{line.rsplit('.', 1)[1]}`" for line in runs} == set(
        re.findall(r"\| (`\w+`) \|$", README, re.M)
    )
    for line in runs:
        words = line.removeprefix(".venv/bin/python ").split()
        subprocess.run([sys.executable, *words, "--help"], cwd=ROOT, check=True, capture_output=True)


class Reader:
    """Somebody who follows the README: ``shmmap`` and ``python`` are on the path, nothing is configured."""

    def __init__(self, cwd: Path) -> None:
        self.cwd = cwd
        self.mark = cwd.name + str(os.getpid())
        (cwd / "bin").mkdir()
        for name, words in (("shmmap", "-m shmmap.cli"), ("python", "")):
            script = cwd / "bin" / name
            script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
            script.chmod(0o755)
        (cwd / "run").mkdir()
        self.shm_dir = Path(tempfile.mkdtemp(prefix="shmmap-readme-", dir="/dev/shm"))
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")} | {
            "PATH": f"{cwd / 'bin'}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "XDG_RUNTIME_DIR": str(cwd / "run"),
            "XDG_CACHE_HOME": str(cwd / "cache"),
            "SHMMAP_SHM_DIR": str(self.shm_dir),
            "SHMMAP_TEST_RUN": self.mark,
        }

    def run(self, command: str) -> str:
        done = subprocess.run(
            ["bash", "-euc", command],
            cwd=self.cwd,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    def python(self, program: list[str]) -> str:
        (self.cwd / "program.py").write_text("\n".join(program))
        return self.run("python program.py")


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    """Follow the server's part of the README; at the end the daemon stops and leaves nothing."""
    reader = Reader(tmp_path_factory.mktemp("readme"))
    demo, serve = block("server")
    assert demo.startswith("shmmap demo ")
    try:
        told = reader.run(demo)
        assert "ONE SHARED COPY" in told
        assert (reader.cwd / "shmmap-demo.svg").is_file()
        yield from _served(reader, serve)
        assert processes_marked(reader.mark) == []
        assert [path.name for path in reader.shm_dir.iterdir() if path.suffix != ".lock"] == []
    finally:
        shutil.rmtree(reader.shm_dir)


def _served(reader: Reader, serve: str) -> Iterator[Reader]:
    notify = str(reader.cwd / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind(notify)
        daemon = subprocess.Popen(
            serve.split(),
            cwd=reader.cwd,
            executable=str(reader.cwd / "bin" / "shmmap"),
            env=reader.environment | {"NOTIFY_SOCKET": notify},
            stderr=subprocess.DEVNULL,
        )
        try:
            assert wait_readable([ready.fileno()], 60.0), "the daemon did not get ready"
            yield reader
        finally:
            daemon.send_signal(signal.SIGTERM)
            assert wait_ended(daemon.pid)
        assert daemon.wait() == 0


def test_commands_of_a_user(reader: Reader) -> None:
    told = [reader.run(command) for command in block("user")]
    status, query, ls, show, clients, top, tail, picture, export, inspect, divide, merge = told
    assert "healthy" in status
    assert "town_160_160.pcd" in query
    assert "resident" in ls
    assert "town_160_160.pcd" in show
    assert "CLIENT" in clients
    assert "cache" in top
    assert "town_160_160.pcd" in tail
    assert "town.html" in picture
    assert "around.pcd" in export
    exported = re.search(r"([\d,]+) points of", export)
    assert exported is not None
    assert f"points  {exported[1]}" in inspect
    assert f"{exported[1]} of {exported[1]}" in divide
    assert f"{exported[1]} of" in merge


def test_three_lines_of_python(reader: Reader) -> None:
    program = block("points")
    assert len([line for line in program if line]) == 3
    number = re.fullmatch(r"(\d+) points\n", reader.python(program))
    assert number is not None
    assert int(number[1]) > 10_000


def test_following_a_vehicle(reader: Reader) -> None:
    numbers = re.fullmatch(r"(\d+) cells, (\d+) points near\n", reader.python(block("window")))
    assert numbers is not None
    assert int(numbers[1]) > 50
    assert int(numbers[2]) > 10_000


def test_layers(reader: Reader) -> None:
    told = reader.python(block("layers")).splitlines()
    assert len(told) >= 4
    for line in told:
        found = re.fullmatch(r"\((\d+), 3\) \((\d+), 6\) Lattice\(leaf=\(2.0, 2.0, 2.0\), .*\)", line)
        assert found is not None, line
        assert found[1] == found[2]
