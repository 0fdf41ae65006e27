# SPDX-License-Identifier: Apache-2.0
"""Settings of live maps: flags and tables together, and what is said of a wrong one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from shmmap.daemon.config_live import LiveSettings, live_directory, live_settings
from shmmap.errors import ConfigError

FILE = "/etc/shmmap.toml"


def test_a_flag_names_a_map_and_its_directory() -> None:
    assert live_settings(["lidar"], {}) == (LiveSettings("lidar"),)
    assert live_settings(["lidar=/srv/map"], {}) == (LiveSettings("lidar", "/srv/map"),)
    assert live_settings(["lidar="], {}) == (LiveSettings("lidar"),)
    assert live_settings(["a=b=c"], {})[0].path == os.path.abspath("b=c")


def test_a_flag_s_map_has_the_settings_of_its_table() -> None:
    tables = {"lidar": {"resolution": 1, "path": "/srv/old", "radius": 2}, "radar": {"hit": 0.8}}
    lidar, radar, third = live_settings(["lidar=/srv/new", "third"], tables, FILE)
    assert lidar == LiveSettings("lidar", "/srv/new", resolution=1.0, radius=2)
    assert isinstance(lidar.resolution, float)
    assert radar.occupancy.hit == 0.8
    assert third == LiveSettings("third")
    assert live_settings(["lidar"], tables)[0].path == "/srv/old"


@pytest.mark.parametrize("name", ["", "a b", "a.b", "a/b", "..", "ä", "x" * 65, "a\n"])
def test_a_name_that_cannot_be(name: str) -> None:
    for flags, tables in (([name], {}), ([], {name: {}})):
        with pytest.raises(ConfigError, match="cannot be called") as failure:
            live_settings(flags, tables, FILE)
        assert "64 letters" in failure.value.hint


@pytest.mark.parametrize(
    ("table", "said", "hint"),
    [
        ({"resolutoin": 0.1}, "live.lidar.resolutoin: unknown setting", "did you mean 'resolution'"),
        ({"name": "x"}, "live.lidar.name: unknown setting", "settings are: path, resolution"),
        ({"resolution": 0}, "live.lidar.resolution cannot be 0.0", "0.0001 to 1000.0 metres"),
        ({"resolution": float("nan")}, "resolution cannot be nan", "metres"),
        ({"resolution": 10**400}, "resolution cannot be", "metres"),
        ({"resolution": "0.1"}, "must be a number, not '0.1'", "default is 0.05"),
        ({"resolution": True}, "must be a number, not True", "default is 0.05"),
        ({"radius": 17}, "radius cannot be 17", "0 to 16 chunks"),
        ({"radius": 1.0}, "must be a whole number, not 1.0", "default is 1"),
        ({"radius": True}, "must be a whole number, not True", "default is 1"),
        ({"hysteresis": 1.1}, "hysteresis cannot be 1.1", "part of a chunk"),
        ({"linger_s": -1}, "linger_s cannot be -1.0", "seconds"),
        ({"checkpoint_s": float("inf")}, "checkpoint_s cannot be inf", "0.1 to 3600.0 seconds"),
        ({"most_active": -1}, "most_active cannot be -1", "as many as fit"),
        ({"most_active": 10**400}, "most_active cannot be", "as many as fit"),
        ({"frame_id": ""}, "frame_id cannot be ''", "1 to 40 bytes"),
        ({"frame_id": "ä" * 21}, "frame_id cannot be", "1 to 40 bytes"),
        ({"path": "state/lidar"}, "path cannot be 'state/lidar'", "the whole path"),
        ({"path": 3}, "path must be text, not 3", "in quotes"),
        ({"hit": 0.4}, "live.lidar.hit: hit = 0.4", ""),
        ({"clamp_min": 0.0}, "live.lidar.clamp_min: clamp_min = 0.0: need a probability", ""),
    ],
)
def test_what_is_wrong_is_reported_with_its_place(table: dict[str, Any], said: str, hint: str) -> None:
    with pytest.raises(ConfigError) as failure:
        live_settings([], {"lidar": table}, FILE)
    assert said in failure.value.message
    assert failure.value.message.startswith(f"{FILE}: live")
    assert failure.value.origin == FILE
    assert hint in failure.value.hint
    assert failure.value.hint or "need" in failure.value.message


@pytest.mark.parametrize("tables", [{"lidar": 3}, {"lidar": [{}]}, 7, ["lidar"]])
def test_what_is_no_table(tables: Any) -> None:
    with pytest.raises(ConfigError, match="live must be tables") as failure:
        live_settings([], tables, FILE)
    assert "[live.NAME]" in failure.value.hint


def test_two_maps_in_one_directory(tmp_path: Path) -> None:
    (tmp_path / "same").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="live maps a and b are both in") as failure:
        live_settings([f"a={tmp_path}", f"b={tmp_path}/same"], {})
    assert "a directory of its own" in failure.value.hint


@pytest.mark.parametrize(
    ("environ", "path"),
    [
        ({"STATE_DIRECTORY": "/var/lib/shmmap:/var/lib/b", "HOME": "/h"}, "/var/lib/shmmap/live/lidar"),
        ({"XDG_STATE_HOME": "/s", "HOME": "/h"}, "/s/shmmap/city/live/lidar"),
        ({"XDG_STATE_HOME": "s", "HOME": "/h"}, "/h/.local/state/shmmap/city/live/lidar"),
        ({"HOME": "/h"}, "/h/.local/state/shmmap/city/live/lidar"),
    ],
)
def test_where_a_map_is_kept(environ: dict[str, str], path: str) -> None:
    assert live_directory("city", "lidar", environ) == path


def test_where_nothing_says_where() -> None:
    with pytest.raises(ConfigError, match="no state directory for live map lidar") as failure:
        live_directory("city", "lidar", {"HOME": ""})
    assert failure.value.hint == "name one: --live lidar=DIR"
