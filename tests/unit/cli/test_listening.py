# SPDX-License-Identifier: Apache-2.0
"""Where programs listen: the words of the option, and what is in the way."""

from __future__ import annotations

import pytest

from shmmap.cli.listening import listen_address, listening_at
from shmmap.errors import BadRequest, InstanceBusy


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("9731", ("127.0.0.1", 9731)),
        (":9731", ("127.0.0.1", 9731)),
        ("0", ("127.0.0.1", 0)),
        ("0.0.0.0:80", ("0.0.0.0", 80)),
        ("localhost:65535", ("localhost", 65535)),
        ("[::1]:9731", ("::1", 9731)),
    ],
)
def test_addresses(text: str, address: tuple[str, int]) -> None:
    assert listen_address(text) == address


@pytest.mark.parametrize(
    "text", ["", "localhost", "::1:9731", "[::1]", "[x]:1", "1.2.3.4:65536", "h:-1", "h:٣"]
)
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(BadRequest, match="is no address to listen at"):
        listen_address(text)


def test_where_it_listens() -> None:
    with listening_at("127.0.0.1", 0) as first:
        host, port = first.getsockname()[:2]
        assert host == "127.0.0.1"
        with pytest.raises(InstanceBusy, match=f"another program listens at 127.0.0.1 port {port}"):
            listening_at("127.0.0.1", port)
        with listening_at("127.0.0.1", port, is_fixed=False) as second:
            assert second.getsockname()[1] not in (0, port)
    with pytest.raises(BadRequest, match="this machine has no such address"):
        listening_at("192.0.2.1", 1)
    with pytest.raises(BadRequest, match="cannot listen at"):
        listening_at("no.such.host.invalid", 0)
