# SPDX-License-Identifier: Apache-2.0
"""What an operator types as root: the blocks of the pages, as they stand, on a booted machine.

It has no network: ``pip install`` of the checkout is that of a wheel which is made of it here.
"""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Iterator

import pytest

from tests.support.booted_service import make_environment, make_wheel, pip_install
from tests.support.booted_systemd import BootedSystemd
from tests.support.daemon_process import ROOT
from tests.support.pages import read_page
from tests.support.web_servers import needed_nginx
from tests.systemd.conftest import MAP, RUN

pytestmark = pytest.mark.root

GUIDE = read_page("systemd/README.md")
GATEWAY = read_page("shmmap/publishing/GATEWAY.md")
MEMORY = read_page("shmmap/daemon/MEMORY.md")
PLACE, TOWN = "/opt/shmmap", "/var/lib/shmmap/maps/town"
PIP = f"sudo {PLACE}/bin/pip install -q"
SUDO = """#!/bin/sh
[ "$1" != -u ] || { user=$2; shift 2; exec setpriv --reuid="$user" --regid="$user" --init-groups "$@"; }
exec "$@"
"""


@pytest.fixture
def operator(fresh: BootedSystemd) -> Iterator[BootedSystemd]:
    """A machine with ``/opt/shmmap``, a map, and a ``sudo`` for root; no unit is installed yet."""
    fresh.shell(f"""
        rm -rf /etc/shmmap /etc/systemd/system/shmmapd*; systemctl daemon-reload
        mkdir -p {TOWN}; cp -r {MAP}/. {TOWN}; chmod -R a+rX {TOWN}
        ln -sf {PLACE}/bin/shmmap /usr/local/bin/shmmap
        printf '%s' {shlex.quote(SUDO)} >/usr/local/bin/sudo; chmod 755 /usr/local/bin/sudo
    """)
    built = make_wheel(fresh.shared, "0.90.0")
    make_environment(fresh, PLACE)
    pip_install(fresh, built, PLACE)
    yield fresh
    fresh.shell(f"systemctl disable --now shmmapd || true; rm -rf {PLACE} /var/lib/shmmap/maps")


