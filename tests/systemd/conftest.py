# SPDX-License-Identifier: Apache-2.0
"""A booted systemd with the service installed, as an operator installs it."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from tests.support.booted_systemd import BootedSystemd
from tests.support.divided_map import DividedMap, make_map

MAP = "/home/alice/autoware_map"
RUN = "/run/user/61003"


@pytest.fixture(scope="module")
def machine() -> Iterator[BootedSystemd]:
    """Return a machine with users `alice` (of the group) and `mallory` (not), and a map in alice's home."""
    one = BootedSystemd()
    try:
        make_map(one.shared / "map")
        one.shell(f"""
            mkdir -p /etc/sysusers.d
            printf 'u alice 61003 "" /home/alice\nu mallory 61004 "" /\n' >/etc/sysusers.d/people.conf
            systemd-sysusers /etc/sysusers.d/people.conf
            mkdir -p {MAP} {RUN}; chmod 700 /home/alice {RUN}; chown alice:alice /home/alice {RUN}
            mount --bind /exchange/map {MAP}
            # a user's service manager without the session manager, which needs a real login
            cd /run/systemd/system; mkdir user@.service.d user-runtime-dir@.service.d
            printf '[Service]\nEnvironment=XDG_RUNTIME_DIR={RUN}\nPAMName=\n' >user@.service.d/test.conf
            printf '[Service]\nExecStart=\nExecStart=/bin/true\nExecStop=\n' \
                >user-runtime-dir@.service.d/test.conf
        """)
        done = one.run(sys.executable, "-m", "shmmap.cli", "unit", "install", "--map", MAP)
        assert "next: systemctl enable --now shmmapd" in done.stdout
        one.shell("usermod -aG shmmap alice")
        yield one
    finally:
        one.close()


@pytest.fixture
def fresh(machine: BootedSystemd) -> Iterator[BootedSystemd]:
    """Return the machine with every unit of the service stopped, and nothing left of it."""
    stop = """
        systemctl stop 'shmmapd*.socket' 'shmmapd*.service' user@61003.service
        systemctl reset-failed
        rm -rf /run/systemd/system/shmmapd*.d
        systemctl daemon-reload
    """
    machine.shell(stop)
    yield machine
    machine.shell(stop)
    assert machine.shell("ls /dev/shm") == ""
    assert machine.shell("grep -lsa 'shmmap[.]daemon\\|bin/shmmap[d]' /proc/[0-9]*/cmdline || true") == ""


@pytest.fixture
def the_map(machine: BootedSystemd) -> DividedMap:
    """Return the map, as the machine outside sees it."""
    return DividedMap(machine.shared / "map")
