# SPDX-License-Identifier: Apache-2.0
"""Nearly every request of a moving vehicle is answered from versions, with handles encoded before."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import msgspec
import pytest

from shmmap.daemon.requests import cell_requests
from shmmap.protocol.codec import encode_handle, pack_versions
from shmmap.protocol.messages import BoxMessage, Cells, Differential
from tests.support.divided_map import make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, InnerDaemon

HALF = BoxMessage(-1e3, -1e3, -1.0, 1e3)


class ColdPath(Exception):
    """The request was answered with what covers everything."""


def cold_path(*_: object) -> NoReturn:
    raise ColdPath


@pytest.fixture
def warm(tmp_path: Path) -> Iterator[tuple[InnerDaemon, Cells]]:
    """A daemon that has all of its map in memory, and the reply that says so."""
    made = make_map(tmp_path / "map", columns=3, rows=2, points=20)
    inner = InnerDaemon(str(made.root), cache_dir=str(tmp_path / "cache"))
    yield inner, inner.everything()
    inner.close()


def differential(
    inner: InnerDaemon, request: int, area: BoxMessage, versions: list[int], **more: object
) -> Cells:
    message = Differential(request, area, packed=pack_versions(versions), **more)  # type: ignore[arg-type]
    inner.ask(inner.session(), message)
    return inner.cells_of(request)


def test_handles_are_encoded_once(warm: tuple[InnerDaemon, Cells]) -> None:
    """Replies carry the bytes that each segment was given when it came into memory."""
    inner, everything = warm
    session = inner.session()
    inner.ask(session, Differential(2, EVERYWHERE))
    (_, first), *_ = [reply for reply in inner.replies if reply[1].request == 2]
    residents = session.residents()
    assert len(residents) == len(first.cells) == len(everything.cells)
    for resident in residents:  # marked, so that it shows whose bytes they are
        handle = next(cell for cell in first.cells if cell.version == resident.version)
        resident.handle = encode_handle(msgspec.structs.replace(handle, points=4711))
    for request, reply in ((3, differential(inner, 3, EVERYWHERE, [])), (4, inner.everything(4))):
        assert {cell.points for cell in reply.cells} == {4711}, request


def test_what_others_hold_does_not_count(
    warm: tuple[InnerDaemon, Cells], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is in memory may come to more than one session may have: it is answered from versions, too."""
    inner, everything = warm
    monkeypatch.setattr(cell_requests, "difference", cold_path)
    sizes = [cell.bytes for cell in everything.cells]
    inner.cells._quota.nbytes = sum(sizes[:2])
    assert inner.ledger.resident_bytes > inner.cells._quota.nbytes
    held = [cell.version for cell in everything.cells]
    assert len(differential(inner, 2, EVERYWHERE, held[2:]).cells) == 2
    with pytest.raises(ColdPath):
        differential(inner, 3, EVERYWHERE, held[3:])


def test_what_another_request_got_is_not_forgotten(warm: tuple[InnerDaemon, Cells]) -> None:
    """Two windows of one client: each says what it holds, and the session holds both's until released."""
    inner, everything = warm
    session = inner.session()
    half = Differential(2, HALF)
    inner.ask(session, half)
    inner.ask(session, Differential(3, EVERYWHERE))
    inner.ask(session, half)
    held = {cell.version for cell in everything.cells}
    assert session.held.keys() == held
    assert session.held_bytes == sum(cell.bytes for cell in everything.cells)
