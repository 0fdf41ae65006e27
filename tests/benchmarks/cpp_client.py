# SPDX-License-Identifier: Apache-2.0
"""What the client in C++ costs, beside the one in Python: needs g++.

    python -m tests.benchmarks.cpp_client [--rounds 40]

Requests: the one of `warm_request`, a differential that lists 256 held cells and is answered with 40
handles.  Python sends bytes that are made already and decodes the answer, without making cells of it; C++
makes the message and cells.  Blocks of both alternate, to the same daemon.  "Own time" is what passes
outside of send, poll and recv.

Attaching: 256 unmapped cells, from the arrival of the answer on, a cell; Python as its client does
it, with a column of each.

Memory: eight processes that hold the same 100 MB.

Measured beside those of BENCHMARKS.md: of a request 7 to 15 us pass in the client itself; mapping a cell
takes 0.56 to 0.67 of the Python client's time; each of eight processes that hold 105 MB has 0.6 MiB of its
own.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

import shmmap
from tests.benchmarks.warm_request import BLOCK, NEW, Warm, time_block
from tests.support.cpp_client import INCLUDE
from tests.support.daemon_process import DaemonProcess, LineProcess
from tests.support.divided_map import make_map

PROCESSES = 8


class Program(LineProcess):
    """The client in C++ as a process."""

    def __init__(self, path: Path, endpoint: str) -> None:
        super().__init__(path)
        self.ask("connect", endpoint)

    def ask(self, *words: object) -> list[float]:
        """Say something; returns the numbers of the answer."""
        self.write(" ".join(map(str, words)))
        return [float(word) for word in self.read().split()]

    def private_kb(self) -> int:
        """Memory that the process has for itself, KiB."""
        lines = Path(f"/proc/{self.pid}/smaps_rollup").read_text().splitlines()
        return sum(
            int(line.split()[1]) for line in lines if line.startswith(("Private_Clean:", "Private_Dirty:"))
        )


def compiled(folder: Path) -> Path:
    """Compile the program as a user would."""
    program = folder / "cpp_client"
    source = Path(__file__).with_suffix(".cpp")
    subprocess.run(["g++", "-std=c++17", "-O2", f"-I{INCLUDE}", source, "-o", program], check=True)
    return program


def attach_in_python(client: shmmap.Client, area: shmmap.Box) -> float:
    """Microseconds a cell, from when the answer has come."""
    came = 0.0

    def note(_: str) -> None:
        nonlocal came
        came = time.perf_counter()

    with mock.patch("shmmap.client.session.step", note):
        cells = client.area(area, wait=120.0).raise_for_failures()
        for cell in cells:
            cell.xyz  # noqa: B018  made when it is first asked for
        took = (time.perf_counter() - came) * 1e6 / len(cells)
    del cell, cells
    client.release()
    return took


def requests_and_attaching(program: Path, root: Path, rounds: int) -> None:
    """Measure and print both."""
    one = DaemonProcess(root, "--budget", "2G").start()
    warm = Warm(one)
    cpp = Program(program, one.endpoint)
    client = shmmap.connect(one.endpoint, timeout=120.0)
    inside = shmmap.Box(-159.0, -159.0, 159.0, 159.0)
    python: list[float] = []
    ours: list[float] = []
    own: list[float] = []
    attached: dict[str, list[float]] = {"Python": [], "C++": []}
    try:
        cpp.ask("hold", -179.0, -179.0, 179.0, 179.0)  # as `Warm` has opened them
        cpp.ask("box", *inside.bounds)
        for _ in range(rounds):
            python += time_block(warm.client.socket, warm.requests["packed"], decode=True)
            found = np.reshape(cpp.ask("request", BLOCK, *warm.held), (-1, 3))
            assert set(found[:, 2]) == {NEW}
            ours += (found[:, 0] / 1e3).tolist()
            own += (found[:, 1] / 1e3).tolist()
        cpp.ask("attach")
        for _ in range(rounds):
            attached["Python"].append(attach_in_python(client, inside))
            attached["C++"].append(cpp.ask("attach")[0] / 1e3)
    finally:
        cpp.end()
        client.close()
        warm.close()
        one.stop()
        one.dispose()
    blocks = [np.median(np.reshape(some, (-1, BLOCK)), axis=1) for some in (ours, python)]
    print(
        f"request: C++ p50 {np.median(ours):.1f} us, Python p50 {np.median(python):.1f} us,"
        f" ratio {np.median(blocks[0] / blocks[1]):.2f} (median of paired blocks)"
    )
    print(f"own time of C++: p50 {np.median(own):.1f} us, p99 {np.percentile(own, 99):.1f} us")
    pairs = np.array(attached["C++"]) / np.array(attached["Python"])
    print(
        f"attach a cell: C++ p50 {np.median(attached['C++']):.1f} us,"
        f" Python p50 {np.median(attached['Python']):.1f} us, ratio {np.median(pairs):.2f}"
    )


def memory(program: Path, folder: Path) -> None:
    """Measure and print what eight processes take."""
    made = make_map(folder / "large", columns=10, rows=10, points=65_536)
    one = DaemonProcess(made.root, "--budget", "2G").start()
    programs = [Program(program, one.endpoint) for _ in range(PROCESSES)]
    try:
        counts = [some.ask("hold", -100.0, -100.0, 100.0, 100.0)[0] for some in programs]
        assert set(counts) == {100}
        private = [some.private_kb() for some in programs]
    finally:
        for some in programs:
            some.end()
        one.stop()
        one.dispose()
    held = len(made.corners) * 65_536 * 16 / 1e6
    print(f"memory: {PROCESSES} processes hold {held:.0f} MB, each has at most {max(private)} KiB for itself")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=40)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory)
        program = compiled(folder)
        made = make_map(folder / "map", columns=20, rows=20, points=30)
        requests_and_attaching(program, made.root, arguments.rounds)
        memory(program, folder)


if __name__ == "__main__":
    main()
