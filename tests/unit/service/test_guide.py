# SPDX-License-Identifier: Apache-2.0
"""The operator's guide names verbs, options and files that exist."""

from __future__ import annotations

import re

import pytest

from shmmap.cli.parser import build_parser
from shmmap.service.shipped_files import shipped_names
from tests.support.daemon_process import ROOT

GUIDE = (ROOT / "systemd" / "README.md").read_text(encoding="utf-8")
BLOCKS = "\n".join(re.findall(r"```sh\n(.*?)```", GUIDE, re.DOTALL)).splitlines()
LINES = [line.split("#")[0].split("|")[0].removeprefix("sudo ").split() for line in BLOCKS] + [
    code.removeprefix("sudo ").split() for code in re.findall(r"`([^`\n]+)`", GUIDE)
]
COMMANDS = sorted({" ".join(words[1:]) for words in LINES if len(words) > 1 and words[0].endswith("shmmap")})


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_is_understood(command: str) -> None:
    assert callable(build_parser().parse_args(command.split()).run)


def test_there_are_commands() -> None:
    assert {command.split()[0] for command in COMMANDS} >= {"unit", "config", "doctor", "status", "clients"}


def test_each_file_is_shipped_and_each_shipped_file_is_named() -> None:
    named = set(re.findall(r"`((?:system|user|drop-ins|sysusers\.d|tmpfiles\.d)/[^`/ ]+)`", GUIDE))
    named |= {"shmmap.toml"} if "`shmmap.toml`" in GUIDE else set()
    assert named == set(shipped_names()) - {"README.md"}
