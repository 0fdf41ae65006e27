# SPDX-License-Identifier: Apache-2.0
"""Each check: machines that are well and machines that are not, made of files in a directory."""

from __future__ import annotations

import dataclasses
import grp
import os
import socket
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from shmmap.daemon.config import DaemonConfig
from shmmap.doctor import access, cells, daemon, live, memory, published, verdicts
from shmmap.doctor.checks import CHECKS, diagnose, examine
from shmmap.doctor.diagnosis import Diagnosis, Machine
from shmmap.doctor.verdicts import Finding, cache_verdict, worst
from shmmap.live_settings import LiveSettings
from shmmap.protocol.rows import ClientRow, LiveMapRow
from shmmap.statistics.counters import COUNTER_NAMES, REFUSALS
from shmmap.statistics.layout import MAGIC
from shmmap.statistics.reader import Snapshot
from tests.support.divided_map import make_map
from tests.unit.doctor.conftest import USER, Ward, snapshot

S = 1_000_000_000


def test_the_worst_of_several() -> None:
    assert worst([]) == "ok"
    assert worst([Finding("a", "warn", ""), Finding("b", "ok", "")]) == "warn"
    assert worst([Finding("a", "warn", ""), Finding("b", "fail", ""), Finding("c", "ok", "")]) == "fail"


def test_every_check_says_something_about_this_machine(tmp_path: Path) -> None:
    """Whatever this machine is like: one finding each, and advice with everything that is not well."""
    config = DaemonConfig(endpoint=str(tmp_path / "none.sock"), instance="no-such-instance")
    findings = diagnose(examine(config, ""))
    assert len({one.name for one in findings}) == len(findings) == len(CHECKS)
    for one in findings:
        assert one.fact
        assert one.advice or one.state == "ok", one


def test_what_does_not_apply_is_skipped(ward: Ward) -> None:
    """Without a daemon, and with a map of files, whose store is never asked."""
    ward.mounts()
    skipped = {one.name: one.fact for one in diagnose(ward.diagnosis(map_path="/maps/town")) if one.skipped}
    for name in ("reload", "signature", "cells", "cache size", "prefetching"):
        assert skipped.pop(name) == "no daemon runs"
    for name in ("link", "credentials", "clock", "versions"):
        assert skipped.pop(name) == "the map is files"
    assert set(skipped) == {"disk cache", "live maps", "live disk", "live memory", "ROS bridge"}


# --- disk cache ---


