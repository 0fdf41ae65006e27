# SPDX-License-Identifier: Apache-2.0
"""What a third process sees while something happens to the daemon, and what that costs the daemon."""

from __future__ import annotations

import bisect
import contextlib
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Final

import numpy as np

from shmmap.statistics.counters import Histogram, lower_bound_ns
from shmmap.statistics.reader import read_statistics
from tests.benchmarks.hostile.actors import Actor, asks_the_daemon, asks_the_echo, echoes, newcomers
from tests.benchmarks.hostile.stage import Report
from tests.support.daemon_process import DaemonProcess
from tests.support.raw_client import RawClient, circle

OVER_ECHO_MS: Final = 50.0
OVER_IDLE_MIB: Final = 100.0
PROBED_M: Final = 30.0
"""Around the map's origin; an operator pins what lies there, so that it is warm whatever happens."""
SAMPLE_S: Final = 0.02
LEAST_S: Final = 5.0


@dataclass(frozen=True)
class Look:
    """One look at the thread of the serving loop: seconds it has run so far, and waited for a processor."""

    now_s: float
    ran_s: float
    waited_s: float

    @staticmethod
    def at(pid: int) -> Look:
        """Look now."""
        ran, waited, _ = Path(f"/proc/{pid}/task/{pid}/schedstat").read_text().split()
        return Look(time.perf_counter(), int(ran) / 1e9, int(waited) / 1e9)


