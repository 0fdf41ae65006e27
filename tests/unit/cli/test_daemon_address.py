# SPDX-License-Identifier: Apache-2.0
"""Which daemon is meant: what the flags say counts before what variables say."""

from __future__ import annotations

import pytest

from shmmap.cli.daemon_address import endpoint, instance
from shmmap.cli.parser import build_parser

VARIABLES = {
    "SHMMAP_ENDPOINT": "/v/one.sock",
    "SHMMAP_INSTANCE": "two",
    "SHMMAP_RUNTIME_DIR": "/v/dir",
}


@pytest.mark.parametrize(
    ("flags", "variables", "socket", "name"),
    [
        ([], [], None, "default"),
        ([], ["SHMMAP_ENDPOINT"], "/v/one.sock", "one"),
        ([], ["SHMMAP_INSTANCE"], "/x/shmmap/two.sock", "two"),
        ([], ["SHMMAP_INSTANCE", "SHMMAP_RUNTIME_DIR"], "/v/dir/two.sock", "two"),
        (["--endpoint", "/f/three.sock"], [*VARIABLES], "/f/three.sock", "three"),
        (["--instance", "four"], [*VARIABLES], "/v/dir/four.sock", "four"),
        (["--instance", "four"], ["SHMMAP_ENDPOINT"], "/x/shmmap/four.sock", "four"),
        (["--instance", "default"], ["SHMMAP_ENDPOINT"], "/x/shmmap/default.sock", "default"),
        (["--runtime-dir", "/f"], [*VARIABLES], "/f/two.sock", "two"),
        (["--endpoint", "/f/three.sock", "--instance", "four"], [], "/f/three.sock", "four"),
    ],
)
def test_flags_count_before_variables(
    flags: list[str],
    variables: list[str],
    socket: str | None,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for variable, value in VARIABLES.items():
        monkeypatch.delenv(variable, raising=False)
        if variable in variables:
            monkeypatch.setenv(variable, value)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/x")
    args = build_parser().parse_args(["clients", *flags])
    assert (endpoint(args), instance(args)) == (socket, name)
