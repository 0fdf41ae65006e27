# SPDX-License-Identifier: Apache-2.0
"""``shmmap top``: live view of memory, latency and clients, from the daemon's statistics alone."""

from __future__ import annotations

import argparse
import contextlib
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from shmmap.cli.daemon_address import locate, snapshot
from shmmap.cli.options import Subparsers, add_statistics_options, add_verb, seconds
from shmmap.cli.program import check_terminal
from shmmap.cli.screens.output import print_json, print_line, printable
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from rich.console import Console

    from shmmap.cli.screens.top_screen import Line
    from shmmap.statistics.reader import Snapshot, StatisticsReader

__all__ = ["add_parser", "run"]

_EXIT = """\
Exit code: 0, or 69 when the daemon is dead or was never started."""

DEFAULT_INTERVAL_S: Final = 1.0
LATENCY_SPAN_S: Final = 10.0
PIPE_WIDTH: Final = 100
SHORTEST_S: Final = 0.05


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``top``."""
    parser = add_verb(
        subparsers,
        "top",
        run,
        help="live view: memory, latency, clients",
        description="Show how the memory budget is used, how many of the cells asked for were in memory, "
        "latencies, loads, evictions, refusals, live maps and clients.  Live on a terminal, once in a pipe.\n"
        "Budget: in use (mapped by clients; not `shmmap pin`), idle (in memory, mapped by no client), "
        "retired (out of service, freed when no process maps it), loading (reserved for loads under way), "
        "statistics (what this view reads), free.\n"
        "Requests: the daemon's own time for one.  Load waits: how long clients waited for loads.  "
        "Load time: of one cell, from when a loader was given it; below it the loaders' own time for points "
        "out of the map's files, for layers computed, and for layers out of the disk cache.\n"
        "Prefetch: cells loaded before a client asked for them.  Prefetch misses: cells that a moving client "
        "had to wait for.\n"
        "GIVEN: memory of the cells a client was given and has not returned.",
        output="look.outputs.Top",
        epilog=_EXIT,
    )
    parser.add_argument(
        "--interval",
        metavar="SECONDS",
        type=seconds,
        default=DEFAULT_INTERVAL_S,
        help="time between updates (default: 1)",
    )
    parser.add_argument("--once", action="store_true", help="print once and end, also on a terminal")
    add_statistics_options(parser)


def run(args: argparse.Namespace) -> int:
    """Show one screen, or update it until interrupted."""
    from shmmap.cli.screens.top_screen import screen
    from shmmap.statistics.reader import StatisticsReader

    found, identity = snapshot(args)
    if args.json:
        from shmmap.cli.verbs.look.outputs import Top

        print_json(Top.of(found))
    elif args.once or not sys.stdout.isatty():
        width = shutil.get_terminal_size((PIPE_WIDTH, 40)).columns
        for line in screen(found, identity, width=width, max_clients=256):
            print_line("".join(text for text, _style in line).rstrip())
    else:
        with StatisticsReader(*locate(args)) as reader:
            return _live(reader, max(args.interval, SHORTEST_S))
    return DaemonUnreachable.exit_code if found.state == "dead" else 0


class _Ended(BaseException):
    """Raised by a signal handler, so that the terminal is restored before the program exits."""

    def __init__(self, number: int) -> None:
        self.number = number


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    def end(number: int, frame: FrameType | None) -> None:
        del frame
        raise _Ended(number)

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _live(reader: StatisticsReader, interval_s: float) -> int:
    """Show the screen until interrupted, then restore the terminal."""
    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False)
    earlier: deque[Snapshot] = deque()
    try:
        with (
            _ended_by_signals(),
            Live(console=console, screen=True, auto_refresh=False, transient=True) as live,
        ):
            while True:
                check_terminal(was_there=True)
                found = reader.snapshot(cells=False)
                live.update(_render(found, earlier, console), refresh=True)
                time.sleep(interval_s)
    except KeyboardInterrupt:
        return 0
    except _Ended as ended:
        return 128 + ended.number


def _render(found: Snapshot, earlier: deque[Snapshot], console: Console) -> Any:
    from rich.console import Group
    from rich.text import Text

    from shmmap.cli.screens.top_screen import screen

    if found.identity is None:
        earlier.clear()
        return Text("no daemon runs; waiting for one (Ctrl-C ends)", style="bold yellow")
    while len(earlier) > 1 and found.beat_monotonic_ns - earlier[1].beat_monotonic_ns > LATENCY_SPAN_S * 1e9:
        earlier.popleft()
    width, height = console.size
    lines = screen(
        found,
        found.identity,
        width=width,
        max_clients=max(height - 24 - 2 * len(found.live), 1),
        earlier=earlier[0] if earlier else None,
    )
    if not earlier or found.beat_monotonic_ns - earlier[-1].beat_monotonic_ns > 1e9:
        earlier.append(found)
    return Group(*(_styled(line) for line in lines[: height - 1]))


def _styled(line: Line) -> Any:
    from rich.text import Text

    pieces = [(printable(text), style) for text, style in line]
    return Text.assemble(*pieces, no_wrap=True, overflow="ellipsis")
