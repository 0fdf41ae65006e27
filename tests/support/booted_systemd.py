# SPDX-License-Identifier: Apache-2.0
"""A real systemd as process 1 of namespaces of its own, on a throw-away overlay of this machine.

It has its own processes, mounts, network, /dev/shm, /run and cgroup; what it writes lies in memory and is
gone with it.  Units that this machine has enabled are not started.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT, wait_ended, wait_readable

BOOT_S = 180.0
COMMAND_S = 180.0
CANNOT = 77
"""Exit code of the script for "this machine does not allow it"."""

PREPARE = r"""
set -eu
exchange=$1; shift
cannot() { echo "$*" >&2; exit 77; }
mount --make-rprivate /
mount -t tmpfs -o mode=755 tmpfs "$exchange/overlay" || cannot "cannot mount a tmpfs"
cd "$exchange/overlay"; mkdir upper work root; R=$PWD/root
mount -t overlay overlay -o "lowerdir=/,upperdir=$PWD/upper,workdir=$PWD/work" "$R" || cannot "no overlayfs"
# /tmp would be emptied while booting
for place in tmp var/tmp; do mount -t tmpfs -o mode=1777 tmpfs "$R/$place"; done
# this Python, wherever it lies: every account may get there
for place; do
    mkdir -p "$R$place"
    above=$place
    while above=$(dirname "$above"); [ "$above" != / ]; do chmod a+x "$R$above"; done
done
for place; do mount --bind "$place" "$R$place"; mount -o remount,bind,ro "$R$place"; done
mount -t proc proc "$R/proc" || cannot "cannot mount /proc"
mount --bind "$R/proc/sys" "$R/proc/sys"; mount -o remount,bind,ro "$R/proc/sys"
mount -t sysfs -o ro sysfs "$R/sys" || cannot "cannot mount /sys"
mount -t tmpfs tmpfs "$R/sys/fs/cgroup"
mount -t cgroup2 cgroup2 "$R/sys/fs/cgroup" || cannot "cannot mount cgroup2"
for place in run dev etc/systemd/system home; do mount -t tmpfs -o mode=755 tmpfs "$R/$place"; done
for node in null zero full random urandom tty; do
    : >"$R/dev/$node"; mount --bind "/dev/$node" "$R/dev/$node"
done
mkdir "$R/dev/shm" "$R/dev/pts" "$R/exchange"
mount -t tmpfs -o mode=1777 tmpfs "$R/dev/shm"
mount -t devpts -o newinstance,ptmxmode=666,mode=620 devpts "$R/dev/pts"
ln -s pts/ptmx "$R/dev/ptmx"; ln -s /proc/self/fd "$R/dev/fd"
mount --bind "$exchange/shared" "$R/exchange"
echo 0123456789abcdef0123456789abcdef >"$R/etc/machine-id"
: >"$R/etc/fstab"
mkdir -p "$R/etc/tmpfiles.d"; ln -sf /dev/null "$R/etc/tmpfiles.d/tmp.conf" # empties /tmp, too
rm -rf "$R/etc/shmmap" "$R/etc/sysusers.d/shmmap.conf" "$R/etc/tmpfiles.d/shmmap.conf"
# what would look for hardware, change the kernel's settings or start on a clock
for unit in systemd-sysctl.service systemd-modules-load.service systemd-remount-fs.service \
    systemd-update-utmp.service systemd-random-seed.service systemd-udevd.service \
    systemd-udev-trigger.service systemd-hwdb-update.service systemd-firstboot.service \
    systemd-machine-id-commit.service systemd-tmpfiles-clean.timer kmod-static-nodes.service \
    ldconfig.service dev-hugepages.mount dev-mqueue.mount sys-kernel-debug.mount \
    sys-kernel-tracing.mount sys-kernel-config.mount sys-fs-fuse-connections.mount \
    proc-sys-fs-binfmt_misc.automount systemd-binfmt.service timers.target; do
    ln -s /dev/null "$R/etc/systemd/system/$unit"
done
printf '[Unit]\nRequires=basic.target\nAfter=basic.target\nAllowIsolate=yes\n' \
    >"$R/etc/systemd/system/test.target"
cd "$R"; mkdir -p old; pivot_root . old; umount -l /old
exec env -i container=unshare PATH=/usr/sbin:/usr/bin:/sbin:/bin NOTIFY_SOCKET=/exchange/notify \
    "$SYSTEMD" --unit=test.target --log-target=journal --show-status=no
