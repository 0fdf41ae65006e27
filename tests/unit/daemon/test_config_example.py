# SPDX-License-Identifier: Apache-2.0
"""The example of a configuration names every setting there is, with its default, and no other."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

from shmmap.daemon.config import ROWS, DaemonConfig, load_config
from shmmap.daemon.config_live import LIVE_ROWS, LiveSettings
from shmmap.service.installation import configuration
from tests.support.daemon_process import ROOT

EXAMPLE = ROOT / "systemd" / "shmmap.toml"
OF_THE_SERVICE = DaemonConfig(map_path="/var/lib/shmmap/maps", group="shmmap")


def test_it_is_the_one_that_settings_make() -> None:
    """After a setting is changed: ``python -m tests.unit.daemon.test_config_example`` writes it again."""
    assert EXAMPLE.read_text(encoding="utf-8") == configuration()


def test_it_can_be_used_as_it_stands() -> None:
    assert load_config({}, file=str(EXAMPLE), environ={}) == OF_THE_SERVICE


def test_what_is_commented_out_are_all_settings_with_their_defaults(tmp_path: Path) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    assignment = re.compile(r"^#?(?:  )?(?=([a-z_]+) = |\[live\.lidar\]$)", re.MULTILINE)
    named = [match[1] for match in assignment.finditer(text) if match[1]]
    assert named == [*(row.called for row in ROWS.values()), *LIVE_ROWS]
    assert [*ROWS, "live"] == [one.name for one in fields(DaemonConfig)]
    assert ["name", *LIVE_ROWS] == [one.name for one in fields(LiveSettings)]
    file = tmp_path / "all.toml"
    file.write_text(assignment.sub("", text))
    expected = replace(OF_THE_SERVICE, live=(LiveSettings("lidar"),))
    assert load_config({}, file=str(file), environ={}) == expected


if __name__ == "__main__":
    EXAMPLE.write_text(configuration(), encoding="utf-8")
