# SPDX-License-Identifier: Apache-2.0
"""Where the daemon may listen."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from shmmap.daemon.transport.socket_file import listen_at, remove_socket
from shmmap.errors import CannotStart


def test_a_file_in_the_socket_s_place_stays(tmp_path: Path) -> None:
    place = tmp_path / "map.yaml"
    place.write_text("precious")
    with pytest.raises(CannotStart, match=f"cannot be {place}: there is a file of "):
        listen_at(str(place), -1)
    remove_socket(str(place))
    assert place.read_text() == "precious"


def test_where_nothing_can_be_made(tmp_path: Path) -> None:
    with pytest.raises(CannotStart, match="No such file"):
        listen_at(str(tmp_path / "missing" / "a.sock"), -1)
    with pytest.raises(CannotStart, match="too long"):
        listen_at("/" + "a" * 200, -1)


def test_a_socket_left_over_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with listen_at(str(path), -1), listen_at(str(path), -1):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    remove_socket(str(path))
    assert not path.exists()
    remove_socket(str(path))
