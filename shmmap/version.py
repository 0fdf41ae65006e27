# SPDX-License-Identifier: Apache-2.0
"""The version of this package: the build, the daemon, its loaders and ``shmmap version`` read it here.

A release has a number of its own whenever the major version of the protocol changes.  The commit is read only
when it is asked for, and it is part of no cache's key: kernels are not compiled again for each commit.
"""

from __future__ import annotations

import os
from functools import cache

__version__ = "0.4.0"

_DIGITS = 8


@cache
def build_version() -> str:
    """Return the release, with ``+<commit>`` where the package runs from a checkout, as of the first call."""
    checkout = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    if not os.path.isfile(os.path.join(checkout, "pyproject.toml")):
        return __version__
    try:
        commit = _commit(os.path.join(checkout, ".git"))
    except (OSError, ValueError):
        return __version__
    return f"{__version__}+{commit[:_DIGITS]}" if commit else __version__


def _commit(git: str) -> str:
    """Return the commit that a repository has checked out; empty if it has none."""
    if os.path.isfile(git):  # a further work tree, or a submodule
        git = os.path.join(os.path.dirname(git), _text(git).partition("gitdir: ")[2])
    head = _text(os.path.join(git, "HEAD"))
    _, is_branch, ref = head.partition("ref: ")
    if not is_branch:
        return _checked(head)
    shared = git
    if os.path.isfile(common := os.path.join(git, "commondir")):
        shared = os.path.join(git, _text(common))
    for place in (git, shared):
        if os.path.isfile(file := os.path.join(place, ref)):
            return _checked(_text(file))
    for line in _text(os.path.join(shared, "packed-refs")).splitlines():
        commit, _, name = line.partition(" ")
        if name == ref:
            return _checked(commit)
    return ""


def _checked(commit: str) -> str:
    int(commit, 16)
    return commit


def _text(path: str) -> str:
    with open(path, encoding="utf-8") as file:
        return file.read().strip()
