# SPDX-License-Identifier: Apache-2.0
"""The version of a published map that is taken, while another thread looks whether there is a later one."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import pytest

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.daemon.map import published_origin
from shmmap.daemon.map.published_origin import PublishedOrigin
from shmmap.errors import MapDataError
from shmmap.origin.remote.opened_store import ServedFrom
from shmmap.origin.remote.taken_version import TakenVersion
from shmmap.origin.remote.verify_apart import Verified
from tests.support.interleaving import interleaved


class View:
    def __init__(self, root: Any, *_of: object, **_limits: object) -> None:
        self.pages = root


class Root:
    map_version = 0


def taken(version: int) -> TakenVersion:
    return TakenVersion("", "", "", version, b"", 0.0, 0.0, 0.0)


def test_a_version_signed_again_does_not_replace_a_later_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(published_origin, "PublishedView", View)

    def first_taken() -> PublishedOrigin:
        origin = PublishedOrigin(
            ServedFrom(str(tmp_path)), instance="", state_dir="", cache_dir="", cache_bytes=0,
            catalogue_bytes=0, poll_s=0.0,
        )  # fmt: skip
        origin.taken = taken(1)
        return origin

    def take_the_next(origin: PublishedOrigin) -> None:
        origin._take(taken(2), cast("Any", Root()), {})

    def judge(origin: PublishedOrigin) -> None:
        offer = Verified(taken(1).current, trust="", signed_s=1.0, expires_s=2.0)
        with suppress(MapDataError):  # it is older than the one taken
            origin._judge(offer)

    for origin in interleaved(first_taken, judge, take_the_next):
        assert origin.taken == taken(2)
