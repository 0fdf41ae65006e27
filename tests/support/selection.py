# SPDX-License-Identifier: Apache-2.0
"""Hooks that leave out slow tests, unless ``--all``, ``--slow`` or what the command line names asks for them.

Slow is what lies in a folder named ``slow``, ``cpp`` or ``systemd``, at any depth, and is then not even
imported; and a test, or a parameter, marked ``slow`` among quick ones.  ``-m`` is left to the caller.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

SLOW: Final = frozenset({"slow", "cpp", "systemd"})


def pytest_addoption(parser: pytest.Parser) -> None:
    """Offer ``--all`` and ``--slow``."""
    group = parser.getgroup("shmmap")
    for option, text in (("all", "all tests, also the slow ones"), ("slow", "only the slow tests")):
        group.addoption(
            f"--{option}", action="store_const", const=option, dest="selection", default="quick", help=text
        )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files and folders."""
    folder, selection = _slow_folder(collection_path, config), config.option.selection
    if selection == "slow" and folder is None and collection_path.name.startswith("test_"):
        left_out = "mark.slow" not in collection_path.read_text(encoding="utf-8")
    else:
        named = (Path(config.invocation_params.dir, one.split("::")[0]).resolve() for one in config.args)
        asked = (
            selection != "quick" or folder is None or folder in (_slow_folder(one, config) for one in named)
        )
        left_out = not asked
    return True if left_out else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests of the files that are collected, except for those that the command line names."""
    selection, named = config.option.selection, tuple(one for one in config.args if "::" in one)
    chosen, left_out = list[pytest.Item](), list[pytest.Item]()
    for item in items:
        marked = item.get_closest_marker("slow") is not None
        if selection == "slow":
            fits = marked or _slow_folder(item.path, config) is not None
        else:
            fits = not marked or selection == "all" or item.nodeid.startswith(named)
        (chosen if fits else left_out).append(item)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = chosen


def _slow_folder(path: Path, config: pytest.Config) -> Path | None:
    """Return the outermost folder of slow tests that a path is, or lies in."""
    if config.rootpath not in path.parents:
        return None
    parts = path.relative_to(config.rootpath).parts
    return next(
        (config.rootpath.joinpath(*parts[:n]) for n, part in enumerate(parts, 1) if part in SLOW), None
    )