def test_a_disk_cache_in_order(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    uid = os.geteuid()
    assert memory.check_disk_cache(ward.diagnosis(cache_bytes=0)).skipped
    assert memory.check_disk_cache(ward.diagnosis(uid=uid, cache_dir="/var/town")).skipped
    ward.file("/var/town/layers/ab/1.layer", "x" * 5000)
    ward.file(f"/var/town/objects/cells/ab/{1:064x}", "x" * 5000)
    found = memory.check_disk_cache(ward.diagnosis(uid=uid, cache_dir="/var/town", cache_bytes=1 << 20))
    assert (found.state, found.advice) == ("ok", "")
    assert found.fact.startswith("/var/town: 16.0 KiB of 1.0 MiB used, ")
    monkeypatch.setenv("CACHE_DIRECTORY", "/var/town")
    assert memory.check_disk_cache(ward.diagnosis(uid=uid)).fact.startswith("/var/town: 16.0 KiB of 8.0 GiB")
    found = memory.check_disk_cache(ward.diagnosis(uid=uid, cache_dir="/var/town/layers/ab/1.layer"))
    assert (found.state, found.fact) == ("warn", "/var/town/layers/ab/1.layer is no directory")


@pytest.mark.parametrize("mode", [0o775, 0o1777])
def test_a_disk_cache_that_others_may_write(ward: Ward, mode: int) -> None:
    ward.file(f"/var/town/objects/cells/ab/{1:064x}", "x")
    ward.root.joinpath("var/town/objects").chmod(mode)
    found = memory.check_disk_cache(ward.diagnosis(uid=os.geteuid(), cache_dir="/var/town"))
    assert found.state == "warn"
    assert f"/var/town/objects may be written by other users (mode {mode:04o})" in found.fact
    assert "chmod go-w /var/town/objects" in found.advice


@pytest.mark.root
@pytest.mark.parametrize("which", ["var/town", "var/town/objects"])
def test_a_disk_cache_of_another_user(ward: Ward, which: str) -> None:
    ward.file(f"/var/town/objects/cells/ab/{1:064x}", "x")
    os.chown(ward.root / which, USER, -1)
    found = memory.check_disk_cache(ward.diagnosis(uid=0, cache_dir="/var/town"))
    assert found.state == "warn"
    assert f"belongs to user {USER}" in found.fact or f"belongs to {USER}" in found.fact
    for name in ("var/town", "var/town/objects"):
        os.chown(ward.root / name, USER, -1)
    assert memory.check_disk_cache(ward.diagnosis(uid=USER, cache_dir="/var/town")).state == "ok"


def test_a_disk_cache_without_room(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    ward.file("/var/town/layers/ab/1.layer", "x")
    here = os.statvfs(ward.root)
    full = os.statvfs_result((*here[:4], here.f_blocks // 25, *here[5:]))  # f_bavail
    monkeypatch.setattr(os, "statvfs", lambda _: full)
    found = memory.check_disk_cache(ward.diagnosis(uid=os.geteuid(), cache_dir="/var/town"))
    assert found.state == "warn"
    assert "nothing more is kept" in found.fact


# --- memory ---


@pytest.mark.parametrize(("budget", "state"), [(0, "ok"), (1 << 20, "ok"), (1 << 60, "fail")])
def test_a_budget_against_the_file_system(ward: Ward, budget: int, state: str) -> None:
    found = memory.check_shared_memory(ward.diagnosis(budget_bytes=budget))
    assert found.state == state
    assert ("remount,size=" in found.advice) == (state == "fail")


def test_what_the_daemon_uses_already_is_no_shortage(ward: Ward) -> None:
    here = os.statvfs(ward.diagnosis().machine.path("/dev/shm"))
    free = here.f_bavail * here.f_frsize
    seen = snapshot(budget_bytes=free + (1 << 30), bytes_resident=1 << 31)
    assert memory.check_shared_memory(ward.diagnosis(seen)).state != "fail"
    seen = snapshot(budget_bytes=free + (1 << 31), bytes_resident=1 << 20)
    assert memory.check_shared_memory(ward.diagnosis(seen)).state == "fail"


def test_a_directory_that_is_no_tmpfs(ward: Ward) -> None:
    ward.mounts("/ ext4 rw", "/dev/shm tmpfs rw")
    (ward.root / "var/my maps").mkdir(parents=True)
    assert memory.check_shared_memory(ward.diagnosis()).state == "ok"
    found = memory.check_shared_memory(ward.diagnosis(shm_dir="/var/my maps"))
    assert (found.state, "ext4" in found.fact) == ("fail", True)
    ward.mounts("/ ext4 rw", "/var/my\\040maps tmpfs rw")
    assert memory.check_shared_memory(ward.diagnosis(shm_dir="/var/my maps")).state == "ok"
    assert memory.check_shared_memory(ward.diagnosis(shm_dir="/no/such")).state == "fail"


GROUPS = ("/sys/fs/cgroup cgroup2 rw", "/sys/fs/cgroup/memory cgroup rw,memory")


@pytest.mark.parametrize(
    ("line", "file", "limit", "budget", "state"),
    [
        ("0::/a/b", "/sys/fs/cgroup/a/memory.max", "max", 1 << 30, "ok"),
        ("0::/a/b", "/sys/fs/cgroup/a/memory.max", str(1 << 30), 1 << 30, "fail"),
        ("0::/a/b", "/sys/fs/cgroup/a/b/memory.max", str(4 << 30), 1 << 30, "ok"),
        ("0::/a/b", "/sys/fs/cgroup/a/b/memory.max", str(1 << 30), 0, "ok"),
        ("4:memory:/x", "/sys/fs/cgroup/memory/x/memory.limit_in_bytes", str(1 << 30), 1 << 30, "fail"),
        ("4:memory:/x", "/sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712", 1 << 30, "ok"),
        ("3:cpu:/x", "/sys/fs/cgroup/memory/x/memory.limit_in_bytes", str(1 << 20), 1 << 30, "ok"),
        # what the daemon chooses by itself, it does not find fault with
        ("0::/a/b", "/sys/fs/cgroup/a/b/memory.max", str(300 << 20), 150 << 20, "ok"),
        ("0::/a/b", "/sys/fs/cgroup/a/b/memory.max", str(300 << 20), 151 << 20, "fail"),
        ("0::/a/b", "/sys/fs/cgroup/a/memory.max", str(2 << 30), (2 << 30) - (256 << 20), "ok"),
    ],
)
def test_limits_of_the_control_group(
    ward: Ward, line: str, file: str, limit: str, budget: int, state: str
) -> None:
    ward.mounts(*GROUPS)
    ward.file("/proc/self/cgroup", line + "\n")
    ward.file(file, limit + "\n")
    found = memory.check_memory_limit(ward.diagnosis(budget_bytes=budget))
    assert found.state == state
    assert ("lower the budget" in found.advice) == (state == "fail")


def test_what_the_processes_use_beside_the_segments(ward: Ward) -> None:
    """Measured while the daemon runs: pages of a tmpfs are the segments' own, and not counted again."""
    ward.mounts(*GROUPS)
    ward.file("/proc/self/cgroup", "0::/a\n")
    ward.file("/sys/fs/cgroup/a/memory.max", f"{300 << 20}\n")
    for used, state in ((100 << 20, "ok"), (200 << 20, "warn")):
        ward.file("/sys/fs/cgroup/a/memory.stat", f"anon {used}\nshmem {150 << 20}\nfile {150 << 20}\n")
        diagnosis = ward.diagnosis(snapshot(budget_bytes=150 << 20), budget_bytes=150 << 20)
        found = memory.check_memory_limit(diagnosis)
        assert found.state == state
        assert f"its processes use {used >> 20} MiB" in found.fact


def test_the_cache_is_judged_as_status_does(ward: Ward) -> None:
    seen = snapshot(refused_over_budget_10min=3, budget_bytes=1 << 20)
    found = cells.check_cache(ward.diagnosis(seen))
    verdict = cache_verdict(seen.counters)
    assert (found.state, found.fact, found.advice) == ("warn", verdict.text, verdict.hint)
    assert found.fact.startswith("TOO SMALL")
    seen = snapshot(refused_over_budget_10min=3, refused_over_budget_1min=1, budget_bytes=1 << 20)
    assert cells.check_cache(ward.diagnosis(seen)).state == "fail", "clients lack cells now"
    assert cells.check_cache(ward.diagnosis(snapshot(evictions=3))).state == "ok"


DRIVING = {
    "prefetch_budget_bytes": 512 << 20,
    "budget_bytes": 1 << 30,
    "outage_tolerance_ns": 10 * S,
    "hits_10min": 4000,
}
SMALLER = "give the clients a smaller radius or a layer with fewer bytes"
ROUTES = (
    "give the daemon more --workers, and have clients send their route (MapWindow.move_to(route=...)):"
    " without one the daemon cannot know where they turn"
)
WAITED = "moving clients waited for 150 cells in the last 10 min"


@pytest.mark.parametrize(
    ("counters", "state", "fact", "advice"),
    [
        ({}, "ok", "off; moving clients waited for no cell in the last 10 min", ""),
        (
            {"prefetch_misses_10min": 2},
            "ok",
            "off; moving clients waited for 2 cells in the last 10 min",
            "raise --prefetch-share",
        ),
        (DRIVING, "ok", "moving clients waited for no cell in the last 10 min", ""),
        (
            DRIVING | {"last_outage_ns": 60 * S, "prefetch_short": 2},
            "ok",
            "moving clients waited for no cell in",
            "",
        ),
        (  # two in a hundred
            DRIVING | {"prefetch_misses_10min": 100, "misses_10min": 1000, "prefetch_short": 1},
            "ok",
            "moving clients waited for 100 cells in the last 10 min",
            "",
        ),
        (
            DRIVING | {"origin_out": 1, "last_outage_ns": 3 * S, "prefetch_misses_10min": 1},
            "warn",
            "the map's storage is out of reach: no load has succeeded for 3.0 s; moving clients waited for 1",
            "see to its disk or network; `shmmap tail` says why loads fail",
        ),
        (
            DRIVING | {"prefetch_misses_10min": 1, "last_outage_ns": 13 * S + 1},
            "warn",
            "moving clients waited for 1 cell in the last 10 min; the map's storage was out of reach for 13",
            "raise --outage-tolerance (14)",
        ),
        (
            DRIVING | {"prefetch_misses_10min": 150, "prefetch_short": 1},
            "warn",
            f"{WAITED}; cells fetched ahead take all of their share, 512 MiB",
            f"raise --prefetch-share or --budget, or {SMALLER}",
        ),
        (
            DRIVING | {"prefetch_misses_10min": 150, "prefetch_short": 2},
            "warn",
            f"{WAITED}; the budget of 1.0 GiB is full of what is in use or needed sooner",
            f"raise --budget, or {SMALLER}",
        ),
        (
            DRIVING | {"prefetch_misses_10min": 150, "misses_10min": 1000},
            "warn",
            WAITED,
            ROUTES,
        ),
    ],
)
def test_whether_prefetching_keeps_up(
    ward: Ward, counters: dict[str, int], state: str, fact: str, advice: str
) -> None:
    assert set(counters) <= set(COUNTER_NAMES)
    seen = snapshot()
    seen.counters.update(counters)
    found = cells.check_prefetching(ward.diagnosis(seen))
    assert (found.state, found.advice) == (state, advice)
    assert found.fact.startswith(fact)


def test_containers(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    assert memory.check_container(ward.diagnosis()).fact == "not in a container"
    ward.file("/run/systemd/container", "podman\n")
    assert memory.check_container(ward.diagnosis()).state == "ok"
    monkeypatch.setattr(memory, "CONTAINER_DEFAULT_BYTES", 1 << 60)
    found = memory.check_container(ward.diagnosis())
    assert (found.state, "--shm-size" in found.advice, "--ipc=host" in found.advice) == ("warn", True, True)


NEW, OLD = "6.14.0-rc1-x", "6.13.12"


@pytest.mark.parametrize(
    ("options", "switch", "release", "state", "fact", "advice"),
    [
        ("rw,huge=within_size", "never", NEW, "ok", "on: /dev/shm has huge=within_size; Linux 6.14", ""),
        ("rw,huge=within_size", "never", OLD, "ok", "on: /dev/shm has huge=within_size; Linux 6.13", ""),
        ("rw,huge=within_size", "never", "7.0.1", "ok", "on: /dev/shm has huge=within_size; Linux 7.0", ""),
        ("rw", "never", NEW, "ok", "off for /dev/shm", "unit install --huge-pages"),
        ("rw,huge=never", "never", NEW, "ok", "off for /dev/shm", "remount,huge=within_size /dev/shm"),
        ("rw", "never", OLD, "ok", "off for /dev/shm; Linux 6.13", ""),
        ("rw", "never", "", "ok", "off for /dev/shm", ""),
        ("rw,huge=advise", "never", NEW, "ok", "off: /dev/shm has huge=advise", "remount"),
        ("rw,huge=always", "never", NEW, "warn", "/dev/shm has huge=always", "remount"),
        ("rw", "force", OLD, "ok", "on: the kernel forces", ""),
        ("rw,huge=within_size", "deny", NEW, "ok", "off: the kernel has none", ""),
        ("rw", "", NEW, "ok", "off: the kernel has none", ""),
    ],
)
def test_huge_pages(
    ward: Ward, options: str, switch: str, release: str, state: str, fact: str, advice: str
) -> None:
    ward.mounts(f"/dev/shm tmpfs {options}")
    ward.file("/proc/sys/kernel/osrelease", release + "\n")
    choices = "always within_size advise never deny force ".replace(f"{switch} ", f"[{switch}] ")
    if switch:
        ward.file("/sys/kernel/mm/transparent_hugepage/shmem_enabled", choices)
    found = memory.check_huge_pages(ward.diagnosis())
    assert (found.state, found.fact.startswith(fact)) == (state, True), found
    assert (advice in found.advice) if advice else not found.advice, found
    if "within_size;" in found.fact:
        assert ("for cells of all sizes" in found.fact) == (release != OLD)


# --- live maps ---

LIDAR = LiveMapRow(
    "lidar", "/maps/lidar", 0.1, "map", 12, 1000, 4 << 20, 0, 3, 1, 0, 40, 9 << 20, 100, 93, 16 << 20
)


def with_live(*rows: LiveMapRow, clients: Sequence[ClientRow] = (), **counters: int) -> Snapshot:
    """A daemon that keeps these live maps, and accepts no connection."""
    seen = snapshot("hung")
    seen.__dict__["counters"] = counters
    seen.live, seen.clients = rows, clients
    return seen


def marks(ward: Ward, mode: int = 0o700) -> None:
    path = ward.root / "dev/shm/shmmap-live.default.marks"
    path.mkdir(parents=True)
    path.chmod(mode)


def test_without_live_maps_there_is_nothing_to_look_at(ward: Ward) -> None:
    for diagnosis in (ward.diagnosis(), ward.diagnosis(with_live())):
        for check in (live.check_live_maps, live.check_live_disk, live.check_live_memory):
            assert check(diagnosis).skipped, check


def test_live_maps_of_a_daemon_that_does_not_answer(ward: Ward) -> None:
    seen = snapshot("stopped")
    assert seen.identity is not None
    seen.identity = dataclasses.replace(seen.identity, live="lidar radar")
    found = live.check_live_maps(ward.diagnosis(seen))
    assert (found.skipped, found.fact) == (True, "lidar, radar: the daemon does not answer")
    assert access.check_map_access(ward.diagnosis(seen, map_path="")).state == "ok"


@pytest.mark.parametrize(
    ("row", "restarts", "state", "fact"),
    [
        (LIDAR, 0, "ok", "lidar: 4 chunks not saved yet"),
        (LIDAR, 2, "warn", "the process that keeps them ended 2 times"),
        (replace(LIDAR, damaged_count=2), 2, "warn", "lost chunks, damaged databases: 2"),
        (
            replace(LIDAR, damaged_count=2, problem="chunk 0_0_0 cannot be saved: full"),
            0,
            "fail",
            "lidar: chunk 0_",
        ),
    ],
)
def test_what_is_wrong_with_live_maps(
    ward: Ward, row: LiveMapRow, restarts: int, state: str, fact: str
) -> None:
    found = live.check_live_maps(ward.diagnosis(with_live(row, live_restarts=restarts)))
    assert (found.state, fact in found.fact) == (state, True), found


def test_the_disk_of_live_maps(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "ROOM_BYTES", 0)
    settings = (LiveSettings("lidar", "/maps/lidar"),)
    (ward.root / "maps").mkdir(parents=True)
    mine = os.geteuid()

    def check(*, uid: int = mine, seen: Snapshot | None = None, file: str = "") -> Finding:
        return live.check_live_disk(ward.diagnosis(seen, uid=uid, file=file, live=settings))

    assert check().state == "ok"  # the daemon makes it
    assert "/maps/lidar is gone" in check(seen=with_live(LIDAR)).fact
    (ward.root / "maps/lidar").mkdir(mode=0o700)
    found = check(seen=with_live(replace(LIDAR, budget_bytes=1)))
    assert (found.state, "lidar: /maps/lidar, " in found.fact) == ("ok", True)
    found = check(seen=with_live(replace(LIDAR, budget_bytes=1 << 60)))
    assert (found.state, "may have to be saved" in found.fact) == ("warn", True)
    found = check(uid=USER)
    assert (found.state, f"{USER} may not write to /maps/lidar" in found.fact) == ("fail", True)
    (ward.root / "maps/lidar").chmod(0o703)
    assert check(uid=USER).state == "ok"

    # what the service sees
    ward.file("/etc/systemd/system/shmmapd.service", "")
    monkeypatch.setattr(Diagnosis, "runs_as", mine)
    installed = "/etc/shmmap/shmmap.toml"
    assert "ProtectSystem=" in check(file=installed).fact
    drop_in = "/etc/systemd/system/shmmapd.service.d/x.conf"
    ward.file(drop_in, "[Service]\nReadWritePaths=-/maps/lidar2\n")
    assert check(file=installed).state == "fail"
    ward.file(drop_in, "[Service]\nReadWritePaths=/else -/maps\n")
    assert check(file=installed).state == "ok"
    settings = (LiveSettings("lidar"),)
    (ward.root / "var/lib/shmmap").mkdir(parents=True)
    assert "/var/lib/shmmap/state/default/live/lidar" in check(file=installed).fact


def test_chunks_are_not_on_huge_pages(ward: Ward) -> None:
    marks(ward)
    settings = (LiveSettings("lidar"),)
    ward.mounts("/dev/shm tmpfs rw", "/run/huge tmpfs rw,huge=within_size")

    def check(**more: Any) -> Finding:
        return live.check_live_memory(ward.diagnosis(live=settings, **more))

    assert check().state == "ok"
    assert check(shm_dir="/run/huge").fact == "/dev/shm"
    found = check(live_shm_dir="/run/huge/x")
    assert (found.state, "huge=within_size" in found.fact) == ("fail", True)


def test_where_mappers_put_their_scans(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    def check(**settings: Any) -> Finding:
        return live.check_live_memory(ward.diagnosis(with_live(LIDAR), **settings))

    assert "marks is gone" in check().fact
    marks(ward)
    assert check().state == "ok"
    assert "has mode 700, not 1770" in check(live_group="61999").fact
    path = ward.root / "dev/shm/shmmap-live.default.marks"
    path.chmod(0o1770)
    assert check(live_group=str(os.getegid())).state == "ok"
    assert "not 61999" in check(live_group="61999").fact
    path.chmod(0o777)
    found = check()
    assert (found.state, "has mode 777" in found.fact) == ("warn", True)


def process(
    ward: Ward, pid: int, parent: int, name: str, mapped: Sequence[str], opened: Sequence[str]
) -> None:
    """A process that has files of chunks mapped and open."""
    lines = "".join(f"7f0000000000-7f0000081000 r--s 00000000 00:19 77   /dev/shm/{one}\n" for one in mapped)
    ward.file(f"/proc/{pid}/maps", "7ffd0000-7ffe0000 rw-p 00000000 00:00 0    [stack]\n" + lines)
    ward.file(f"/proc/{pid}/comm", name + "\n")
    ward.file(f"/proc/{pid}/stat", f"{pid} (a ) b) S {parent} 1 1 0 -1")
    ward.file(f"/proc/{pid}/fd/0", "")
    for number, one in enumerate(opened, 3):
        (ward.root / f"proc/{pid}/fd/{number}").symlink_to(f"/dev/shm/{one}")


def test_readers_that_keep_chunks_are_named(ward: Ward) -> None:
    """Whatever became of the files: those that were given up have no name any more."""
    marks(ward)
    chunks = [f"shmmap-live.default.lidar.{x}_-1_0.7" for x in range(20)]
    gone = [f"{name} (deleted)" for name in chunks]
    seen = with_live(LIDAR)
    process(ward, 4242, 1, "shmmapd", [], [])
    process(ward, 101, 4242, "worker", chunks, chunks)
    process(
        ward,
        102,
        1,
        "honest",
        ["shmmap-live.default.marks/2f.17"],
        [*chunks[:2], "shmmap-live.default.lidar.voxels.00"],
    )
    process(ward, 103, 1, "other", [name.replace("default", "night") for name in chunks], [])

    def check() -> Finding:
        return live.check_live_memory(ward.diagnosis(seen))

    assert check().state == "ok"
    process(ward, 200, 1, "few", gone[:1], [])
    process(ward, 201, 1, "opens", [], gone)
    process(ward, 202, 1, "greedy", [*gone, *chunks[:3]], gone[:4])
    found = check()
    assert found.state == "warn"
    assert "opens, pid 201: 20 chunks" in found.fact
    assert "greedy, pid 202: 20 chunks" in found.fact
    assert found.fact.endswith("few, pid 200: 1 chunk")
    process(ward, 203, 1, "another", gone[:5], [])
    assert check().fact.endswith("; and 1 more")


def test_readers_whose_requests_take_much_time_are_named(ward: Ward) -> None:
    marks(ward)
    clients = [ClientRow(3, 4242, 0, 0, "perception", "python3", 0, 0, 0, 0)]
    busiest = ((3, 730), (9, 500), (5, 499))
    row = replace(LIDAR, readers=busiest)
    found = live.check_live_memory(ward.diagnosis(with_live(row, clients=clients)))
    assert found.state == "warn"
    assert found.fact.endswith("perception, pid 4242: 73 % for lidar; session 9: 50 % for lidar")


def test_chunks_of_a_daemon_that_does_not_run_are_no_rubbish(ward: Ward) -> None:
    ward.file("/dev/shm/shmmap-live.default.lidar.-1_0_0.8", "x")
    ward.file("/dev/shm/shmmap-live.default.lidar.undo", "x")
    found = daemon.check_leftovers(ward.diagnosis())
    assert (found.state, "default: 1 segment" in found.fact, " rm " in found.advice) == ("warn", True, False)
    assert daemon.check_leftovers(ward.diagnosis(snapshot())).state == "ok"


# --- kernel ---


def test_pins_on_a_real_tmpfs(monkeypatch: pytest.MonkeyPatch) -> None:
    diagnosis = Diagnosis(Machine(), DaemonConfig(), "", "", snapshot("absent"))
    assert daemon.check_pins(diagnosis).state == "ok"
    monkeypatch.setenv("SHMMAP_TEST_PINS", "locks")
    found = daemon.check_pins(diagnosis)
    assert (found.state, "locks of clients" in found.fact) == ("warn", True)
    missing = Diagnosis(Machine(), DaemonConfig(shm_dir="/no/such/directory"), "", "", snapshot("absent"))
    assert daemon.check_pins(missing).state == "fail"


@pytest.mark.parametrize(("hard", "state"), [("1024", "warn"), ("65536", "ok"), ("unlimited", "ok")])
def test_descriptors_of_the_daemon(ward: Ward, hard: str, state: str) -> None:
    ward.file(
        "/proc/4242/limits", f"Limit  Soft Limit  Hard Limit\nMax open files   1024    {hard}    files\n"
    )
    found = daemon.check_descriptors(ward.diagnosis(snapshot()))
    assert found.state == state
    assert "pid 4242" in found.fact


# --- access ---


def test_groups(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    assert access.check_group(ward.diagnosis(endpoint="/no/socket")).state == "ok"
    assert access.check_group(ward.diagnosis(group="no such group")).state == "fail"
    mine, other = str(os.getegid()), "61999"
    monkeypatch.setattr(os, "getgroups", list)
    assert access.check_group(ward.diagnosis(group=other, uid=0)).state == "ok"
    ward.file("/proc/4242/status", "")
    someone = ward.diagnosis(snapshot(), group=other, uid=USER + 1)
    assert access.check_group(someone).state == "fail"
    assert "usermod -aG 61999" in access.check_group(someone).advice
    assert access.check_group(dataclasses.replace(someone, config=DaemonConfig(group=mine))).state == "ok"
    monkeypatch.setattr(access, "groups_of", lambda _: {61999})
    found = access.check_group(someone)
    assert (found.state, "log in again" in found.advice) == ("warn", True)


def test_a_group_whose_name_is_a_number(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    named = grp.struct_group(("61999", "x", os.getegid(), []))
    monkeypatch.setattr(grp, "getgrnam", {"61999": named}.__getitem__)
    ward.file("/proc/4242/status", "")
    someone = ward.diagnosis(snapshot(), group="61999", uid=USER + 1)
    assert access.check_group(someone).state == "ok", "as the daemon takes it"


def test_sockets(tmp_path: Path, ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "ANSWER_S", 0.05)
    path = tmp_path / "s"
    assert access.check_socket(ward.diagnosis(endpoint=str(path))).state == "warn"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        assert "gone" in access.check_socket(ward.diagnosis(endpoint=str(path))).fact
        listener.listen()
        assert "does not answer" in access.check_socket(ward.diagnosis(endpoint=str(path))).fact


def test_a_socket_that_waits_for_the_first_client(tmp_path: Path) -> None:
    """Nothing connects to it: that would start the daemon."""
    path = str(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(path)
        diagnosis = Diagnosis(Machine(), DaemonConfig(endpoint=path), "", path, snapshot("absent"))
        bound_alone = diagnosis.awaits_first_client
        listener.listen()
        listener.setblocking(False)
        assert (bound_alone, diagnosis.awaits_first_client) == (False, True)
        assert not dataclasses.replace(diagnosis, seen=snapshot()).awaits_first_client
        assert access.check_socket(diagnosis).state == daemon.check_daemon(diagnosis).state == "ok"
        with pytest.raises(BlockingIOError):
            listener.accept()


def test_maps(tmp_path: Path, ward: Ward) -> None:
    made = make_map(tmp_path / "map", columns=2, rows=1, points=3)
    path = str(made.root)
    assert access.check_map_access(ward.diagnosis()).state == "warn"
    assert access.check_map_access(ward.diagnosis(live=(LiveSettings("lidar"),))).state == "ok"
    assert access.check_map_access(ward.diagnosis(map_path=str(tmp_path / "none"))).state == "fail"
    assert (
        access.check_map_access(ward.diagnosis(snapshot(), map_path=path)).fact
        == "/maps/town is being served"
    )
    assert access.check_map_access(ward.diagnosis(map_path=path, uid=0)).state == "ok"
    made.root.chmod(0o750)
    found = access.check_map_access(ward.diagnosis(map_path=path))
    assert found.state == "fail"
    assert "chmod" in found.advice


def test_a_map_in_a_home_directory(tmp_path: Path, ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service sees it if and only if a drop-in shows it; what lies above does not matter then."""
    home = tmp_path / "home"
    made = make_map(home / "alice" / "map", columns=2, rows=1, points=3)
    (home / "alice").chmod(0o700)
    monkeypatch.setattr("shmmap.service.program._HIDDEN", (str(home),))
    ward.file("/etc/systemd/system/shmmapd.service", "")
    monkeypatch.setattr(Diagnosis, "runs_as", USER)
    diagnosis = ward.diagnosis(map_path=str(made.root), file="/etc/shmmap/shmmap.toml", uid=0)
    found = access.check_map_access(diagnosis)
    assert (found.state, "unit install --map" in found.advice) == ("fail", True)
    ward.file(
        "/etc/systemd/system/shmmapd.service.d/x.conf", f"[Service]\nBindReadOnlyPaths={home}/alice/map\n"
    )
    assert access.check_map_access(diagnosis).state == "ok"
    (made.root / "pointcloud_map.pcd").chmod(0o700)
    assert access.check_map_access(diagnosis).state == "fail"


# --- daemon ---


@pytest.mark.parametrize(
    ("seen", "state"),
    [
        (snapshot(), "ok"),
        (snapshot("absent"), "warn"),
        (snapshot("dead"), "fail"),
        (snapshot("stopped"), "fail"),
        (snapshot("hung"), "fail"),
        (snapshot(version="0.0.0"), "warn"),
        (None, "warn"),
    ],
)
def test_the_daemon(ward: Ward, seen: Snapshot | None, state: str) -> None:
    """Without its statistics if they are another user's."""
    diagnosis = dataclasses.replace(ward.diagnosis(), seen=seen, unreadable=("no", "so"))
    assert daemon.check_daemon(diagnosis).state == state


def test_statistics_of_another_version_or_of_another_program(tmp_path: Path) -> None:
    """The advice is about them, not about permissions."""
    file = tmp_path / "shmmap.one.statistics"
    file.write_bytes(MAGIC + struct.pack("<HH", 2, 0) + bytes(8192))
    found = daemon.check_daemon(examine(DaemonConfig(instance="one", shm_dir=str(tmp_path)), ""))
    assert (found.state, found.advice) == ("warn", "update the daemon, and restart it")
    assert "of an older daemon" in found.fact
    file.write_bytes(b"x")
    found = daemon.check_daemon(examine(DaemonConfig(instance="one", shm_dir=str(tmp_path)), ""))
    assert (found.state, found.advice) == ("warn", "restart the daemon")


def test_leftovers(ward: Ward) -> None:
    assert daemon.check_leftovers(ward.diagnosis()).fact == "none"
    ward.file("/dev/shm/shmmap.default.0123456789abcdef", "x" * 5000)
    ward.file("/dev/shm/shmmap.default.statistics", "x")
    found = daemon.check_leftovers(ward.diagnosis())
    assert (found.state, "default: 1 segment, 8.0 KiB" in found.fact) == ("warn", True)
    assert daemon.check_leftovers(ward.diagnosis(snapshot())).state == "ok"
    ward.file("/dev/shm/shmmap.no-such-instance.0123456789abcdef.zombie", "x")
    found = daemon.check_leftovers(ward.diagnosis(snapshot()))
    assert (found.state, "no-such-instance" in found.fact) == ("warn", True)


@pytest.mark.parametrize(
    ("files", "state"),
    [
        ({}, "warn"),
        ({"/etc/systemd/logind.conf": "[Login]\n#RemoveIPC=no\n"}, "warn"),
        ({"/etc/systemd/logind.conf": "[Login]\nRemoveIPC=no\n"}, "ok"),
        ({"/usr/lib/systemd/logind.conf.d/a.conf": "[Login]\nRemoveIPC = no\n"}, "ok"),
        (
            {
                "/etc/systemd/logind.conf": "[Login]\nRemoveIPC=no\n",
                "/etc/systemd/logind.conf.d/z.conf": "[Login]\nRemoveIPC=yes\n",
            },
            "warn",
        ),
        (
            {
                "/usr/lib/systemd/logind.conf.d/a.conf": "[Login]\nRemoveIPC=yes\n",
                "/etc/systemd/logind.conf.d/a.conf": "[Login]\nRemoveIPC=no\n",
            },
            "ok",
        ),
        ({f"/var/lib/systemd/linger/{USER}": ""}, "ok"),
    ],
)
def test_logind(ward: Ward, files: dict[str, str], state: str) -> None:
    assert daemon.check_logind(ward.diagnosis()).state == "ok", "without systemd"
    (ward.root / "run/systemd/system").mkdir(parents=True)
    for name, text in files.items():
        ward.file(name, text)
    assert daemon.check_logind(ward.diagnosis()).state == state
    assert daemon.check_logind(ward.diagnosis(uid=995)).state == "ok"


def test_reloads(ward: Ward) -> None:
    once = daemon.check_reload(ward.diagnosis(snapshot(reloads=0)))
    assert once.fact == "the map was read once, at the start"
    again = daemon.check_reload(ward.diagnosis(snapshot(reloads=3)))
    assert again.fact == "the map was read at the start and 3 times again"
    found = daemon.check_reload(ward.diagnosis(snapshot(last_reload_failed=1, last_reload_unix_ns=1)))
    assert (found.state, "shmmap reload" in found.advice) == ("fail", True)


# --- a published map that is verified -----------------------------------------------------------------


def seconds(ago_s: float) -> int:
    """Return the time that was ``ago_s`` seconds ago, as counters have it."""
    return int((time.time() - ago_s) * 1e9)


SIGNED, UNTIL, REFUSAL = "published_signed_unix_ns", "published_expires_unix_ns", "published_refusal"


@pytest.mark.parametrize(
    ("counters", "state", "says"),
    [
        ({}, "ok", "not verified"),
        ({SIGNED: 60, UNTIL: -3600}, "ok", "valid until"),
        ({SIGNED: 600, UNTIL: 60}, "fail", "expired since"),
        ({SIGNED: -600, UNTIL: -900}, "fail", "clock says"),
        ({SIGNED: -60, UNTIL: -900}, "ok", "valid until"),
        ({SIGNED: 60, UNTIL: -3600, REFUSAL: REFUSALS.index("older")}, "ok", "valid until"),
        ({REFUSAL: REFUSALS.index("older")}, "ok", "not verified"),
    ],
)
def test_the_signature_of_a_published_map(
    ward: Ward, counters: dict[str, int], state: str, says: str
) -> None:
    """Times are given as seconds before now."""
    counters = {name: seconds(value) if name != REFUSAL else value for name, value in counters.items()}
    found = published.check_signature(ward.diagnosis(snapshot("healthy", version="", **counters)))
    assert (found.state, says in found.fact) == (state, True)
    assert found.skipped == (says == "not verified")
    assert bool(found.advice) == (state != "ok")
    problems = verdicts.trust_problems(counters, time.time())
    assert bool(problems) == (says == "expired since" or REFUSAL in counters)
    assert bool(verdicts.signature_lines(counters, time.time())) == bool(counters)


def test_what_has_expired_and_is_refused_is_both_said() -> None:
    counters = {SIGNED: seconds(900), UNTIL: seconds(60), REFUSAL: REFUSALS.index("expired")}
    expired, refused = verdicts.trust_problems(counters, time.time())
    assert "expired since" in expired
    assert "is refused, expired" in refused
    # a clock that is behind changes nothing about that
    behind = {**counters, SIGNED: seconds(30)}
    assert len(verdicts.trust_problems(behind, time.time() - 86400)) == 2


# --- whether the cache is too small: the same verdict for every verb that prints it -----------------------


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "large enough: nothing evicted for room, nothing refused"),
        (
            {"evictions": 29},
            (
                "large enough: nothing evicted for room or refused in the last 10 min"
                " (29 evicted for room since the start)"
            ),
        ),
        (
            {"evictions": 29, "refused_over_budget": 4},
            (
                "large enough: nothing evicted for room or refused in the last 10 min"
                " (29 evicted for room and 4 refused since the start)"
            ),
        ),
        ({"refused_quota": 9}, "large enough: nothing evicted for room, nothing refused"),
        (
            {"evictions_10min": 50, "misses_10min": 500, "loads_after_eviction_10min": 5, "evictions": 50},
            "large enough: 50 evicted for room in the last 10 min, hardly any asked for again",
        ),
        (
            {"evictions_10min": 50, "misses_10min": 50, "loads_after_eviction_10min": 30},
            "TOO SMALL: 30 loads in the last 10 min (60 % of all) were of cells evicted before",
        ),
        (
            {"refused_over_budget_10min": 2, "bytes_pinned": 1 << 20, "budget_bytes": 1 << 20},
            "TOO SMALL: 2 cells refused in the last 10 min; clients use 1.0 MiB of 1.0 MiB",
        ),
    ],
)
def test_the_verdict_on_the_cache(values: dict[str, int], text: str) -> None:
    assert set(values) <= set(COUNTER_NAMES)
    verdict = cache_verdict(values)
    assert verdict.text == text
    assert ("--budget" in verdict.hint) == verdict.too_small == text.startswith("TOO SMALL")
