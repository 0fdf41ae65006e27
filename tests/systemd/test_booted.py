# SPDX-License-Identifier: Apache-2.0
"""The service under a real systemd: start, reload, watchdog, restart, activation, stop, users."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from types import TracebackType

import pytest

from tests.support.booted_systemd import BootedSystemd
from tests.support.daemon_process import Deadline, first_answer, until
from tests.support.divided_map import DividedMap
from tests.systemd.conftest import MAP, RUN

pytestmark = pytest.mark.root

CLIENT = """
import hashlib, json, os, sys
import shmmap

def digest(cells):
    return {os.path.basename(c.id): hashlib.sha256(c.xyz.tobytes()).hexdigest() for c in cells}

client = shmmap.connect(sys.argv[1] or None, timeout=120, connect_timeout=120)
cells = []
for line in sys.stdin:
    if line == "ask\\n":
        cells = client.around(0, 0, radius=25)
    print(json.dumps(digest(cells)), flush=True)
"""


class Client:
    """A program of some user's inside the machine: asks for cells and holds what it got."""

    def __init__(self, machine: BootedSystemd, user: str, endpoint: str = "") -> None:
        self._process = machine.spawn(sys.executable, "-c", CLIENT, endpoint, user=user)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def _say(self, word: str) -> dict[str, str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(word + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, self._process.communicate()[1]
        answer: dict[str, str] = json.loads(line)
        return answer

    def ask(self) -> dict[str, str]:
        """Digests of the points around the origin, as the daemon hands them out now."""
        return self._say("ask")

    def held(self) -> dict[str, str]:
        """Digests of what this client holds, read again."""
        return self._say("held")


def shmmap(machine: BootedSystemd, *words: str, user: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command line inside."""
    return machine.run(sys.executable, "-m", "shmmap.cli", *words, user=user, check=False)


def until_state(machine: BootedSystemd, unit: str, *states: str) -> dict[str, str]:
    """Wait until a unit is in one of these states; returns its properties."""
    return first_answer(lambda: machine.properties(unit), lambda found: found["ActiveState"] in states)


def segments(machine: BootedSystemd, instance: str = "default", *, at: str = "/dev/shm") -> dict[str, str]:
    """Published segments by name, with their inodes."""
    published = re.compile(rf"shmmap\.{instance}\.[0-9a-f]{{16}}")
    lines = [line.split() for line in machine.shell(f"ls -i {at}").splitlines()]
    return {name: inode for inode, name in lines if published.fullmatch(name)}


def test_it_serves_the_members_of_the_group_and_no_other_user(fresh: BootedSystemd) -> None:
    said = fresh.run("systemd-analyze", "verify", "--man=no", "shmmapd.service", "shmmapd.socket")
    assert (said.stdout, said.stderr) == ("", "")  # as installed, drop-ins included
    fresh.run("systemctl", "start", "shmmapd")
    unit = fresh.properties("shmmapd")
    assert (unit["ActiveState"], unit["SubState"], unit["NRestarts"]) == ("active", "running", "0")
    assert " cells" in unit["StatusText"]
    with Client(fresh, "alice") as alice:
        assert len(alice.ask()) == 12
        refused = shmmap(fresh, "query", "--circle", "0,0,25", user="mallory")
        assert refused.returncode == 69
        assert "may not connect" in refused.stderr
        assert "group" in refused.stderr
        modes = fresh.shell(
            "stat -c '%n %a %U:%G' /run/shmmap /run/shmmap/default.sock /dev/shm/*"
        ).splitlines()
        found = {line.split()[0]: line.split(maxsplit=1)[1] for line in modes}
        assert found.pop("/run/shmmap") == "750 shmmap:shmmap"
        sockets = [name for name in found if name.endswith(".sock")]
        assert "/run/shmmap/default.sock" in sockets
        assert {found.pop(name) for name in sockets} == {"660 shmmap:shmmap"}
        assert len(found) >= 12
        names = segments(fresh)
        assert {found[f"/dev/shm/{name}"] for name in names} == {"440 shmmap:shmmap"}
        for name in names:
            assert fresh.run("cat", f"/dev/shm/{name}", user="mallory", check=False).returncode != 0
        assert shmmap(fresh, "evict", "--all", user="alice").returncode != 0
    fresh.run("systemctl", "stop", "shmmapd")
    unit = fresh.properties("shmmapd")
    assert (unit["ActiveState"], unit["Result"], unit["ExecMainStatus"]) == ("inactive", "success", "0")
    assert fresh.shell("ls /dev/shm; ls /run/shmmap") == ""


def test_the_daemon_has_no_rights_it_does_not_need(fresh: BootedSystemd) -> None:
    """And still it loads cells, from a home directory that it cannot enter otherwise."""
    fresh.run("systemctl", "start", "shmmapd")
    with Client(fresh, "alice") as alice:
        assert len(alice.ask()) == 12
    # layers are compiled: machine code is made at run time, and kept for the next loader
    layer = [
        "query",
        "--id",
        f"{MAP}/pointcloud_map.pcd/0_0.pcd",
        "--layer",
        "voxel(leaf=1)",
        "--wait",
        "120",
    ]
    done = shmmap(fresh, *layer, user="alice")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "voxel" in done.stdout
    assert fresh.shell("find /var/cache/shmmap/numba -name '*.kernel'") != ""
    pid = fresh.properties("shmmapd")["MainPID"]
    lines = fresh.shell(f"cat /proc/{pid}/status").splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert (status["CapEff"].strip("0"), status["CapBnd"].strip("0")) == ("", "")
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    unit = fresh.properties("shmmapd")
    assert unit["CPUWeight"] == "100"
    controllers = fresh.shell(f"cat /sys/fs/cgroup{unit['ControlGroup']}/cgroup.controllers").split()
    offered = fresh.shell("cat /sys/fs/cgroup/cgroup.controllers").split()
    assert ("cpu" in controllers) == ("cpu" in offered)  # then the nice values of loaders count
    inside = ["nsenter", f"--target={pid}", "--mount", "--net", "setpriv", "--reuid=shmmap", "--regid=shmmap"]
    inside += ["--init-groups", "--"]
    assert fresh.run(*inside, "ls", "/home/alice").stdout == "autoware_map\n"
    assert fresh.run(*inside, "touch", "/home/alice/autoware_map/x", check=False).returncode != 0
    assert fresh.run(*inside, "touch", "/etc/shmmap/x", check=False).returncode != 0
    assert fresh.run(*inside, "cat", "/proc/net/dev").stdout.count(":") == 1  # lo alone


def test_a_reload_shows_what_changed(fresh: BootedSystemd, the_map: DividedMap) -> None:
    fresh.run("systemctl", "start", "shmmapd")
    with Client(fresh, "alice") as alice:
        before = alice.ask()
        points = the_map.points("0_0.pcd")
        the_map.write_cell("0_0.pcd", (0, 0), {name: values[:7] for name, values in points.items()})
        fresh.run("systemctl", "reload", "shmmapd")
        # systemd 252 may count the reload as done just before it learns that it began
        after = first_answer(alice.ask, lambda now: now != before)
        assert until_state(fresh, "shmmapd", "active", "failed")["ActiveState"] == "active"
        assert {name for name in before if before[name] != after[name]} == {"0_0.pcd"}
        assert fresh.properties("shmmapd")["NRestarts"] == "0"


def test_the_watchdog_ends_a_daemon_that_hangs_and_the_next_one_is_warm(fresh: BootedSystemd) -> None:
    fresh.shell("""
        mkdir -p /run/systemd/system/shmmapd.service.d
        printf '[Service]\nWatchdogSec=5\n' >/run/systemd/system/shmmapd.service.d/test.conf
        systemctl daemon-reload
        systemctl start shmmapd
    """)
    with Client(fresh, "alice") as alice:
        before = alice.ask()
        names = segments(fresh)
        pid = fresh.properties("shmmapd")["MainPID"]
        fresh.run("kill", f"-{int(signal.SIGSTOP)}", pid)
        until(lambda: fresh.properties("shmmapd")["MainPID"] not in ("0", pid))
        fresh.run("systemctl", "start", "shmmapd")  # returns when it is ready
        assert "Watchdog timeout" in fresh.shell("journalctl --sync; journalctl --no-pager -u shmmapd")
        assert alice.held() == before
        assert alice.ask() == before
        assert segments(fresh) == names


def test_a_restart_keeps_the_cells_and_a_stop_does_not(fresh: BootedSystemd) -> None:
    fresh.run("systemctl", "start", "shmmapd")
    with Client(fresh, "alice") as alice:
        before = alice.ask()
        names = segments(fresh)
        assert len(names) == 12
        pid = fresh.properties("shmmapd")["MainPID"]
        fresh.run("systemctl", "restart", "shmmapd")
        assert fresh.properties("shmmapd")["MainPID"] != pid
        assert segments(fresh) == names
        assert alice.ask() == before
        assert segments(fresh) == names
    fresh.run("systemctl", "stop", "shmmapd")
    assert fresh.shell("ls /dev/shm") == ""
    fresh.run("systemctl", "start", "shmmapd")
    assert segments(fresh) == {}


def test_the_first_client_starts_it(fresh: BootedSystemd) -> None:
    fresh.run("systemctl", "start", "shmmapd.socket")
    text = shmmap(fresh, "doctor", "--all", user="alice").stdout
    assert "waits for the first client" in text
    assert fresh.properties("shmmapd")["ActiveState"] == "inactive"
    made = fresh.shell("stat -c '%i %a %U:%G' /run/shmmap/default.sock")
    assert made.split()[1:] == ["660", "shmmap:shmmap"]
    refused = shmmap(fresh, "query", "--circle", "0,0,25", user="mallory")
    assert (refused.returncode, fresh.properties("shmmapd")["ActiveState"]) == (69, "inactive")
    with Client(fresh, "alice") as alice:
        before = alice.ask()
        assert len(before) == 12
        assert fresh.properties("shmmapd")["ActiveState"] == "active"
        fresh.run("systemctl", "restart", "shmmapd")
        assert alice.ask() == before
        assert fresh.shell("stat -c '%i %a %U:%G' /run/shmmap/default.sock") == made
    fresh.run("systemctl", "stop", "shmmapd.socket", "shmmapd.service")
    assert fresh.shell("ls /run/shmmap") == ""


def test_several_maps_side_by_side(fresh: BootedSystemd) -> None:
    fresh.shell("cp /etc/shmmap/shmmap.toml /etc/shmmap/car.toml")
    # drop-ins of the plain service are its own: this one names its map's place itself
    fresh.shell("""
        mkdir -p /run/systemd/system/shmmapd@car.service.d
        cp /etc/systemd/system/shmmapd.service.d/20-map.conf /run/systemd/system/shmmapd@car.service.d/
        systemctl daemon-reload
        systemctl start shmmapd shmmapd@car.socket
    """)
    with Client(fresh, "alice", "/run/shmmap/car.sock") as car, Client(fresh, "alice") as plain:
        assert car.ask() == plain.ask()
        assert (len(segments(fresh, "car")), len(segments(fresh))) == (12, 12)
        fresh.run("systemctl", "stop", "shmmapd")
        assert segments(fresh) == {}
        assert len(car.ask()) == 12  # the directory of its socket is still there
    fresh.shell("rm /etc/shmmap/car.toml")


def test_a_second_daemon_of_an_instance_stays_down(fresh: BootedSystemd) -> None:
    fresh.run("systemctl", "start", "shmmapd")
    fresh.shell("""
        cp /etc/shmmap/shmmap.toml /etc/shmmap/default.toml
        mkdir -p /run/systemd/system/shmmapd@default.service.d
        cp /etc/systemd/system/shmmapd.service.d/20-map.conf /run/systemd/system/shmmapd@default.service.d/
        systemctl daemon-reload
    """)
    try:
        assert fresh.run("systemctl", "start", "shmmapd@default", check=False).returncode != 0
        second = fresh.properties("shmmapd@default")
        assert (second["ActiveState"], second["ExecMainStatus"], second["NRestarts"]) == ("failed", "75", "0")
        with Client(fresh, "alice") as alice:
            assert len(alice.ask()) == 12
    finally:
        fresh.shell("rm /etc/shmmap/default.toml")


def test_live_maps_have_a_place_and_the_rights_that_they_need(fresh: BootedSystemd) -> None:
    fresh.shell("""
        mkdir -p /run/systemd/system/shmmapd.service.d
        printf '[Service]\nEnvironment=SHMMAP_LIVE=lidar SHMMAP_LIVE_GROUP=shmmap\n' \
            >/run/systemd/system/shmmapd.service.d/test.conf
        systemctl daemon-reload
        systemctl start shmmapd
    """)
    done = shmmap(fresh, "status", "--json", user="alice")
    assert [row["name"] for row in json.loads(done.stdout)["live"]] == ["lidar"], done.stderr
    until(lambda: fresh.shell("ls -d /dev/shm/shmmap-live.default.marks || true") != "")
    places = "/var/lib/shmmap /var/lib/shmmap/state/default /var/lib/shmmap/state/default/live/lidar"
    assert fresh.shell(f"stat -c '%a %U:%G' {places} /dev/shm/shmmap-live.default.marks").splitlines() == [
        "755 root:root",
        "750 shmmap:shmmap",
        "700 shmmap:shmmap",
        "1770 shmmap:shmmap",
    ]
    fresh.run("systemctl", "stop", "shmmapd")
    unit = fresh.properties("shmmapd")
    assert (unit["ActiveState"], unit["Result"], unit["ExecMainStatus"]) == ("inactive", "success", "0")
    assert fresh.shell("ls /dev/shm") == ""


def test_administrators_reload_and_stop(fresh: BootedSystemd) -> None:
    fresh.shell("""
        mkdir -p /run/systemd/system/shmmapd.service.d
        printf '[Service]\nEnvironment=SHMMAP_ADMIN_GROUP=shmmap\n' \
            >/run/systemd/system/shmmapd.service.d/test.conf
        systemctl daemon-reload
        systemctl start shmmapd
    """)
    done = shmmap(fresh, "reload", user="alice")
    assert done.returncode == 0, done.stderr
    done = shmmap(fresh, "stop", user="alice")
    assert done.returncode == 0, done.stderr
    unit = until_state(fresh, "shmmapd", "inactive")
    # it was intended: systemd does not start it again
    assert (unit["Result"], unit["NRestarts"]) == ("success", "0")


@pytest.mark.parametrize(
    ("change", "status", "says"),
    [
        ("echo 'bugdet = 3' >>/etc/shmmap/shmmap.toml", "78", "did you mean"),
        ("rm /etc/shmmap/shmmap.toml", "78", "No such file"),
    ],
)
def test_what_cannot_get_better_is_tried_once(
    fresh: BootedSystemd, change: str, status: str, says: str
) -> None:
    fresh.shell("cp /etc/shmmap/shmmap.toml /etc/shmmap/kept")
    try:
        fresh.shell(change)
        assert fresh.run("systemctl", "start", "shmmapd", check=False).returncode != 0
        unit = fresh.properties("shmmapd")
        assert (unit["ActiveState"], unit["ExecMainStatus"], unit["NRestarts"]) == ("failed", status, "0")
        assert says in unit["StatusText"]
    finally:
        fresh.shell("mv /etc/shmmap/kept /etc/shmmap/shmmap.toml")


@pytest.mark.parametrize(
    ("hinder", "mend", "status", "says"),
    [
        pytest.param(
            "mount --bind /var/empty-map {map}",
            "umount {map}",
            "66",
            "there is no PCD file",
            id="not mounted",
        ),
        pytest.param(
            "dd if=/dev/zero of=/dev/shm/other bs=1M count=16 2>/dev/null || true",
            "rm /dev/shm/other",
            "71",
            "/dev/shm",
            id="full",
        ),
        pytest.param(
            "setpriv --reuid=mallory --regid=mallory --clear-groups touch /dev/shm/shmmap.default.statistics",
            "rm /dev/shm/shmmap.default.statistics",
            "71",
            "there is a file of user mallory (uid 61004)",
            id="squatted",
        ),
    ],
)
def test_what_can_get_better_is_tried_again_until_it_has(
    fresh: BootedSystemd, hinder: str, mend: str, status: str, says: str
) -> None:
    fresh.shell("mkdir -p /var/empty-map; mount -o remount,size=16m /dev/shm")
    try:
        fresh.shell(hinder.format(map=MAP))
        try:
            assert fresh.run("systemctl", "start", "shmmapd", check=False).returncode != 0
            waiting = Deadline()
            seen: list[str] = []  # empty while it runs
            while waiting(int((unit := fresh.properties("shmmapd"))["NRestarts"]) < 2 or not any(seen)):
                seen.append(unit["ExecMainStatus"].strip("0"))
            assert set(filter(None, seen)) == {status}
            assert says in fresh.shell("journalctl --sync; journalctl --no-pager -u shmmapd")
        finally:
            fresh.shell(mend.format(map=MAP))
        waiting = Deadline()
        while waiting((unit := fresh.properties("shmmapd"))["ActiveState"] != "active"):
            assert unit["Result"] != "start-limit-hit"
        with Client(fresh, "alice") as alice:
            assert len(alice.ask()) == 12
    finally:
        fresh.shell("mount -o remount,size=50% /dev/shm")


def test_a_waiting_client_does_not_keep_starting_what_stays_down(fresh: BootedSystemd) -> None:
    fresh.shell("cp /etc/shmmap/shmmap.toml /etc/shmmap/kept; echo 'bugdet = 3' >>/etc/shmmap/shmmap.toml")
    try:
        fresh.run("systemctl", "start", "shmmapd.socket")
        refused = shmmap(fresh, "query", "--circle", "0,0,25", "--timeout", "60", user="alice")
        assert refused.returncode == 69, refused
        assert until_state(fresh, "shmmapd.socket", "failed")["Result"] == "trigger-limit-hit"
    finally:
        fresh.shell("mv /etc/shmmap/kept /etc/shmmap/shmmap.toml")
    waiting = Deadline()  # the limit still counts for some seconds
    while waiting(shmmap(fresh, "query", "--circle", "0,0,25", user="alice").returncode != 0):
        fresh.run("systemctl", "start", "shmmapd.socket", check=False)


def test_the_doctor_says_to_each_user_what_is_wrong(fresh: BootedSystemd) -> None:
    def findings(user: str = "") -> dict[str, str]:
        report = json.loads(shmmap(fresh, "doctor", "--json", user=user).stdout)
        return {one["name"]: f"{one['state']}: {one['fact']} {one['advice']}" for one in report["findings"]}

    fresh.run("systemctl", "start", "shmmapd")
    well = findings("alice")
    assert {name for name, text in well.items() if text.startswith("fail")} == set(), well
    assert well["group"].startswith("ok: alice is a member of shmmap")
    assert well["open files"].startswith("ok: limit of the daemon")
    outsider = findings("mallory")
    assert outsider["group"].startswith("fail: mallory is not a member of shmmap")
    assert "usermod -aG shmmap mallory" in outsider["group"]
    assert outsider["socket"].startswith("fail")
    fresh.run("systemctl", "stop", "shmmapd")
    asleep = findings()
    assert asleep["map"].startswith("ok: /home/alice/autoware_map can be read by shmmap")
    fresh.shell("mv /etc/systemd/system/shmmapd.service.d/20-map.conf /etc/kept")
    try:
        assert "unit install --map /home/alice/autoware_map" in findings()["map"]
    finally:
        fresh.shell("mv /etc/kept /etc/systemd/system/shmmapd.service.d/20-map.conf")


def test_segments_on_huge_pages(fresh: BootedSystemd) -> None:
    """As `unit install --huge-pages` says it; a later install without it keeps them."""
    done = shmmap(fresh, "unit", "install", "--map", MAP, "--huge-pages")
    if "no huge pages" in done.stderr:
        pytest.skip("this kernel has no huge pages for tmpfs")
    try:
        assert done.returncode == 0, done.stderr
        assert "new" in next(line for line in done.stdout.splitlines() if "run-shmmap_huge.mount" in line)
        fresh.run("systemctl", "start", "shmmapd")
        with Client(fresh, "alice") as alice:
            assert len(alice.ask()) == 12
            names = segments(fresh, at="/run/shmmap_huge")
            assert (len(segments(fresh)), len(names)) == (0, 12)
        assert fresh.run("ls", "/run/shmmap_huge", user="mallory", check=False).returncode != 0
        options = fresh.shell("grep ' /run/shmmap_huge ' /proc/mounts").split()[3].split(",")
        assert {"huge=within_size", "mode=750", "nosuid", "nodev", "noexec"} <= set(options)
        # a program that asks no daemon finds it, too
        assert "/run/shmmap_huge" in shmmap(fresh, "status", user="alice").stdout
        report = json.loads(shmmap(fresh, "doctor", "--json", user="alice").stdout)
        (about,) = [one for one in report["findings"] if one["name"] == "huge pages"]
        assert about["fact"].startswith("on: /run/shmmap_huge has huge=within_size")
        again = shmmap(fresh, "unit", "install").stdout.splitlines()
        kept = [line.split()[1] for line in again if line.startswith("same ")]
        assert "/etc/systemd/system/run-shmmap_huge.mount" in kept
        assert "/etc/systemd/system/shmmapd@.service.d/30-huge-pages.conf" in kept
    finally:
        fresh.shell("""
            systemctl stop shmmapd run-shmmap_huge.mount
            rm /etc/systemd/system/run-shmmap_huge.mount /etc/systemd/system/*/30-huge-pages.conf
            rmdir /run/shmmap_huge
        """)


def test_a_user_s_own_service(fresh: BootedSystemd) -> None:
    own = ["env", "HOME=/home/alice", f"XDG_RUNTIME_DIR={RUN}"]
    control = [*own, "systemctl", "--user"]
    command = [*own, sys.executable, "-m", "shmmap.cli"]
    fresh.run("systemctl", "start", "user@61003.service")
    installed = fresh.run(*command, "unit", "install", "--user", "--map", MAP, user="alice").stdout
    assert "/home/alice/.config/systemd/user/shmmapd.service" in installed
    assert "loginctl enable-linger" in installed
    fresh.run(*control, "start", "shmmapd", user="alice")
    fresh.run(*command, "query", "--circle", "0,0,25", user="alice")
    names = segments(fresh)
    assert len(names) == 12
    assert fresh.run("stat", "-c", "%a", f"{RUN}/shmmap/default.sock").stdout == "600\n"
    fresh.run(*control, "restart", "shmmapd", user="alice")
    assert segments(fresh) == names
    fresh.run(*control, "reload", "shmmapd", user="alice")
    fresh.run(*control, "stop", "shmmapd", user="alice")
    assert fresh.shell("ls /dev/shm") == ""
    fresh.run(*control, "start", "shmmapd.socket", user="alice")
    fresh.run(*command, "query", "--circle", "0,0,25", "--timeout", "120", user="alice")
    assert len(segments(fresh)) == 12
    fresh.run(*control, "stop", "shmmapd.socket", "shmmapd.service", user="alice")
