# SPDX-License-Identifier: Apache-2.0
"""An upgrade by pip under four programs and a service, then a restart: no program ends, none is silent."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest

import shmmap
from shmmap.testing.daemon_process import wait_readable
from shmmap.version import build_version
from tests.support.booted_service import make_environment, make_wheel, pip_install
from tests.support.booted_systemd import BootedSystemd
from tests.support.daemon_process import ROOT
from tests.systemd.conftest import MAP

pytestmark = pytest.mark.root

PLACE = "/opt/shmmap-upgraded"
SILENT_S = 120.0  # the daemon compiles kernels
SETTINGS = "/etc/shmmap/shmmap.toml"
PROGRAM = """
import itertools, json, sys, time
import numpy as np
import shmmap

what = sys.argv[1]
client = shmmap.connect(timeout=20, connect_timeout=60, name=what)

def say(epoch):
    print(json.dumps([epoch, shmmap.__version__]), flush=True)

if what == "client":
    for n in itertools.count():
        client.around(0, 0, 25 if n % 2 else 5, wait=60)  # and what it has no cell for
        client.points_around(9000, 0, 5)
        say(client.epoch)
        time.sleep(0.1)
elif what == "window":
    with shmmap.MapWindow(client, 20) as window:
        for n in itertools.count():
            window.move_to(n % 20, 0, wait=1)
            client.stats()
            if window.error is None and window.complete:
                say(client.epoch)
            time.sleep(0.1)
elif what == "mapper":
    mapper = client.live("lidar").mapper("bonnet", timeout_s=20)
    for n in itertools.count():
        mapper.add(np.array([[2.0, 0.0, 0.5], [0.0, 3.0, 1.0]]), np.eye(4))
        mapper.wait_applied(60)
        client.stats()
        say(client.epoch)
        time.sleep(0.1)
else:
    from shmmap.events import EventStream
    with EventStream() as stream:
        for event in stream:
            say(stream.epoch)
"""


@pytest.fixture
def installed(fresh: BootedSystemd) -> Iterator[BootedSystemd]:
    """A service of an environment of its own."""
    wheels = [make_wheel(fresh.shared, version) for version in ("0.90.0", "0.91.0")]
    make_environment(fresh, PLACE)
    pip_install(fresh, wheels[0], PLACE)
    fresh.shell(f"""
        unset PYTHONPATH
        cp {SETTINGS} /root/settings
        {PLACE}/bin/shmmap unit install --map {MAP}
        sed -i '1i live_group = "shmmap"' {SETTINGS}
        printf '\n[live.lidar]\nresolution = 0.5\n' >>{SETTINGS}
        systemctl daemon-reload
    """)
    try:
        yield fresh
    finally:
        fresh.shell(f"systemctl stop shmmapd; cp /root/settings {SETTINGS}; rm -rf {PLACE}")
        fresh.run(sys.executable, "-m", "shmmap.cli", "unit", "install", "--map", MAP)
        for built in wheels:
            built.unlink()


def test_an_upgrade_under_running_programs(installed: BootedSystemd) -> None:
    machine = installed
    machine.run("systemctl", "start", "shmmapd")
    script = machine.shared / "program.py"
    script.write_text(PROGRAM)
    command = [
        "env",
        "-u",
        "PYTHONPATH",
        "NUMBA_DISABLE_JIT=1",
        f"{PLACE}/bin/python",
        "/exchange/program.py",
    ]
    programs = {
        what: machine.spawn(*command, what, user="alice") for what in ("client", "window", "mapper", "events")
    }

    def says(what: str) -> tuple[int, str]:
        stdout = programs[what].stdout
        assert stdout is not None
        assert wait_readable([stdout.fileno()], SILENT_S), f"{what} is silent:\n{machine.journal()}"
        line = stdout.readline()
        assert line, (what, programs[what].communicate()[1], machine.journal())
        epoch, version = json.loads(line)
        return epoch, version

    try:
        before = {says(what)[0] for what in programs}
        assert len(before) == 1
        pip_install(machine, machine.shared / "shmmap-0.91.0-py3-none-any.whl", PLACE)
        done = machine.shell(f"unset PYTHONPATH; {PLACE}/bin/shmmap unit install; {PLACE}/bin/shmmap version")
        assert "next: systemctl restart shmmapd\n" in done
        assert "0.91.0" in done
        for what in programs:
            assert says(what) == (*before, "0.90.0")
        machine.run("systemctl", "restart", "shmmapd")
        for what, program in programs.items():
            while (said := says(what))[0] in before:
                pass
            assert said[1] == "0.90.0", "of the new version nothing is loaded"
            assert program.poll() is None
        status = machine.shell(
            f"unset PYTHONPATH; {PLACE}/bin/shmmap status --json; {PLACE}/bin/shmmap metrics"
        )
        assert '"version":"0.91.0"' in status.replace(" ", "")
        assert 'version="0.91.0"' in status
        assert "starting version=0.91.0" in machine.run("journalctl", "--no-pager", "-u", "shmmapd").stdout
        assert machine.properties("shmmapd")["NRestarts"] == "0"
    finally:
        for program in programs.values():
            program.kill()
            for pipe in (program.stdin, program.stdout, program.stderr):
                assert pipe is not None
                pipe.close()  # what runs inside ends with the machine
            program.wait()
        script.unlink()


def test_the_version_has_its_commit_in_a_checkout() -> None:
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("this is no checkout")
    commit = subprocess.run(
        [git, "-C", str(ROOT), "rev-parse", "HEAD"], check=True, capture_output=True, text=True
    ).stdout
    assert build_version() == f"{shmmap.__version__}+{commit[:8]}"
