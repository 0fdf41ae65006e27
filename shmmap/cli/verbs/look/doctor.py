# SPDX-License-Identifier: Apache-2.0
"""``shmmap doctor``: find problems of the daemon and its clients, and suggest fixes."""

from __future__ import annotations

import argparse
import contextlib

from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.output import print_hanging, print_json
from shmmap.doctor.verdicts import Finding
from shmmap.errors import NoSocket

__all__ = ["add_parser", "run"]

_EXIT = """\
Exit code: 0 no finding is `fail`, 1 one is, 78 the configuration has a mistake."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "doctor",
        run,
        help="find problems and suggest fixes",
        description="Check the daemon, its socket and group, the map, shared memory and its limits, live "
        "maps, where a published map comes from, the bridge to ROS, and what was left behind.  Changes "
        "nothing.  Run it as the user whose program has a problem.",
        output="look.outputs.Diagnosis",
        epilog=_EXIT,
    )
    parser.add_argument(
        "--config",
        metavar="FILE",
        default="",
        help="the daemon's settings (default: the installed service's)",
    )
    add_statistics_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print every finding."""
    from shmmap.cli import daemon_address
    from shmmap.daemon.config import installed_config_file, load_config
    from shmmap.doctor.checks import diagnose, examine
    from shmmap.doctor.verdicts import worst

    file = args.config or installed_config_file()
    flags = {"instance": args.instance, "endpoint": daemon_address.endpoint(args), "shm_dir": args.shm_dir}
    if flags["endpoint"]:
        with contextlib.suppress(NoSocket):
            flags["instance"], flags["shm_dir"] = daemon_address.locate(args)
    findings = diagnose(examine(load_config(flags, file=file), file))
    if args.json:
        from shmmap.cli.verbs.look import outputs

        print_json(outputs.Diagnosis(worst(findings), findings))
    else:
        _print(findings)
    return 1 if worst(findings) == "fail" else 0


def _print(findings: list[Finding]) -> None:
    width = max(len(one.name) for one in findings)
    for one in findings:
        state = "skip" if one.skipped else one.state
        print_hanging(f"{state.ljust(4)}  {one.name.ljust(width)}  ", one.fact)
        if one.advice:
            print_hanging(f"{' ' * (width + 6)}  -> ", one.advice)
