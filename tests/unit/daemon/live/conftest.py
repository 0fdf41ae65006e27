# SPDX-License-Identifier: Apache-2.0
"""What tests of live maps share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from shmmap.daemon.live.live_map import LiveMap


@pytest.fixture(autouse=True)
def closed_maps(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every live map that a test makes is closed at its end: files stay open otherwise."""
    made: list[LiveMap] = []
    begin = LiveMap.__post_init__

    def note(one: LiveMap) -> None:
        made.append(one)
        begin(one)

    monkeypatch.setattr(LiveMap, "__post_init__", note)
    yield
    for one in made:
        if hasattr(one, "_threads"):
            one.close()
