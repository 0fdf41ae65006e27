# SPDX-License-Identifier: Apache-2.0
"""An origin elsewhere is asked for versions, doubted when something fails, and found again."""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Iterator

import pytest

from shmmap.daemon.map.origin_link import LinkNews, OriginLink
from shmmap.errors import MapDataError, Offline
from shmmap.processes.request_threads import have_ended
from tests.support.daemon_process import Deadline


class Origin:
    """Answers as the test says; counts questions."""

    def __init__(self) -> None:
        self.answer: bool | BaseException = False
        self.asked_s: list[float] = []
        self.may_answer = threading.Event()
        self.may_answer.set()
        self._links: list[OriginLink] = []

    @property
    def asked(self) -> int:
        return len(self.asked_s)

    def ask(self) -> bool:
        self.asked_s.append(time.monotonic())
        self.may_answer.wait()
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer

    def link(self, poll_s: float = 0.0) -> OriginLink:
        self._links.append(OriginLink(self.ask, poll_s))
        return self._links[-1]

    def close(self) -> None:
        assert all(have_ended(link.close()) for link in self._links)


@pytest.fixture
def origin() -> Iterator[Origin]:
    one = Origin()
    yield one
    one.close()


def news(link: OriginLink) -> LinkNews:
    """Wait for the next ones."""
    assert select.select([link.fd], [], [], 60.0)[0]
    return link.take()


def until_asked(origin: Origin, times: int) -> None:
    waiting = Deadline()
    while waiting(origin.asked < times):
        time.sleep(0.001)


def test_a_doubt_that_is_unfounded_is_over_at_once(origin: Origin) -> None:
    link = origin.link()
    link.doubt()
    waiting, back = Deadline(), False
    while waiting(not back):
        back = news(link).back
    assert (link.is_out, link.is_doubted, origin.asked) == (False, False, 1)


def test_it_is_out_until_it_answers(origin: Origin) -> None:
    origin.answer = Offline("no answer")
    link = origin.link()
    link.doubt()
    assert link.is_out
    until_asked(origin, 2)
    assert link.is_out
    origin.answer = False
    waiting, back = Deadline(), False
    while waiting(not back):
        back = news(link).back
    assert not link.is_out


def test_what_cannot_be_had_of_one_that_answers_is_asked_for_less_and_less(origin: Origin) -> None:
    link = origin.link()
    for _ in range(3):
        origin.may_answer.clear()
        link.doubt()
        link.doubt()
        origin.may_answer.set()
        waiting = Deadline()
        while waiting(not news(link).back):
            pass
        assert not link.is_doubted
    first_s, second_s, third_s = origin.asked_s
    assert second_s - first_s >= 1.0
    assert third_s - second_s >= 2.0


def test_another_version_is_reported(origin: Origin) -> None:
    origin.answer = True
    link = origin.link(0.05)
    assert news(link) == LinkNews(changed=True, back=False)
    link.take()
    until_asked(origin, origin.asked + 2)
    assert news(link).changed, "until it was taken"
    link = origin.link(1e9)
    link.ask_now()
    assert news(link).changed


def test_a_damaged_answer_is_an_answer(origin: Origin) -> None:
    origin.answer = MapDataError("it names no root")
    link = origin.link(0.01)
    until_asked(origin, 2)
    assert not link.is_out


def test_without_a_reason_nothing_is_asked_and_no_thread_runs(origin: Origin) -> None:
    threads = threading.active_count()
    origin.link()
    assert threading.active_count() == threads


class Panic(BaseException):
    """What a library in Rust raises: no `Exception`."""


def test_a_panic_does_not_end_the_polling(origin: Origin) -> None:
    link = origin.link(poll_s=0.01)
    news(link)
    origin.answer = Panic()
    while not link.is_out:
        news(link)
    assert not link.is_lost
    origin.answer = True
    while not news(link).back:
        pass
    assert not link.is_out


def lost(link: OriginLink) -> bool:
    return link.is_lost


def test_a_thread_that_has_ended_is_missed_and_started_again(
    origin: Origin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OriginLink, "_run", lambda _self: None)
    link = origin.link(poll_s=0.01)
    waiting = Deadline()
    while waiting(not lost(link)):
        pass
    monkeypatch.undo()
    link.restart()
    while not news(link).back:  # until then it counts as unreachable
        pass
    assert not lost(link)
    assert origin.asked
