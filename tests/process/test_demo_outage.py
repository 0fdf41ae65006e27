# SPDX-License-Identifier: Apache-2.0
"""While the daemon is dead the demonstration's consumers go on, and its next life has all they hold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

from shmmap.cli.screens.demo_progress import QuietProgress
from shmmap.demo.consumer import Pose
from shmmap.demo.fleet import Fleet, StepReport
from shmmap.demo.outage import drive_through_outage
from shmmap.simulation.town import Town
from tests.support.daemon_process import DaemonProcess, processes_marked


class Witness(QuietProgress):
    """Looks at every pose whether there is a daemon, and what the consumers have counted."""

    def __init__(self, daemon: DaemonProcess) -> None:
        self._daemon = daemon
        self.events: list[str] = []
        self.alone: list[list[int]] = []
        self.reports: Sequence[StepReport] = ()

    def step(
        self, reports: Sequence[StepReport] = (), counters: dict[str, int] | None = None, note: str = ""
    ) -> None:
        del counters, note
        self.reports = reports
        # by the kernel's word: neither the daemon nor one of its loaders is alive
        if not processes_marked(self._daemon.instance, "SHMMAP_TEST_DAEMON"):
            self.alone.append([report.counted for report in reports])

    def event(self, text: str) -> None:
        self.events.append(text)


def test_consumers_go_on_without_the_daemon(daemon: Callable[..., DaemonProcess], tmp_path: Path) -> None:
    town = Town(seed=4, blocks=(3, 2), density=6.0)
    town.write(tmp_path / "map")
    one = daemon(tmp_path / "map")
    first_life = one.pid
    route = [Pose(*pose) for pose in town.route(length=40.0, step=1.0).tolist()]
    witness = Witness(one)
    with Fleet("shared", one.endpoint, 60.0, 3) as fleet:
        fleet.move_to(route[0])
        held = one.segments()
        result = drive_through_outage(fleet, one, route, witness, pace_s=0.02)
    assert one.pid != first_life
    # every control loop read more points with every pose of the outage
    assert len(witness.alone) >= 10
    for before, after in pairwise(witness.alone):
        assert all(a < b for a, b in zip(before, after, strict=True))
    assert result.consumers == len(result.counted) == 3
    assert result.poses >= len(witness.alone)
    assert min(result.counted) > 0
    # the next life has what the first one had, and everybody is as before
    assert result.adopted == result.segments >= len(held) > 0
    assert all(report.current for report in witness.reports)
    assert "killed" in witness.events[0]
    assert "starts again" in witness.events[1]
    assert str(result.adopted) in witness.events[2]
