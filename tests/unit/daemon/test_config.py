# SPDX-License-Identifier: Apache-2.0
"""Settings: where they come from, which wins, and what is said of a wrong one."""

from __future__ import annotations

import argparse
import contextlib
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.cli.parser import build_parser
from shmmap.daemon.config import DROPPED, ROWS, DaemonConfig, load_config, option_of
from shmmap.daemon.config_table import parse_bytes
from shmmap.errors import ConfigError


def load(
    flags: dict[str, Any] | None = None, environ: dict[str, str] | None = None, file: str = ""
) -> DaemonConfig:
    return load_config(flags or {}, file=file, environ=environ or {})


def test_defaults() -> None:
    assert load() == DaemonConfig()
    assert load({"budget": None, "workers": None}) == DaemonConfig()


def test_later_origins_win(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text('budget = "1G"\nworkers = 2\ninstance = "file"\nload_timeout_s = 5\nstrict = true\n')
    environ = {"SHMMAP_WORKERS": "3", "SHMMAP_INSTANCE": "variable", "HOME": "/root", "SHMMAP_STRICT": "no"}
    config = load({"instance": "flag"}, environ, str(file))
    assert (config.budget_bytes, config.workers, config.instance) == (1 << 30, 3, "flag")
    assert (config.load_timeout_s, config.strict) == (5.0, False)
    assert isinstance(config.load_timeout_s, float)


def test_variables_that_are_no_settings() -> None:
    environ = {"SHMMAP_TEST_DATA": "/x", "SHMMAPX": "1"}
    assert load(environ=environ) == DaemonConfig()


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
    """And whoever knows the socket alone finds the statistics, as they are named after the instance."""
    config = load(flags, environ={"SHMMAP_ENDPOINT": "/run/city.sock", **environ})
    assert (config.endpoint, config.instance) == (endpoint, instance)


def test_sizes_have_one_name_in_files_variables_and_options() -> None:
    assert load({"cache_size": "1G"}).cache_bytes == 1 << 30
    assert load(environ={"SHMMAP_CACHE_SIZE": "2G", "SHMMAP_BUDGET": "1M"}).cache_bytes == 2 << 30
    with pytest.raises(ConfigError, match="unknown") as caught:
        load({"cache_sise": 1})
    assert caught.value.hint == "did you mean 'cache_size'?"


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
    assert failure.value.origin == "command line"
    assert failure.value.key == name
    assert failure.value.message.startswith("command line: ")
    assert option_of(name) in failure.value.message
    assert failure.value.exit_code == 78


def test_the_command_line_has_the_options_that_errors_name() -> None:
    (verbs,) = (one for one in build_parser()._actions if isinstance(one, argparse._SubParsersAction))
    actions = {action.dest: action for action in verbs.choices["serve"]._actions}
    assert set(actions) == {*(field.name for field in fields(DaemonConfig)), "config", "help", *DROPPED}
    for name in ROWS:
        assert option_of(name) in (*actions[name].option_strings, actions[name].metavar)
        assert actions[name].default is None, "the configuration file may say"


def test_a_value_out_of_range_is_told_what_may_be() -> None:
    for name, value, hint in (
        ("log_level", "loud", "debug, info or warning"),
        ("session_quota", "90", "up to 1"),
        ("workers", 65, "0 to 64; 0: one less than there are processors"),
        ("live_budget", "1M", "at least 4M; 0: an eighth"),
        ("poll_s", "0.5", "1 to 86400 seconds; 0: only on"),
        ("workers", "many", "its default is 0"),
        ("cache_size", 1.5, 'its default is "8G"'),
        ("strict", "maybe", "its default is false"),
        ("map_path", 5, "in quotes"),
    ):
        with pytest.raises(ConfigError) as failure:
            load({name: value})
        assert hint in failure.value.hint


def test_a_setting_that_is_gone_is_refused_with_what_to_do(tmp_path: Path) -> None:
    """Also one that says what always holds now."""
    file = tmp_path / "shmmap.toml"
    file.write_text('workers = 2\neviction = "time"\n')
    renamed = tmp_path / "renamed.toml"
    renamed.write_text("ride_out_s = 5\n")
    cases: list[tuple[dict[str, Any], dict[str, str], str, str, str]] = [
        ({}, {}, str(file), f"{file}:2: eviction is gone: what clients will need", "delete this line"),
        ({}, {"SHMMAP_EVICTION": "lru"}, "", "SHMMAP_EVICTION: eviction is gone", "unset SHMMAP_EVICTION"),
        ({"eviction": "distance"}, {}, "", "command line: --eviction is gone", "leave it out"),
        (
            {},
            {},
            str(renamed),
            f"{renamed}:1: ride_out_s is gone: it is outage_tolerance_s now",
            "write outage_tolerance_s",
        ),
        (
            {},
            {"SHMMAP_RIDE_OUT_S": "5"},
            "",
            "is gone: it is SHMMAP_OUTAGE_TOLERANCE_S now",
            "write SHMMAP_OUTAGE_TOLERANCE_S",
        ),
        (
            {"ride_out_s": "5"},
            {},
            "",
            "--ride-out is gone: it is --outage-tolerance now",
            "write --outage-tolerance",
        ),
    ]
    for flags, environ, path, message, hint in cases:
        with pytest.raises(ConfigError) as failure:
            load(flags, environ, path)
        assert message in failure.value.message
        assert failure.value.hint == hint
        assert failure.value.exit_code == 78


def test_a_wrong_variable_is_named() -> None:
    with pytest.raises(ConfigError) as failure:
        load(environ={"SHMMAP_BUDGET": "lots"})
    assert failure.value.origin == "SHMMAP_BUDGET"
    assert "SHMMAP_BUDGET: " in failure.value.message


def test_a_wrong_line_of_the_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text("workers = 'x'\n")
    with pytest.raises(ConfigError) as failure:
        load(file=str(file))
    assert failure.value.origin == f"{file}:1"


@pytest.mark.parametrize(
    ("given_name", "suggestion"),
    [("budgett", "budget"), ("bugdet", "budget"), ("worker", "workers"), ("shmdir", "shm_dir"), ("qqqq", "")],
)
def test_unknown_settings_with_a_suggestion(given_name: str, suggestion: str) -> None:
    for flags, environ in (({given_name: "1"}, {}), ({}, {f"SHMMAP_{given_name.upper()}": "1"})):
        with pytest.raises(ConfigError, match="unknown setting") as failure:
            load(flags, environ)
        if suggestion:
            assert f"did you mean '{suggestion}" in failure.value.hint
        else:
            assert "settings are: " in failure.value.hint


@pytest.mark.parametrize("content", [b"workers = ", b"= 3", b"\xff\xfe", b"[table]\nworkers = 3\n"])
def test_files_that_are_no_settings(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=str(file)):
        load(file=str(file))


def test_a_file_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load(file=str(tmp_path / "none.toml"))


def test_quotas_are_parts_or_bytes() -> None:
    assert load({"session_quota": "0.5"}).session_quota == 0.5
    assert load({"session_quota": "1"}).session_quota == 1.0
    assert load({"session_quota": "64M"}).session_quota == float(64 << 20)
    assert load({"session_quota": 1}).session_quota == 1.0


def test_a_processor_is_left_for_who_is_being_served(monkeypatch: pytest.MonkeyPatch) -> None:
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
