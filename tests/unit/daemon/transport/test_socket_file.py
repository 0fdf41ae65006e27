# SPDX-License-Identifier: Apache-2.0
"""Where the daemon may listen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from shmmap.daemon.transport.socket_file import bind_socket, remove_socket
from shmmap.errors import ConfigError


@pytest.fixture
def router() -> Iterator[zmq.Socket[bytes]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket: zmq.Socket[bytes] = context.socket(zmq.ROUTER)
    socket.setsockopt(zmq.LINGER, 0)
    yield socket
    socket.close()
    context.term()


def test_a_file_in_the_socket_s_place_stays(router: zmq.Socket[bytes], tmp_path: Path) -> None:
    place = tmp_path / "map.yaml"
    place.write_text("precious")
    with pytest.raises(ConfigError, match="no socket"):
        bind_socket(router, str(place), -1)
    remove_socket(str(place))
    assert place.read_text() == "precious"


def test_a_socket_left_over_is_replaced(router: zmq.Socket[bytes], tmp_path: Path) -> None:
    path = str(tmp_path / "a.sock")
    other: zmq.Socket[bytes] = router.context.socket(zmq.ROUTER)
    bind_socket(other, path, -1)
    bind_socket(router, path, -1)
    other.close(linger=0)
    remove_socket(path)
    assert not Path(path).exists()
    remove_socket(path)
