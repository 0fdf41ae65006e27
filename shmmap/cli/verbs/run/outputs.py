# SPDX-License-Identifier: Apache-2.0
"""JSON output of the verbs that run a daemon; imported only for ``--json``."""

from __future__ import annotations

from typing import Any

import msgspec

from shmmap.cli.json_output import more_of


class Setting(msgspec.Struct):
    """A setting, and its source: FILE:LINE, a variable, or ``default``."""

    value: Any
    origin: str


class Settings(msgspec.Struct):
    """All settings; sizes have two names, such as budget (text, as in the file) and budget_bytes."""

    file: str | None
    settings: dict[str, Setting]


class Checked(msgspec.Struct):
    """A configuration file without mistakes."""

    file: str | None
    good: bool


def versions_kind() -> object:
    """Return the struct that ``version --json`` prints."""
    from shmmap.cli.verbs.run.about import Versions

    return more_of(Versions)
