# SPDX-License-Identifier: Apache-2.0
"""``shmmap unit``: run the daemon as a systemd service."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_verb
from shmmap.cli.screens.output import print_line
from shmmap.errors import BadRequest, ConfigError

if TYPE_CHECKING:
    from shmmap.service.installation import PlannedFile

_INSTALL = """\
Writes units, the account `shmmap`, directories and /etc/shmmap/shmmap.toml, and starts nothing.  Units
are replaced (changes belong in drop-ins: `systemctl edit shmmapd`), a configuration that is there is kept.
The units start the very installation that wrote them.  To install the program where the service can read
it, as root in shmmap's checkout:
  python3 -m venv /opt/shmmap && /opt/shmmap/bin/pip install .
  /opt/shmmap/bin/shmmap unit install --map DIR
--huge-pages writes a mount unit for /run/shmmap_huge, of at most half of the machine's memory, and drop-ins
that let the daemon use it; a later install keeps them.  To undo it, remove run-shmmap_huge.mount and both
30-huge-pages.conf.
For the URL of a published map a drop-in lets the service reach the network.  Credentials that are in
/etc/shmmap, files shmmap.aws, shmmap.google and shmmap.azure of root alone, are passed to it.  --trust copies
the root of trust to ROOT.json beside the settings, which name it there.
With --root the units start the program that the image has in /opt/shmmap (or /usr/local, /usr), and the
map is the one that has its path there; what lies outside of the image is refused.
Exit code: 0, 66 no map there, 73 a file cannot be written, 78 the service could not read this program."""

_PRINT = """\
FILE is a unit as it would be installed, or another file that comes with this package, such as
drop-ins/maps-in-home.conf, system/run-shmmap_huge.mount or README.md (the operator's guide)."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``unit``."""
    parser = add_verb(
        subparsers,
        "unit",
        run_print,
        help="install or print the systemd units",
        description="Run the daemon as a systemd service, of the machine or of a user.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    install = add_verb(
        actions,
        "install",
        run_install,
        help="install the service",
        description="Install this daemon as a service.",
        epilog=_INSTALL,
    )
    install.add_argument("--map", metavar="MAP", default="", help="the map to serve: a path or a URL")
    install.add_argument(
        "--trust", metavar="ROOT.json", default="", help="of a signed map: take only what is signed under it"
    )
    install.add_argument(
        "--huge-pages",
        action="store_true",
        help="keep segments on a file system of huge pages: cells load faster, on Linux 6.14 and later",
    )
    install.add_argument("--dry-run", action="store_true", help="only say what would be written")
    install.add_argument(
        "--root", metavar="DIR", default="/", help="install into the file system of an image, below DIR"
    )
    show = add_verb(
        actions,
        "print",
        run_print,
        help="print a unit",
        description="Print a unit, or another file that belongs to the service.",
        epilog=_PRINT,
    )
    show.add_argument("name", metavar="FILE", nargs="?", default="", help="default: shmmapd.service")
    show.add_argument("--list", action="store_true", help="list what there is to print")
    for one in (install, show):
        one.add_argument("--user", action="store_true", help="for this user alone, without root")


def run_print(args: argparse.Namespace) -> int:
    """Print a systemd unit."""
    from shmmap.service.installation import shipped_names, unit_text

    if args.list:
        for shipped in shipped_names():
            print_line(shipped)
        return 0
    name = args.name or "shmmapd.service"
    if "/" not in name and name not in shipped_names():
        name = f"{'user' if args.user else 'system'}/{name}"
    sys.stdout.write(unit_text(name))
    return 0


def run_install(args: argparse.Namespace) -> int:
    """Write the files of a systemd service."""
    from shmmap.service.huge_pages import check_possible
    from shmmap.service.installation import plan_system, plan_user, write

    if args.huge_pages and (args.user or args.root == "/"):
        check_possible(user=args.user)
    if args.trust and not args.map:
        raise BadRequest("--trust goes with --map URL")
    planned = (
        plan_user(args.map, trust=args.trust)
        if args.user
        else plan_system(args.map, args.root, huge_pages=args.huge_pages, trust=args.trust)
    )
    width = max(len(one.action) for one in planned)
    for one in planned:
        print_line(f"{one.action.ljust(width)}  {one.path}")
    if args.map and planned[-1].action == "kept":
        print_line(
            f"note: {planned[-1].path} is kept: set map_path{' and trust' if args.trust else ''} there"
        )
    if args.dry_run:
        return 0
    write(planned)
    if (args.user or args.root == "/") and os.path.isdir("/run/systemd/system"):
        _let_systemd_know(args.user, planned)
    running = _running(args.user) if args.user or args.root == "/" else []
    if running and not args.huge_pages:  # an upgrade: `enable --now` would do nothing
        print_line(f"next: systemctl {'--user ' if args.user else ''}restart {' '.join(running)}")
    elif args.user:
        print_line("next: systemctl --user enable --now shmmapd && loginctl enable-linger")
    elif args.root == "/":
        if args.huge_pages:
            print_line(
                "next: if it runs, systemctl stop shmmapd: a restart would leave its cells in /dev/shm"
            )
        print_line(
            "next: systemctl enable --now shmmapd; usermod -aG shmmap USER for each user who may connect"
        )
    else:
        print_line(
            f"next: systemctl --root={args.root} enable shmmapd; account and directories are made at boot"
        )
    return 0


def _running(user: bool) -> list[str]:
    """Return the services of this package that run now; none without systemd."""
    import subprocess

    if not os.path.isdir("/run/systemd/system"):
        return []
    command = ["systemctl", *(["--user"] if user else []), "list-units", "--plain", "--no-legend"]
    command += ["--state=active,activating", "shmmapd*.service", "shmmap-*.service"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return sorted({line.split()[0].removesuffix(".service") for line in done.stdout.splitlines() if line})


def _let_systemd_know(user: bool, planned: Sequence[PlannedFile]) -> None:
    """Create the account and the directories, and reload systemd's units."""
    import subprocess

    commands = [["systemctl", "--user", "daemon-reload"]]
    if not user:
        of_directory = {one.path.parent.name: str(one.path) for one in planned}
        commands = [
            ["systemd-sysusers", of_directory["sysusers.d"]],
            ["systemd-tmpfiles", "--create", of_directory["tmpfiles.d"]],
            ["systemctl", "daemon-reload"],
        ]
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ConfigError(f"`{' '.join(command)}` failed: {done.stderr.strip()}")
