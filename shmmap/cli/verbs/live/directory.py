# SPDX-License-Identifier: Apache-2.0
"""Which live map is meant: the directory that has its files, or its name."""

from __future__ import annotations

import argparse
import contextlib
import os

from shmmap.errors import ConfigError

__all__ = ["add_directory", "directory_from"]


def add_directory(parser: argparse.ArgumentParser) -> None:
    """Add ``DIR``."""
    parser.add_argument(
        "directory", metavar="DIR", help="the directory of the live map, or its name in the daemon's settings"
    )


def directory_from(args: argparse.Namespace) -> str:
    """Return its path: what is no directory may be the name of a map that has one."""
    given: str = args.directory
    if os.path.isdir(given) or os.sep in given:
        return os.path.abspath(given)
    return next(filter(os.path.isdir, _places(given)), os.path.abspath(given))


def _places(name: str) -> list[str]:
    """Where a live map of a name may have its files, as settings and custom say."""
    from shmmap.daemon.config import installed_config_file, load_config
    from shmmap.daemon.config_live import SERVICE_STATE, live_directory

    config = load_config({}, file=installed_config_file())
    places = [one.path for one in config.live if one.name == name and one.path]
    with contextlib.suppress(ConfigError):  # no home, no state of its own
        places.append(live_directory(config.instance, name))
    return [*places, f"{SERVICE_STATE}/{config.instance}/live/{name}"]
