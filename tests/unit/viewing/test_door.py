# SPDX-License-Identifier: Apache-2.0
"""Who may look at a browser's page: those with the secret, from no other site."""

from __future__ import annotations

import socket
from email.message import Message

import pytest

from shmmap.cli.listening import listening_at
from shmmap.viewing.browser.door import Door

OURS = "127.0.0.1:8765"


class Headers(Message):
    """Headers of a request."""

    def get_all(self, key: str) -> list[str]:  # type: ignore[override]
        return [str(value) for value in super().get_all(key, [])]


def headers(**values: str | None) -> Headers:
    found = Headers()
    for name, value in values.items():
        if value is not None:
            found[name] = value
    return found


def test_a_page_needs_the_secret_and_a_host_of_this_machine() -> None:
    door = Door("127.0.0.1")
    assert len(door.secret) >= 24
    assert Door("127.0.0.1").secret != door.secret
    for host in (OURS, "localhost:9000", "[::1]:8765", "192.168.0.7:80", socket.gethostname()):
        assert door.admit(f"/{door.secret}/", headers(Host=host)) == "/", host
        assert door.admit(f"/{door.secret}", headers(Host=host)) == "/"
        assert door.admit(f"/{door.secret}/a/b?c=d", headers(Host=host)) == "/a/b"
    for path in (
        "/",
        "",
        "/x/",
        f"/{door.secret[:-1]}/",
        f"/{door.secret}x/",
        f"//{door.secret}/",
        f"/?{door.secret}",
    ):
        assert door.admit(path, headers(Host=OURS)) is None, path
    assert door.admit(f"/\u00e9{door.secret}/", headers(Host=OURS)) is None
    assert door.admit(f"/\udcff{door.secret}/", headers(Host=OURS)) is None, "bytes that are no text"


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8765", "127.0.0.1.evil.example:8765", "", None]
)
def test_a_name_of_another_site_may_lead_here(host: str | None) -> None:
    door = Door("127.0.0.1")
    assert door.admit(f"/{door.secret}/", headers(Host=host)) is None


def test_two_hosts_or_origins_are_one_too_many() -> None:
    door = Door("127.0.0.1")
    twice = headers(Host=OURS)
    twice["Host"] = OURS
    assert door.admit(f"/{door.secret}/", twice) is None
    twice = headers(Host=OURS, Upgrade="websocket", Origin=f"http://{OURS}")
    twice["Origin"] = f"http://{OURS}"
    assert door.admit(f"/{door.secret}", twice) is None


@pytest.mark.parametrize(
    ("origin", "admitted"),
    [
        (f"http://{OURS}", True),
        (f"https://{OURS}", True),
        ("http://127.0.0.1:8766", False),
        ("http://localhost:8765", False),
        ("http://evil.example", False),
        ("null", False),
        (None, False),
    ],
)
def test_a_websocket_needs_the_pages_own_origin(origin: str | None, admitted: bool) -> None:
    door = Door("127.0.0.1")
    asked = headers(Host=OURS, Upgrade="websocket", Origin=origin)
    assert (door.admit(f"/{door.secret}", asked) == "/") is admitted
    page = headers(Host=OURS, Origin=origin)
    assert (door.admit(f"/{door.secret}", page) == "/") is (admitted or origin is None)


def test_its_address() -> None:
    with listening_at("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
        assert Door("127.0.0.1").url(listening).startswith(f"http://127.0.0.1:{port}/")
