# SPDX-License-Identifier: Apache-2.0
"""Where each setting comes from."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from shmmap.daemon.config import DaemonConfig, installed_config_file, read_settings_file, trace_settings
from shmmap.errors import ConfigError


def test_each_setting_knows_its_origin(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text("# settings\nworkers = 2\n\n  'log_level' = \"debug\"\nbudget = '1G'\ninstance = 'car'\n")
    found = trace_settings(
        {"instance": "bus", "group": None}, file=str(file), environ={"SHMMAP_BUDGET": "2G", "HOME": "/"}
    )
    assert found["workers"] == (2, f"{file}:2")
    assert found["log_level"] == ("debug", f"{file}:4")
    assert found["budget_bytes"] == (2 << 30, "SHMMAP_BUDGET")
    assert found["instance"] == ("bus", "command line")
    assert found["group"] == ("", "default")
    assert set(found) == set(DaemonConfig.__dataclass_fields__)


@pytest.mark.parametrize("word", ["budget_bytes", "cache_bytes"])
def test_a_setting_has_one_name(word: str, tmp_path: Path) -> None:
    """Not that of the attribute in the code."""
    file = tmp_path / "shmmap.toml"
    file.write_text(f"{word} = '1G'\n")
    with pytest.raises(ConfigError, match=word):
        trace_settings({}, file=str(file), environ={})
    with pytest.raises(ConfigError, match=word):
        trace_settings({}, environ={f"SHMMAP_{word.upper()}": "1G"})


def test_lines_that_only_look_like_settings(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text('map_path = """\nworkers = 9\n"""\n"workers"=3\n[budget]\nworkers = 4\n')
    found = read_settings_file(str(file))
    assert found["map_path"] == ("workers = 9\n", f"{file}:1")
    assert found["workers"] == (3, f"{file}:4")
    assert found["budget"].origin == f"{file}:5"


@pytest.mark.parametrize(
    ("text", "line"), [("a=1\nworkers = 'x'\n", 1), ("workers = 2\nbugdet = 3\n", 2), ("\n\nworkers=-1", 3)]
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, text: str, line: int) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as failure:
        trace_settings({}, file=str(file), environ={})
    assert failure.value.origin == f"{file}:{line}"
    assert failure.value.message.startswith(f"{file}:{line}: ")


def test_which_file_is_installed(tmp_path: Path) -> None:
    own = tmp_path / "shmmap" / "shmmap.toml"
    environ = {"XDG_CONFIG_HOME": str(tmp_path), "HOME": "/nowhere"}
    assert installed_config_file(environ) in ("", "/etc/shmmap/shmmap.toml")
    own.parent.mkdir()
    own.touch()
    assert installed_config_file(environ) == str(own)
    assert installed_config_file({"HOME": str(tmp_path)}) in ("", "/etc/shmmap/shmmap.toml")
    (tmp_path / ".config").symlink_to(tmp_path)
    assert installed_config_file({"HOME": str(tmp_path)}) == f"{tmp_path}/.config/shmmap/shmmap.toml"


@pytest.mark.parametrize("what", ["pipe", "directory", "deep", "large", "link to a pipe"])
def test_what_is_no_file_of_settings(tmp_path: Path, what: str) -> None:
    file = tmp_path / "shmmap.toml"
    if "pipe" in what:
        os.mkfifo(tmp_path / "pipe")
        file.symlink_to("pipe")
    elif what == "directory":
        file.mkdir()
    else:
        file.write_text("a = " + "[" * 5000 + "]" * 5000 if what == "deep" else "#" * ((1 << 20) + 1))
    with pytest.raises(ConfigError, match=str(file)):
        read_settings_file(str(file))