class Beside:
    """Watches from its beginning to the end of its ``with`` block; then judges what it saw.

    Parameters
    ----------
    newcomers_too
        Whether new clients come all the time, and must get in.
    over_idle_mib
        How much the daemon's memory may grow.

    Attributes
    ----------
    turns : Turns
        Those of the daemon's loop since the block began.
    """

    def __init__(
        self,
        report: Report,
        one: DaemonProcess,
        *,
        newcomers_too: bool = True,
        over_idle_mib: float = OVER_IDLE_MIB,
    ) -> None:
        self._report = report
        self._one = one
        self._newcomers_too = newcomers_too
        self._over_idle_mib = over_idle_mib
        self._stack = ExitStack()
        self._ended = threading.Event()
        self._peak = 0

    def __enter__(self) -> Beside:
        one = self._one
        warm_and_pinned(one)
        bystander = partial(Actor, is_bystander=True)
        with ExitStack() as stack:
            self._probe = stack.enter_context(
                bystander(asks_the_daemon, one.endpoint, circle(0, 0, PROBED_M))
            )
            sizes = self._probe.said()
            path = f"{one.runtime_dir}/echo.sock"
            stack.enter_context(server := bystander(echoes, path))
            server.said()
            self._echo = stack.enter_context(bystander(asks_the_echo, path, *sizes))
            self._echo.said()
            if self._newcomers_too:
                self._newcomers = stack.enter_context(bystander(newcomers, one.endpoint, PROBED_M))
                self._newcomers.said()
            self._idle = self._peak = private_bytes(one.pid)
            self.turns = Turns(one)
            self._looks = [Look.at(one.pid)]
            thread = threading.Thread(target=self._watch, daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._ended.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            if error is None or isinstance(error, RuntimeError):  # an attacker failed
                time.sleep(max(0.0, self._looks[0].now_s + LEAST_S - time.perf_counter()))
                self._judge()

    def _watch(self) -> None:
        while not self._ended.wait(SAMPLE_S):
            self._peak = max(self._peak, private_bytes(self._one.pid))
            with contextlib.suppress(OSError):  # it has ended
                self._looks.append(Look.at(self._one.pid))

    def _loop_in(self, begin_s: float, end_s: float) -> str:
        """Say what the loop did in some time, as far as the looks show."""
        times = [look.now_s for look in self._looks]
        first = self._looks[max(0, bisect.bisect_right(times, begin_s) - 1)]
        last = self._looks[min(len(times) - 1, bisect.bisect_left(times, end_s))]
        ran, waited = last.ran_s - first.ran_s, last.waited_s - first.waited_s
        return (
            f"{end_s - begin_s:.3f} s, in which the loop ran for {ran:.3f} s and waited for a processor for"
            f" {waited:.3f} s"
        )

    def _judge(self) -> None:
        report, one = self._report, self._one
        alive = one.process is not None and one.process.poll() is None
        report.must("the daemon runs", alive)
        if not alive:
            return
        probe, echo = self._probe.end(), self._echo.end()
        self._ended.set()
        report.note(f"all of it: {self._loop_in(self._looks[0].now_s, self._looks[-1].now_s)}")
        report.note(f"turns of the loop, processor time: {self.turns.said()}")
        report.note(f"probe {_figures(probe.times_ms)}")
        report.note(f"in its longest: {self._loop_in(*probe.longest_s)}")
        report.note(f"echo  {_figures(echo.times_ms)}")
        longest, longest_echo = max(probe.times_ms), max(echo.times_ms)
        report.limit("longest of the probe, over the echo's", longest - longest_echo, OVER_ECHO_MS, "ms")
        if probe.odd:
            report.must("every answer to the probe has its cells", False, f"{probe.odd} have not")
        mib = 1 << 20
        grown = (self._peak - self._idle) / mib
        report.note(f"daemon's private memory: idle {self._idle / mib:.1f} MiB, peak {self._peak / mib:.1f}")
        report.limit("over idle", grown, self._over_idle_mib, "MiB")
        report.figures.update(
            p99=f"{np.percentile(probe.times_ms, 99):.1f}",
            probe=f"{longest:.0f}",
            echo=f"{longest_echo:.0f}",
            memory=f"{grown:+.0f}",
        )
        if self._newcomers_too:
            times, failures = self._newcomers.end()
            count = len(times) + failures.total()
            report.must("newcomers get in", not failures, f"{len(times)} of {count}")
            if times:
                report.note(f"the slowest of them took {max(times) * 1e3:.0f} ms")
            for words, number in failures.most_common(3):
                report.note(f"{number} got: {words}")
            report.figures["newcomers"] = f"{len(times)}/{count}"


def warm_and_pinned(one: DaemonProcess) -> None:
    """Have what the probe asks for in memory, whatever happens."""
    with RawClient(one.endpoint, name="operator", timeout=120.0) as operator:
        cells = operator.area(circle(0, 0, PROBED_M)).cells
        assert cells
        operator.ask("pin", [cell.id for cell in cells], ["points"])


def private_bytes(pid: int) -> int:
    """Memory of a process that is no file's: what it allocated itself, not the map in shared memory."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:  # it has ended
        return 0
    found = dict(line.split(":", 1) for line in status.splitlines())
    return sum(int(found.get(name, "0 kB").split()[0]) for name in ("RssAnon", "VmSwap")) * 1024


def _figures(times: list[float]) -> str:
    p50, p99 = np.percentile(times, [50, 99])
    return f"p50 {p50:8.2f}  p99 {p99:8.2f}  longest {max(times):8.2f} ms  n={len(times)}"


class Turns:
    """Those since it was made; reading them sends no request."""

    def __init__(self, one: DaemonProcess) -> None:
        self._one = one
        self._before, self._longest_before = self._now()

    def _now(self) -> tuple[Histogram, dict[str, float]]:
        """All turns, and the longest of each kind (ms), of the daemon's life."""
        found = read_statistics(self._one.instance, self._one.shm_dir)
        return found.histograms["turn"], {
            name.removeprefix("longest_turn_").removesuffix("_ns"): value / 1e6
            for name, value in found.counters.items()
            if name.startswith("longest_turn_")
        }

    def quantile_and_longest_ms(self, share: float) -> tuple[float, float]:
        """What ``share`` of the turns do not exceed, and what none does, ms."""
        histogram, longest = self._now()
        found = histogram.since(self._before)
        last = max((bucket for bucket, count in enumerate(found.counts) if count), default=0)
        grown = max((ms for kind, ms in longest.items() if ms > self._longest_before[kind]), default=0.0)
        if grown * 1e6 < lower_bound_ns(last):  # a kind that once had a longer one: only the bucket shows it
            grown = lower_bound_ns(last + 1) / 1e6
        return (found.quantile_s(share) or 0.0) * 1e3, grown

    def said(self) -> str:
        """Median, 99.9th percentile and longest, and which kinds had the longest of the daemon's life."""
        p50, longest = self.quantile_and_longest_ms(0.5)
        p999, _ = self.quantile_and_longest_ms(0.999)
        shown = sorted(self._now()[1].items(), key=lambda one: -one[1])[:3]
        return (
            f"p50 {p50:.3f}  p99.9 {p999:.2f}  longest {longest:.1f} ms;"
            f" of the daemon's life: {', '.join(f'{kind} {ms:.1f}' for kind, ms in shown)}"
        )
