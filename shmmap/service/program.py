# SPDX-License-Identifier: Apache-2.0
"""How a unit starts this installation of the daemon.

The units hide home directories and /tmp from the daemon.  An installation that lies there (a virtual
environment in a home, a Python of pyenv or uv) is made visible again, read-only and nothing else with
it.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

__all__ = ["daemon_command", "hidden_directories", "is_hidden", "outermost", "quoted"]

_HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108  ProtectHome=, PrivateTmp=


def daemon_command() -> str:
    """Return what starts the daemon of this installation, for ``ExecStart=``."""
    script = Path(sys.prefix, "bin", "shmmapd")
    command = [str(script)] if os.access(script, os.X_OK) else [sys.executable, "-m", "shmmap.daemon"]
    return " ".join(quoted(word) for word in command)


def quoted(word: str) -> str:
    """Return a word as units write it (systemd.syntax(7)): nothing in it is expanded or split."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"' if re.search(r"[\s\"']", word) else escaped


def is_hidden(path: str) -> bool:
    """Whether the units hide ``path`` from the daemon."""
    return any(path == place or path.startswith(place + "/") for place in _HIDDEN)


def outermost(paths: Iterable[str]) -> list[str]:
    """Return the paths that lie in no other of them, sorted."""
    kept: list[str] = []
    for path in sorted(set(paths)):
        if not any(path.startswith(other.rstrip("/") + "/") for other in kept):
            kept.append(path)
    return kept


def hidden_directories(search_path: Sequence[str] | None = None) -> list[str]:
    """Return the directories that this Python needs and that the units would hide.

    Parameters
    ----------
    search_path
        Where modules are found; `sys.path` by default.
    """
    interpreter = os.path.dirname(os.path.dirname(os.path.realpath(sys.executable)))
    places = [sys.prefix, sys.base_prefix, interpreter, *(sys.path if search_path is None else search_path)]
    absolute = [os.path.abspath(place) for place in places if place and os.path.isdir(place)]
    return outermost(place for place in absolute if is_hidden(place))
