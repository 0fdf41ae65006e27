# SPDX-License-Identifier: Apache-2.0
"""``shmmap top``: live view of memory, latency and clients."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import TYPE_CHECKING, Final

from shmmap.cli.daemon_address import lists, locate, snapshot
from shmmap.cli.options import Subparsers, add_statistics_options, add_verb, seconds
from shmmap.cli.program import check_terminal
from shmmap.cli.screens.output import Line, print_json, print_styled
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.doctor.daemon_lists import DaemonLists
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot, StatisticsReader

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
        "latencies, loads, evictions, refusals, live maps and clients.  Live on a terminal, as much as "
        "there is room for, what matters first; once and all of it in a pipe.  While the daemon is paused "
        "(SIGSTOP, a debugger) or hangs, clients and live maps are missing.\n"
        "Keys: j and k (or arrows) scroll the clients, s sorts them, q ends.  The lines of blocks are what "
        "was seen since the start: memory and hits from 0 to 100 %, waits up to the longest mean wait.\n"
        "Memory: in use (mapped by clients; not `shmmap pin`), idle (in memory, mapped by no client), "
        "retired (out of service, freed when no process maps it), loading (reserved for loads under way), "
        "statistics (what `shmmap health` reads), free.\n"
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
    found, identity = snapshot(args)
    with lists(args, "shmmap top") as asked:
        return _show(args, found, identity, asked)


def _show(args: argparse.Namespace, found: Snapshot, identity: DaemonIdentity, asked: DaemonLists) -> int:
    from shmmap.cli.screens.top_screen import screen
    from shmmap.statistics.reader import StatisticsReader

    asked.add_to(found, clients=True)
    if args.json:
        from shmmap.cli.verbs.look.outputs import Top

        print_json(Top.of(found))
    elif args.once or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        width = shutil.get_terminal_size((PIPE_WIDTH, 40)).columns
        for line in screen(found, identity, width=width):
            print_styled(line)
    else:
        with contextlib.closing(StatisticsReader(*locate(args))) as reader:
            return _live(reader, asked, max(args.interval, SHORTEST_S))
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


def _live(reader: StatisticsReader, asked: DaemonLists, interval_s: float) -> int:
    """Show the screen until `q` or a signal, then restore the terminal."""
    from shmmap.cli.screens.full_screen import FullScreen

    seen = _Seen()
    try:
        with _ended_by_signals(), FullScreen() as terminal:
            while True:
                check_terminal(was_there=True)
                seen.view.keys = terminal.has_keys
                asked.add_to(found := reader.snapshot(), clients=True)
                terminal.draw(seen.lines(found, *terminal.size))
                for key in terminal.keys(interval_s):
                    if key == "q":
                        return 0
                    seen.view.press(key)
    except KeyboardInterrupt:
        return 0
    except _Ended as ended:
        return 128 + ended.number


class _Seen:
    """The snapshots seen so far: all in short, those of the last seconds whole."""

    def __init__(self) -> None:
        from shmmap.cli.screens.history import History
        from shmmap.cli.screens.top_screen import View

        self.view = View(history=History())
        self._recent: deque[Snapshot] = deque()

    def lines(self, found: Snapshot, width: int, height: int) -> Sequence[Line]:
        """Return the screen for a new snapshot."""
        from shmmap.cli.screens.top_screen import screen

        recent = self._recent
        if found.identity is None:
            recent.clear()
            return [[("no daemon runs; waiting for one (Ctrl-C ends)"[:width], "bold yellow")]]
        if self.view.history is not None:
            self.view.history.add(found)
        while (
            len(recent) > 1 and found.beat_monotonic_ns - recent[1].beat_monotonic_ns > LATENCY_SPAN_S * 1e9
        ):
            recent.popleft()
        self.view.earlier = recent[0] if recent else None
        if not recent or found.beat_monotonic_ns - recent[-1].beat_monotonic_ns > 1e9:
            recent.append(found)
        return screen(found, found.identity, width=width, height=height, view=self.view)