"""


def needed_directories() -> list[str]:
    """Directories this Python and these sources need; some may lie on file systems of their own."""
    places = [sys.prefix, sys.base_prefix, os.path.dirname(os.path.dirname(os.path.realpath(sys.executable)))]
    places += [path for path in sys.path if os.path.isdir(path)] + [str(ROOT)]
    kept: list[str] = []
    for place in sorted({os.path.abspath(place) for place in places}):
        system = place.startswith(("/usr/", "/bin/", "/lib")) or place == "/usr"
        if not system and not any(place.startswith(other + "/") for other in kept):
            kept.append(place)
    return kept


def _cgroup2() -> Path:
    for line in Path("/proc/mounts").read_text().splitlines():
        _, where, kind, options, *_ = line.split()
        if kind == "cgroup2" and "ro" not in options.split(","):
            return Path(where)
    pytest.skip("there is no cgroup2 that can be written")


class BootedSystemd:
    """Boots in the constructor; the test is skipped, with the reason, where this machine does not allow it.

    Attributes
    ----------
    shared
        A directory of this machine that is ``/exchange`` inside.
    """

    def __init__(self) -> None:
        systemd = next(
            (
                path
                for path in ("/lib/systemd/systemd", "/usr/lib/systemd/systemd")
                if os.access(path, os.X_OK)
            ),
            "",
        )
        for found, what in (
            (systemd, "systemd"),
            (shutil.which("unshare"), "unshare"),
            (shutil.which("nsenter"), "nsenter"),
        ):
            if not found:
                pytest.skip(f"{what} is not installed")
        self._cgroup = _cgroup2() / f"shmmap-test-{os.getpid()}"
        self._directory = Path(tempfile.mkdtemp(prefix="shmmap-systemd-", dir="/tmp"))
        self.shared = self._directory / "shared"
        self.shared.mkdir()
        (self._directory / "overlay").mkdir()
        self._log = (self._directory / "console").open("w+")
        self._process: subprocess.Popen[bytes] | None = None
        self._init = 0
        try:
            self._cgroup.mkdir()
        except OSError as error:
            self.close()
            pytest.skip(f"no cgroup can be made: {error}")
        try:
            self._boot(str(systemd))
        except BaseException:
            self.close()
            raise

    def _boot(self, systemd: str) -> None:
        script = self._directory / "prepare"
        script.write_text(PREPARE)
        enter = 'echo 0 >"$1/cgroup.procs" || exit 77; shift; exec setpriv --pdeathsig KILL "$@"'
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.bind(str(self.shared / "notify"))
            self._process = subprocess.Popen(
                [
                    "sh",
                    "-c",
                    enter,
                    "sh",
                    str(self._cgroup),
                    "unshare",
                    "--mount",
                    "--pid",
                    "--uts",
                    "--ipc",
                    "--net",
                    "--cgroup",
                    "--fork",
                    "--kill-child",
                    "--propagation",
                    "private",
                    "sh",
                    str(script),
                    str(self._directory),
                    *needed_directories(),
                ],
                env={"PATH": os.environ["PATH"], "SYSTEMD": systemd},
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                start_new_session=True,
            )
            pidfd = os.pidfd_open(self._process.pid)
            try:
                self._wait_until_booted(notify, pidfd)
            finally:
                os.close(pidfd)
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        self._init = int(children.split()[0])

    def _wait_until_booted(self, notify: socket.socket, pidfd: int) -> None:
        assert self._process is not None
        end_s = time.monotonic() + BOOT_S
        while True:
            ready = wait_readable([notify.fileno(), pidfd], max(0.0, end_s - time.monotonic()))
            if notify.fileno() in ready:
                if b"READY=1" in notify.recv(4096).splitlines():
                    return
            elif ready:
                code = self._process.wait()
                if code == CANNOT:
                    pytest.skip(f"no systemd can be booted here: {self.console.strip()}")
                raise AssertionError(f"systemd ended with {code}:\n{self.console}")
            else:
                raise AssertionError(f"systemd has not booted within {BOOT_S} s:\n{self.console}")

    @property
    def console(self) -> str:
        """What was written on its console."""
        return (self._directory / "console").read_text(errors="replace")

    def spawn(self, *command: str, user: str = "") -> subprocess.Popen[str]:
        """Start a command inside, as root or as another account with all its groups."""
        become = ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups"] if user else []
        return subprocess.Popen(
            [
                "nsenter",
                f"--target={self._init}",
                "--mount",
                "--pid",
                "--uts",
                "--ipc",
                "--net",
                "--cgroup",
                "--",
                *become,
                *command,
            ],
            env={
                "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
                "PYTHONPATH": os.pathsep.join([str(ROOT), *(path for path in sys.path if path)]),
                "PYTHONDONTWRITEBYTECODE": "1",
                "SYSTEMD_PAGER": "",
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *command: str, user: str = "", check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command inside to its end."""
        with self.spawn(*command, user=user) as process:
            try:
                out, err = process.communicate(timeout=COMMAND_S)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
        done = subprocess.CompletedProcess(command, process.returncode, out, err)
        assert not check or done.returncode == 0, f"{' '.join(command)}: {done}\n{self.journal()}"
        return done

    def shell(self, script: str, *, check: bool = True) -> str:
        """Run lines of shell as root; returns what they print."""
        return self.run("sh", "-euc", script, check=check).stdout

    def properties(self, unit: str) -> dict[str, str]:
        """What ``systemctl show`` prints about a unit."""
        lines = self.run("systemctl", "show", unit).stdout.splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def journal(self) -> str:
        """The end of the journal, for messages of failed tests."""
        with self.spawn("journalctl", "--no-pager", "-n", "80") as process:
            return process.communicate(timeout=COMMAND_S)[0]

    def close(self) -> None:
        """Kill everything inside; mounts end with their namespace, and the cgroups go."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._log.close()
        if self._cgroup.exists():
            self._empty_cgroup()
            for path, _, _ in os.walk(self._cgroup, topdown=False):
                os.rmdir(path)
        shutil.rmtree(self._directory)

    def _empty_cgroup(self) -> None:
        for _ in range(3):  # one that was forked meanwhile
            pids = [
                int(line)
                for path, _, _ in os.walk(self._cgroup)
                for line in Path(path, "cgroup.procs").read_text().splitlines()
            ]
            for pid in filter(None, pids):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            for pid in filter(None, pids):
                wait_ended(pid, 30)
        with (self._cgroup / "cgroup.events").open() as events:
            poller = select.poll()
            poller.register(events, select.POLLPRI)
            end_s = time.monotonic() + 60
            while "populated 1" in events.read():
                assert time.monotonic() < end_s, f"processes are left in {self._cgroup}"
                poller.poll(1000)
                events.seek(0)
