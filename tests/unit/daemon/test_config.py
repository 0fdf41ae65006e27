# SPDX-License-Identifier: Apache-2.0
"""Settings: where they come from, which wins, what is said of a wrong one, and the example of a file."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.cli.entry import build_parser
from shmmap.config_table import parse_bytes
from shmmap.daemon.config import (
    DROPPED,
    RENAMED,
    ROWS,
    DaemonConfig,
    installed_config_file,
    load_config,
    option_of,
    read_settings_file,
    trace_settings,
)
from shmmap.errors import ConfigError
from shmmap.live_settings import LIVE_ROWS, LiveSettings, live_directory, live_settings
from shmmap.service.installation import configuration
from tests.support.daemon_process import ROOT

EXAMPLE = ROOT / "systemd" / "shmmap.toml"
OF_THE_SERVICE = DaemonConfig(map_path="/var/lib/shmmap/maps", group="shmmap")


def load(
    flags: dict[str, Any] | None = None, environ: dict[str, str] | None = None, file: str = ""
) -> DaemonConfig:
    return load_config(flags or {}, file=file, environ=environ or {})


# --- where they come from -----------------------------------------------------------------------------


def test_defaults() -> None:
    environ = {"SHMMAP_TEST_DATA": "/x", "SHMMAPX": "1"}  # which are no settings
    assert load() == load({"budget": None, "workers": None}) == load(environ=environ) == DaemonConfig()


def test_later_origins_win_and_each_setting_knows_its_own(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text(
        "# settings\nworkers = 2\nload_timeout_s = 5\n  'log_level' = \"debug\"\nbudget = '1G'\n"
        "instance = 'car'\nstrict = true\n"
    )
    environ = {"SHMMAP_BUDGET": "2G", "SHMMAP_STRICT": "no", "HOME": "/"}
    found = trace_settings({"instance": "bus", "group": None}, file=str(file), environ=environ)
    assert found["workers"] == (2, f"{file}:2")
    assert found["log_level"] == ("debug", f"{file}:4")
    assert found["budget_bytes"] == (2 << 30, "SHMMAP_BUDGET")
    assert found["instance"] == ("bus", "command line")
    assert found["group"] == ("", "default")
    assert set(found) == set(DaemonConfig.__dataclass_fields__)
    config = load({"instance": "bus"}, environ, str(file))
    assert (config.strict, config.load_timeout_s, type(config.load_timeout_s)) == (False, 5.0, float)


@pytest.mark.parametrize(
    ("flags", "environ", "endpoint", "instance"),
    [
        ({}, {}, "/run/city.sock", "city"),
        ({}, {"SHMMAP_INSTANCE": "town"}, "/run/city.sock", "town"),
        ({"endpoint": "ipc:///run/b.sock"}, {}, "ipc:///run/b.sock", "b"),
        ({"instance": "town"}, {}, "", "town"),
        ({"runtime_dir": "/run/mine"}, {}, "", "default"),
        ({"endpoint": "/run/no name.sock"}, {}, "/run/no name.sock", "default"),
    ],
)
def test_the_endpoint_of_clients_is_the_daemon_s(
    flags: dict[str, str], environ: dict[str, str], endpoint: str, instance: str
) -> None:
    """A program that knows the socket alone finds the statistics, as they are named after the instance."""
    config = load(flags, environ={"SHMMAP_ENDPOINT": "/run/city.sock", **environ})
    assert (config.endpoint, config.instance) == (endpoint, instance)


def test_sizes_have_one_name_in_files_variables_and_options(tmp_path: Path) -> None:
    """Not that of the attribute in the code."""
    assert load({"cache_size": "1G"}).cache_bytes == 1 << 30
    assert load(environ={"SHMMAP_CACHE_SIZE": "2G", "SHMMAP_BUDGET": "1M"}).cache_bytes == 2 << 30
    file = tmp_path / "shmmap.toml"
    for word in ("budget_bytes", "cache_bytes"):
        file.write_text(f"{word} = '1G'\n")
        with pytest.raises(ConfigError, match=word):
            load(file=str(file))
        with pytest.raises(ConfigError, match=word):
            load(environ={f"SHMMAP_{word.upper()}": "1G"})


def test_which_file_is_installed(tmp_path: Path) -> None:
    own = tmp_path / "shmmap" / "shmmap.toml"
    environ = {"XDG_CONFIG_HOME": str(tmp_path), "HOME": "/nowhere"}
    assert installed_config_file(environ) in ("", "/etc/shmmap/shmmap.toml")
    own.parent.mkdir()
    own.touch()
    assert installed_config_file(environ) == str(own)
    (tmp_path / ".config").symlink_to(tmp_path)
    assert installed_config_file({"HOME": str(tmp_path)}) == f"{tmp_path}/.config/shmmap/shmmap.toml"


def test_the_command_line_has_the_options_that_errors_name() -> None:
    (verbs,) = (one for one in build_parser()._actions if isinstance(one, argparse._SubParsersAction))
    actions = {action.dest: action for action in verbs.choices["serve"]._actions}
    assert set(actions) == {
        *(field.name for field in fields(DaemonConfig)),
        "config",
        "help",
        *DROPPED,
        *RENAMED,
    }
    for name in ROWS:
        assert option_of(name) in (*actions[name].option_strings, actions[name].metavar)
        assert actions[name].default is None, "the configuration file may say"


# --- values -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "nbytes"),
    [
        ("0", 0), ("1", 1), ("1000000", 1_000_000), ("1k", 1024), ("1K", 1024), ("2M", 2 << 20),
        ("2MB", 2 << 20), ("2MiB", 2 << 20), ("1.5g", 3 << 29), (" 3 T ", 3 << 40),
        ("4gib", 4 << 30), ("7B", 7),
    ],
)  # fmt: skip
def test_sizes(text: str, nbytes: int) -> None:
    assert parse_bytes(text) == nbytes


@pytest.mark.parametrize(
    "text",
    ["", "M", "-1", "1e9", "1 000", "12Q", "0x10", "1.M", ".5G", "nan", "inf", "9" * 400, "9" * 30 + "T"],
)
def test_no_sizes(text: str) -> None:
    with pytest.raises(ConfigError, match="is no size"):
        parse_bytes(text)


@given(st.text(max_size=20))
def test_any_text_is_a_size_or_refused(text: str) -> None:
    with contextlib.suppress(ConfigError):
        assert 0 <= parse_bytes(text) <= 1 << 62


@pytest.mark.parametrize(("quota", "value"), [("0.5", 0.5), ("1", 1.0), ("64M", float(64 << 20)), (1, 1.0)])
def test_quotas_are_parts_or_bytes(quota: str | int, value: float) -> None:
    assert load({"session_quota": quota}).session_quota == value


@pytest.mark.parametrize(
    ("flags", "environ"),
    [
        ({"prepare": ["ndt(2)", "voxel(leaf=1, of=voxel(leaf=0.5))"]}, {}),
        (
            {},
            {"SHMMAP_PREPARE": " ndt( leaf = 2.0, min_points=6 ), voxel(leaf=1, of=voxel(leaf=0.5)),ndt(2)"},
        ),
    ],
)
def test_layers_to_prepare_are_a_list(flags: dict[str, Any], environ: dict[str, str], tmp_path: Path) -> None:
    wanted = ("ndt(leaf=2.0)", "voxel(leaf=1.0,of=voxel(leaf=0.5))")
    assert load(flags, environ).prepare == wanted
    file = tmp_path / "shmmap.toml"
    file.write_text("prepare = ['ndt(2)', 'voxel(leaf=1, of=voxel(leaf=0.5))']\n")
    assert load(file=str(file)).prepare == wanted


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("prepare = ['ndt(leaf=2.0', 'voxel(leaf=1)']", ":1: prepare: ", ""),
        ("prepare = ['ntd(leaf=2.0)']", ":1: prepare: unknown layer 'ntd'", "did you mean 'ndt'?"),
        ("prepare = ['ndt']", ":1: prepare: ndt needs leaf", "leaf"),
        ("prepare = 3", ":1: prepare must be a list of texts, not 3", "its default is []"),
        ("prepare = [3]", ":1: prepare must be a list of texts, not [3]", "its default is []"),
        ("cache_size = '0'\nprepare = ['ndt(2)']", "and cache_size is 0", "name a cache_size"),
    ],
)
def test_layers_that_cannot_be_prepared_are_refused(
    tmp_path: Path, text: str, message: str, hint: str
) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as failure:
        load(file=str(file))
    assert message in failure.value.message
    assert str(file) in failure.value.message
    assert (failure.value.key, hint in failure.value.hint) == ("prepare", True)


def test_a_processor_is_left_for_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    for processors, loaders in ((1, 1), (2, 1), (4, 3), (64, 4)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _pid, count=processors: set(range(count)))
        assert DaemonConfig().loaders() == loaders
    assert DaemonConfig(workers=9).loaders() == 9


def test_the_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert DaemonConfig(endpoint="ipc:///run/a.sock").socket() == "/run/a.sock"
    assert DaemonConfig(endpoint="/run/a.sock", runtime_dir="/other").socket() == "/run/a.sock"
    assert DaemonConfig(runtime_dir=str(tmp_path), instance="car").socket() == f"{tmp_path}/car.sock"
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/service")
    assert DaemonConfig(instance="car").socket() == "/run/service/car.sock"
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert DaemonConfig().socket() == f"{tmp_path}/shmmap/default.sock"


# --- mistakes -----------------------------------------------------------------------------------------


BAD: list[tuple[str, Any]] = [
    ("workers", -1), ("workers", 65), ("workers", "many"), ("workers", 1.5), ("workers", True),
    ("workers", "1e9"), ("load_timeout_s", float("nan")),
    ("load_timeout_s", 0), ("load_timeout_s", -1.0), ("load_timeout_s", "soon"),
    ("load_timeout_s", 86401), ("load_timeout_s", True), ("load_timeout_s", 10**400),
    ("session_quota", 0), ("session_quota", 2), ("session_quota", "90"),
    ("session_quota", -0.5), ("session_quota", "x"), ("session_quota", float("inf")),
    ("session_quota", float("nan")), ("session_quota", "1.2.3"), ("session_quota", "\u00b2"),
    ("budget_bytes", -1), ("budget_bytes", "lots"), ("budget_bytes", 1.5), ("budget_bytes", 1 << 70),
    ("budget_bytes", True), ("log_level", "loud"), ("log_level", 3), ("strict", "maybe"), ("strict", 1),
    ("instance", "a/b"), ("instance", ""), ("instance", "x" * 65), ("instance", "a.b"), ("instance", 5),
    ("map_path", 5), ("group", ["x"]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_a_wrong_value_is_refused_with_its_origin(name: str, value: Any) -> None:
    with pytest.raises(ConfigError) as failure:
        load({name: value})
    assert (failure.value.origin, failure.value.key, failure.value.exit_code) == ("command line", name, 78)
    assert failure.value.message.startswith("command line: ")
    assert option_of(name) in failure.value.message


@pytest.mark.parametrize(
    ("name", "value", "hint"),
    [
        ("log_level", "loud", "debug, info or warning"),
        ("session_quota", "90", "up to 1"),
        ("workers", 65, "0 to 64; 0: one less than there are processors"),
        ("live_budget", "1M", "at least 4M; 0: an eighth"),
        ("poll_s", "0.5", "1 to 86400 seconds; 0: only on"),
        ("workers", "many", "its default is 0"),
        ("cache_size", 1.5, 'its default is "8G"'),
        ("strict", "maybe", "its default is false"),
        ("map_path", 5, "in quotes"),
    ],
)
def test_the_hint_names_what_is_allowed(name: str, value: Any, hint: str) -> None:
    with pytest.raises(ConfigError) as failure:
        load({name: value})
    assert hint in failure.value.hint


GONE: list[tuple[dict[str, str], str, str, str, str]] = [
    ({}, "", 'workers = 2\neviction = "time"\n', ":2: eviction is gone: what clients", "delete this line"),
    ({}, "EVICTION", "", "SHMMAP_EVICTION: eviction is gone: what clients", "unset SHMMAP_EVICTION"),
    ({"eviction": "distance"}, "", "", "command line: --eviction is gone: what clients", "leave it out"),
    (
        {},
        "",
        "ride_out_s = 5\n",
        ":1: ride_out_s is gone: it is outage_tolerance_s",
        "write outage_tolerance_s",
    ),
    ({}, "RIDE_OUT_S", "", "it is SHMMAP_OUTAGE_TOLERANCE_S now", "write SHMMAP_OUTAGE_TOLERANCE_S"),
    (
        {"ride_out_s": "5"},
        "",
        "",
        "--ride-out is gone: it is --outage-tolerance now",
        "write --outage-tolerance",
    ),
]


@pytest.mark.parametrize(("flags", "variable", "text", "message", "hint"), GONE)
def test_a_setting_that_is_gone_is_refused_with_what_to_do(
    tmp_path: Path, flags: dict[str, str], variable: str, text: str, message: str, hint: str
) -> None:
    """Also one that says what always holds now."""
    file = tmp_path / "shmmap.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as failure:
        load(flags, {f"SHMMAP_{variable}": "time"} if variable else {}, str(file))
    assert message in failure.value.message
    assert (failure.value.hint, failure.value.exit_code) == (hint, 78)


def test_a_wrong_variable_is_named() -> None:
    with pytest.raises(ConfigError, match="SHMMAP_BUDGET: ") as failure:
        load(environ={"SHMMAP_BUDGET": "lots"})
    assert failure.value.origin == "SHMMAP_BUDGET"


@pytest.mark.parametrize(
    ("name", "suggestion"),
    [
        ("budgett", "budget"),
        ("bugdet", "budget"),
        ("worker", "workers"),
        ("cache_sise", "cache_size"),
        ("shmdir", "shm_dir"),
        ("qqqq", ""),
    ],
)
def test_unknown_settings_with_a_suggestion(name: str, suggestion: str) -> None:
    for flags, environ in (({name: "1"}, {}), ({}, {f"SHMMAP_{name.upper()}": "1"})):
        with pytest.raises(ConfigError, match="unknown setting") as failure:
            load(flags, environ)
        expected = f"did you mean '{suggestion}'?" if suggestion else "settings are: "
        assert failure.value.hint.startswith(expected)


@pytest.mark.parametrize(
    ("text", "line"), [("a=1\nworkers = 'x'\n", 1), ("workers = 2\nbugdet = 3\n", 2), ("\n\nworkers=-1", 3)]
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, text: str, line: int) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as failure:
        load(file=str(file))
    assert failure.value.origin == f"{file}:{line}"
    assert failure.value.message.startswith(f"{file}:{line}: ")


def test_lines_that_only_look_like_settings(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text('map_path = """\nworkers = 9\n"""\n"workers"=3\n[budget]\nworkers = 4\n')
    found = read_settings_file(str(file))
    assert found["map_path"] == ("workers = 9\n", f"{file}:1")
    assert found["workers"] == (3, f"{file}:4")
    assert found["budget"].origin == f"{file}:5"


@pytest.mark.parametrize(
    "content",
    [b"workers = ", b"= 3", b"\xff\xfe", b"[table]\nworkers = 3\n", b"a = " + b"[" * 5000 + b"]" * 5000,
     b"#" * ((1 << 20) + 1), "pipe", "directory", "missing"],
)  # fmt: skip
def test_what_is_no_file_of_settings(tmp_path: Path, content: bytes | str) -> None:
    file = tmp_path / "shmmap.toml"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content == "directory":
        file.mkdir()
    elif content == "pipe":
        os.mkfifo(tmp_path / "pipe")
        file.symlink_to("pipe")
    with pytest.raises(ConfigError, match=str(file)):
        load(file=str(file))


# --- the example --------------------------------------------------------------------------------------


def test_the_example_is_the_one_that_settings_make() -> None:
    """After a setting is changed: ``python -m tests.unit.daemon.test_config`` writes it again."""
    assert EXAMPLE.read_text(encoding="utf-8") == configuration()
    assert load(file=str(EXAMPLE)) == OF_THE_SERVICE


def test_what_the_example_comments_out_are_all_settings_with_their_defaults(tmp_path: Path) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    assignment = re.compile(r"^#?(?:  )?(?=([a-z_]+) = |\[live\.lidar\]$)", re.MULTILINE)
    named = [match[1] for match in assignment.finditer(text) if match[1]]
    assert named == [*(row.called for row in ROWS.values()), *LIVE_ROWS]
    assert [*ROWS, "live"] == [one.name for one in fields(DaemonConfig)]
    assert ["name", *LIVE_ROWS] == [one.name for one in fields(LiveSettings)]
    file = tmp_path / "all.toml"
    file.write_text(assignment.sub("", text))
    assert load(file=str(file)) == replace(OF_THE_SERVICE, live=(LiveSettings("lidar"),))


if __name__ == "__main__":
    EXAMPLE.write_text(configuration(), encoding="utf-8")


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
