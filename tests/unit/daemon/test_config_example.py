# SPDX-License-Identifier: Apache-2.0
"""The example of a configuration names every setting there is, with its default, and no other."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from shmmap.daemon.config import FILE_NAMES, DaemonConfig, load_config
from tests.support.daemon_process import ROOT

EXAMPLE = ROOT / "systemd" / "shmmap.toml"
ASSIGNMENT = re.compile(r"#?([a-z_]+) = (.+)")
SET_FOR_THE_SERVICE = {"map_path", "group"}
ATTRIBUTES = {called: name for name, called in FILE_NAMES.items()}


def assignments() -> dict[str, str]:
    """Each assignment of the example, those in comments too, by the setting's name."""
    found = {}
    for line in EXAMPLE.read_text(encoding="utf-8").splitlines():
        if match := ASSIGNMENT.fullmatch(line):
            found[ATTRIBUTES.get(match[1], match[1])] = line
    return found


def test_every_setting_is_explained() -> None:
    """A new setting of `DaemonConfig` needs its lines in systemd/shmmap.toml."""
    assert sorted(assignments()) == sorted(field.name for field in fields(DaemonConfig))


@pytest.mark.parametrize("name", sorted(assignments()))
def test_what_is_commented_out_is_the_default(name: str, tmp_path: Path) -> None:
    line = assignments()[name]
    assert line.startswith("#") == (name not in SET_FOR_THE_SERVICE)
    if name not in SET_FOR_THE_SERVICE:
        file = tmp_path / "one.toml"
        file.write_text(line.removeprefix("#"))
        assert getattr(load_config({}, file=str(file), environ={}), name) == getattr(DaemonConfig(), name)


def test_every_setting_has_words_above_it() -> None:
    lines = EXAMPLE.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines):
        if ASSIGNMENT.fullmatch(line):
            assert lines[number - 1].startswith("# "), line


def test_it_can_be_used_as_it_stands() -> None:
    config = load_config({}, file=str(EXAMPLE), environ={})
    assert (config.map_path, config.group) == ("/var/lib/shmmap/maps", "shmmap")
