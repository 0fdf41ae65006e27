# SPDX-License-Identifier: Apache-2.0
"""One TOML file of settings, and the line on which each of them is set."""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from shmmap.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["SYSTEM_CONFIG_FILE", "Setting", "installed_config_file", "read_settings_file"]

SYSTEM_CONFIG_FILE: Final = "/etc/shmmap/shmmap.toml"
MAX_BYTES: Final = 1 << 20
_KEY: Final = re.compile(r"""\s*(?:"([^"]+)"|'([^']+)'|([A-Za-z0-9_-]+))\s*[.=]|\s*\[+\s*([A-Za-z0-9_-]+)""")


class Setting(NamedTuple):
    """A setting's value and where it comes from: ``FILE:LINE``, a variable, the flags, the default."""

    value: Any
    origin: str


def installed_config_file(environ: Mapping[str, str] = os.environ) -> str:
    """Return the file that the installed units read: the user's own, else the system's; or empty."""
    own = environ.get("XDG_CONFIG_HOME", "") or os.path.join(environ.get("HOME", "/"), ".config")
    places = [f"{own}/shmmap/shmmap.toml", SYSTEM_CONFIG_FILE]
    return next((place for place in places if os.path.exists(place)), "")


def read_settings_file(path: str) -> dict[str, Setting]:
    """Read the settings of a file.

    Raises
    ------
    ConfigError
        It cannot be read, or is no TOML.
    """
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:
            why = "not a regular file" if not stat.S_ISREG(status.st_mode) else "too large for settings"
            raise ConfigError(f"{path}: {why}", origin=path, hint="`shmmap config init FILE` writes one")
        text = Path(path).read_text(encoding="utf-8")
        settings: dict[str, Any] = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{path}: it is nested too deeply", origin=path) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}", origin=path, hint="`shmmap config init FILE` writes one"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}", origin=path) from error
    lines = _lines(text)
    return {
        name: Setting(value, f"{path}:{lines[name]}" if name in lines else path)
        for name, value in settings.items()
    }


def _lines(text: str) -> dict[str, int]:
    """First line of each key at the top level.

    A line inside a string of several lines may look like one, but what comes before it is no TOML.
    """
    found: dict[str, int] = {}
    lines = text.splitlines(keepends=True)
    for number, line in enumerate(lines, start=1):
        match = _KEY.match(line)
        name = next(filter(None, match.groups()), "") if match else ""
        if name and name not in found and _is_toml("".join(lines[: number - 1])):
            found[name] = number
    return found


def _is_toml(text: str) -> bool:
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return True
