# SPDX-License-Identifier: Apache-2.0
"""``shmmap config``: check settings, show where each was set, create a file with all of them."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict
from pathlib import Path

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import print_json, print_line
from shmmap.errors import BadRequest, CannotWrite, ConfigError, MapMissing

_CHECK_EXIT = """\
Exit code: 0 good, 66 no map there, 78 a mistake: the codes that the daemon would exit with."""

_EPILOG = """\
`check` and `show` read FILE, or the one that the installed service reads, and SHMMAP_* variables."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``config``."""
    parser = add_verb(
        subparsers,
        "config",
        run_show,
        help="check, show or create a configuration file",
        description="Find mistakes in the settings, show their values, or create a file that "
        "explains them all.",
        epilog=_EPILOG,
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    check = add_verb(
        actions,
        "check",
        run_check,
        help="find mistakes",
        description="Find mistakes in the settings that would keep the daemon from starting.",
        output="run.outputs.Checked",
        epilog=_CHECK_EXIT,
    )
    show = add_verb(
        actions,
        "show",
        run_show,
        help="print every setting",
        description="Print every setting, under its name in the file; where a default is chosen at start, "
        "how it is chosen.",
        output="run.outputs.Settings",
    )
    show.add_argument("--origin", action="store_true", help="say where each setting comes from")
    for one in (check, show):
        one.add_argument(
            "file", metavar="FILE", nargs="?", default="", help="TOML file (default: the installed service's)"
        )
        add_json_option(one)
    init = add_verb(
        actions,
        "init",
        run_init,
        help="create a file that explains every setting",
        description="Create a file that explains every setting.  Nothing is overwritten.",
    )
    init.add_argument("file", metavar="FILE", nargs="?", default="shmmap.toml", help="default: shmmap.toml")
    init.add_argument("--map", metavar="DIR", default="", help="the map to serve")


def run_check(args: argparse.Namespace) -> int:
    """Report settings that would keep the daemon from starting."""
    from shmmap.daemon.config import installed_config_file, load_config
    from shmmap.daemon.prerequisites import access_of_segments
    from shmmap.origin.remote.store import is_url

    file = args.file or installed_config_file()
    config = load_config({}, file=file)
    access_of_segments(config)
    if not config.map_path:
        raise ConfigError("no map is named", key="map_path", hint="set map_path, or give `shmmap serve MAP`")
    if not is_url(config.map_path) and not os.path.exists(config.map_path):
        raise MapMissing(f"there is no map at {config.map_path}", hint="map_path names it")
    if config.trust:
        from shmmap.origin.remote.verify_apart import read_trusted_root

        read_trusted_root(config.trust)
    if args.json:
        from shmmap.cli.verbs.run import outputs

        print_json(outputs.Checked(file or None, good=True))
    else:
        print_line(f"{file or 'no file'}: good")
    return 0


def run_show(args: argparse.Namespace) -> int:
    """Print every setting and its source."""
    from shmmap.daemon.config import ROWS, installed_config_file, trace_settings
    from shmmap.live_settings import LIVE_ROWS

    file = args.file or installed_config_file()
    settings = trace_settings({}, file=file)
    live = settings.pop("live")
    tables = [asdict(one) for one in live.value]
    if args.json:
        from shmmap.cli.verbs.run import outputs

        shown = {name: outputs.Setting(one.value, one.origin) for name, one in settings.items()}
        shown["live"] = outputs.Setting(tables, live.origin)
        shown |= {row.called: shown[name] for name, row in ROWS.items()}
        print_json(outputs.Settings(file or None, shown))
        return 0
    lines = {name: row.example(settings[name].value)[1] for name, row in ROWS.items()}
    width = max(map(len, lines.values()))
    for name, line in lines.items():
        remarks = [settings[name].origin] if args.origin else []
        if not settings[name].value and ROWS[name].unset:
            remarks.append(ROWS[name].unset)
        print_line(f"{line.ljust(width)}  # {': '.join(remarks)}" if remarks else line)
    for table in tables:
        print_line()
        print_line(f"[live.{table['name']}]" + (f"  # {live.origin}" if args.origin else ""))
        for name, row in LIVE_ROWS.items():
            print_line(row.example(table[name])[1])
    return 0


def run_init(args: argparse.Namespace) -> int:
    """Write a configuration file with all settings."""
    from shmmap.service.installation import configuration

    path = Path(args.file)
    text = configuration(os.path.abspath(args.map) if args.map else "", group=False)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise BadRequest(f"{path} exists", hint="name another FILE, or move it away") from None
    except OSError as error:
        raise CannotWrite(f"cannot write {path}: {error.strerror}") from error
    print_line(f"{path}: every setting, explained; `shmmap serve --config {path}` uses it")
    return 0