def typed(
    machine: BootedSystemd, *commands: str, user: str = "", home: str = "/root", needs: str = ""
) -> str:
    """Type commands in a terminal of root's, or of another account's; return what they print.

    Where they fail and say that the kernel lacks what they need, the test is skipped.
    """
    script = "\n".join(["unset PYTHONPATH", f"export HOME={home} PATH=/usr/local/bin:$PATH", *commands])
    done = machine.run("sh", "-euc", f"{script}\n", user=user, check=not needs)
    if done.returncode and needs in done.stderr:
        pytest.skip(f"this kernel has no huge pages for tmpfs: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return done.stdout


def first_line(machine: BootedSystemd, command: str) -> str:
    """Return the first line of what prints without end; it is interrupted then."""
    process = machine.spawn("sh", "-euc", f"unset PYTHONPATH; PATH=/usr/local/bin:$PATH; exec {command}")
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        machine.shell(f"pkill -INT -f {shlex.quote(command)}", check=False)
        process.communicate(timeout=60)
        return line
    except subprocess.TimeoutExpired:
        process.kill()
        raise


def test_the_service_from_its_install_to_its_upgrade(operator: BootedSystemd) -> None:
    install, *start = GUIDE.commands("service")
    assert "next: systemctl enable --now shmmapd" in typed(operator, install)
    typed(operator, *start)
    assert "0_0.pcd" in typed(operator, "shmmap query --circle 0,0,25", user="alice", home="/home/alice")

    without_end = ("shmmap tail", "journalctl -u shmmapd -f")
    printed = {}
    for line in GUIDE.commands("run"):
        command = line.partition("#")[0].strip()
        printed[command] = (
            first_line(operator, command) if command in without_end else typed(operator, command)
        )
    assert " cells, " in printed["systemctl status shmmapd"]
    assert "healthy" in printed["shmmap status"]
    assert "no client is connected" in printed["shmmap top"]
    assert all(printed[command].strip() for command in ("shmmap doctor", *without_end))
    assert operator.properties("shmmapd")["ActiveState"] == "inactive"
    assert operator.shell("ls /dev/shm") == ""

    assert "built   36\n" in typed(operator, *GUIDE.commands("prepare"))
    assert operator.shell("find /var/cache/shmmap -user shmmap -name '*.segment' -o -type f | head -n 1")

    pull, pip, *restart = GUIDE.commands("upgrade")
    assert (pull, pip) == ("git pull", f"{PIP} .")
    typed(
        operator,
        "cd; git init -q --bare published.git; git clone -q published.git checkout 2>&1; cd checkout",
        "git -c user.name=x -c user.email=x@localhost commit -q --allow-empty -m one; git push -q",
        pull,
    )
    typed(operator, "systemctl start shmmapd")
    pip_install(operator, make_wheel(operator.shared, "0.91.0"), PLACE)
    assert "next: systemctl restart shmmapd" in typed(operator, *restart)
    assert '"version": "0.91.0"' in typed(operator, "shmmap status --json").replace('":"', '": "')


def test_segments_on_huge_pages_as_the_page_says(operator: BootedSystemd) -> None:
    typed(operator, *GUIDE.commands("service"))
    install, *again = GUIDE.commands("huge-pages")
    typed(operator, install, needs="no huge pages")
    try:
        typed(operator, *again)
        assert "/run/shmmap_huge" in typed(operator, "shmmap status")
    finally:
        operator.shell("""
            systemctl stop shmmapd run-shmmap_huge.mount
            rm -f /etc/systemd/system/run-shmmap_huge.mount /etc/systemd/system/*/30-huge-pages.conf
            rmdir /run/shmmap_huge
        """)


def test_a_map_in_a_bucket_has_its_credentials_from_a_file(operator: BootedSystemd) -> None:
    """The packages are those of the extra, as another test compares; without a network it is not started."""
    packages, *commands = GUIDE.commands("bucket")
    assert packages == f"{PIP} {read_page('shmmap/publishing/PUBLISHING.md').commands('install')[0][15:]}"
    typed(operator, "mkdir ~/.aws; printf '[default]\\naws_access_key_id = a\\n' >~/.aws/credentials")
    typed(operator, *commands)
    assert operator.shell("stat -c '%a %U' /etc/shmmap/shmmap.aws") == "600 root\n"
    assert '\nmap_path = "s3://maps/town"\n' in operator.shell("cat /etc/shmmap/shmmap.toml")
    shown = operator.shell("systemctl daemon-reload; systemctl cat shmmapd")
    assert "shmmap.aws" in shown


def test_a_developer_s_own_service(operator: BootedSystemd) -> None:
    """All but the last line: there is no session manager, which needs a real login."""
    *commands, last = GUIDE.commands("user")
    assert last == "loginctl enable-linger"
    operator.run("systemctl", "start", "user@61003.service")
    alice = {"user": "alice", "home": "/home/alice"}
    typed(operator, f"export XDG_RUNTIME_DIR={RUN}", *commands, **alice)
    asked = typed(operator, f"export XDG_RUNTIME_DIR={RUN}", "shmmap query --circle 0,0,25", **alice)
    assert "0_0.pcd" in asked
    typed(operator, f"export XDG_RUNTIME_DIR={RUN}", "systemctl --user disable --now shmmapd", **alice)


def options_of_shm(machine: BootedSystemd) -> list[str]:
    """Return the options that ``/dev/shm`` is mounted with."""
    return machine.shell("grep ' /dev/shm ' /proc/mounts").split()[3].split(",")


def test_dev_shm_is_mounted_again(operator: BootedSystemd) -> None:
    try:
        typed(operator, *MEMORY.commands("larger"))
        assert "size=8388608k" in options_of_shm(operator)
        typed(operator, *MEMORY.commands("huge"), needs="mount: /dev/shm: ")
        assert "huge=within_size" in options_of_shm(operator)
    finally:
        operator.shell("mount -o remount,huge=never,size=50% /dev/shm || mount -o remount,size=50% /dev/shm")


def test_a_gateway_is_started(operator: BootedSystemd) -> None:
    """Without a network its server's name has no address: it is replaced, as the page says one does."""
    needed_nginx()
    packages, directory, copy, check, restart = GATEWAY.commands("start")
    if "nginx-light" not in operator.shell("dpkg-query -W -f '${Package} ' 'nginx*' || true"):
        pytest.skip("nginx-light is not installed")
    replaced = "sed -i 's|https://maps.example.org|http://127.0.0.1:9|' /etc/nginx/nginx.conf"
    typed(operator, packages, directory, f"cd {ROOT}", copy, replaced, f"{check} 2>&1", restart)
    try:
        assert operator.properties("nginx")["ActiveState"] == "active"
        assert operator.shell("stat -c %U /var/cache/shmmap-gateway") == "www-data\n"
    finally:
        operator.shell("systemctl stop nginx")
