# SPDX-License-Identifier: Apache-2.0
"""The list of segments by pages: what stays is listed, whatever comes and goes between two pages."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.ledger import Segments
from shmmap.daemon.records import Key, Resident


def segment(number: int, nbytes: int) -> Resident:
    return Resident(str(number), Key(str(number), "points"), 1, nbytes, 1, (0, 0, 1, 1), 0.0, 1.0)


SIZES = st.integers(1, 1 << 16)


@given(
    st.lists(SIZES, max_size=60),
    st.integers(1, 7),
    st.lists(st.tuples(st.lists(st.integers(0, 200), max_size=6), st.lists(SIZES, max_size=6)), max_size=40),
)
def test_what_stays_is_listed(
    sizes: list[int], most: int, changes: list[tuple[list[int], list[int]]]
) -> None:
    """``changes`` before each further page: which leave (by position among all), and sizes of new ones."""
    segments, there, number = Segments(), list[Resident](), 0
    for size in sizes:
        there.append(segment(number := number + 1, size))
        segments.add(there[-1])
    stays = set(there)
    seen: list[Resident] = []
    start: int | None = 0
    later = iter(changes)
    while start is not None:
        page, start = segments.page(start, most)
        assert len(page) <= most
        assert len(page) == most or start is None
        seen += page
        leave, come = next(later, ([], []))
        for at in leave:
            if there:
                gone = there.pop(at % len(there))
                segments.remove(gone)
                stays.discard(gone)
        for size in come:
            there.append(segment(number := number + 1, size))
            segments.add(there[-1])
    assert stays <= set(seen)


@given(st.lists(SIZES, max_size=60), st.integers(1, 7))
def test_what_does_not_change_is_listed_once_and_larger_ones_first(sizes: list[int], most: int) -> None:
    segments = Segments()
    for number, size in enumerate(sizes):
        segments.add(segment(number, size))
    seen: list[Resident] = []
    start: int | None = 0
    while start is not None:
        page, start = segments.page(start, most)
        seen += page
    assert seen == list(segments.walk())


def test_starts_that_no_page_gave() -> None:
    segments = Segments()
    assert segments.page(0, 5) == segments.page(-1, 5) == segments.page(1 << 80, 5) == ([], None)
    one = segment(1, 4096)
    segments.add(one)
    for start in (-1, 0, 1 << 80, (13 << 32) + 99):
        assert segments.page(start, 5) == ([one], None)
    assert segments.page(12 << 32, 5) == ([], None)
