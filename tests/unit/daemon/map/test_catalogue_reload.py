# SPDX-License-Identifier: Apache-2.0
"""Reading the map again beside the loop, also when the machine has nothing left to do it with."""

from __future__ import annotations

import select
import threading
from collections.abc import Iterator

import pytest

from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.errors import ShmmapError
from shmmap.origin.catalogue import Catalogue

Result = Reread | ShmmapError


class Origin:
    """A map without cells."""

    path = "/maps/town"

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        assert fresh
        assert before is not None
        return Catalogue.from_cells([])


@pytest.fixture
def reloader() -> Iterator[Reloader]:
    one = Reloader(Origin(), lambda: Catalogue.from_cells([]))
    yield one
    one.close()


def collect(reloader: Reloader) -> None:
    """Do what the loop does when the descriptor is readable."""
    assert select.select([reloader.fd], [], [], 30.0)[0]
    reloader.collect(lambda found: found, lambda _: None)


def test_who_asks_meanwhile_gets_the_next_one(reloader: Reloader) -> None:
    answers: list[tuple[str, Result]] = []
    for name in "abc":
        reloader.ask(lambda result, name=name: answers.append((name, result)))  # type: ignore[misc]
    collect(reloader)
    assert [name for name, _ in answers] == ["a"]
    collect(reloader)
    assert [name for name, _ in answers] == ["a", "b", "c"]
    assert answers[1][1] is answers[2][1] is not answers[0][1]


def test_no_thread_is_to_be_had(reloader: Reloader, monkeypatch: pytest.MonkeyPatch) -> None:
    """That reload fails, and is answered; the next one works."""
    answers: list[Result] = []

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        reloader.ask(answers.append)
    collect(reloader)
    assert isinstance(answers[0], ShmmapError)
    assert "can't start new thread" in answers[0].message
    reloader.ask(answers.append)
    collect(reloader)
    assert isinstance(answers[1], Reread)
