# SPDX-License-Identifier: Apache-2.0
"""The example of a configuration names every setting there is, with its default, and no other."""

from __future__ import annotations

import re
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from shmmap.daemon.config import FILE_NAMES, DaemonConfig, load_config
from shmmap.daemon.config_live import LiveSettings, live_settings
from tests.support.daemon_process import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

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
    assert sorted([*assignments(), "live"]) == sorted(field.name for field in fields(DaemonConfig))


def test_every_setting_of_a_live_map_is_explained_with_its_default() -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    table = text[text.index("#[live.lidar]") :].replace("#", "", 1)
    rows = {match[1]: match[2] for match in re.finditer(r"^#  ([a-z_]+) = (.+)$", table, re.MULTILINE)}
    default = LiveSettings("lidar")
    assert set(rows) == set(default.__struct_fields__) - {"name"}
    lines = [re.sub(r"^#  (?=[a-z_]+ = )", "", line) for line in table.splitlines()]
    assert live_settings((), tomllib.loads("\n".join(lines))["live"]) == (default,)


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
