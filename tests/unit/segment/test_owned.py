# SPDX-License-Identifier: Apache-2.0
"""What is owned is given back once, by whoever comes first: its end, or who has it end."""

from __future__ import annotations

from functools import partial

import pytest

from shmmap.segment.attach import Owned


def owned(gone: list[int]) -> Owned:
    return Owned(zip([7]), gone.append)


@pytest.mark.parametrize("need_less", [False, True])
def test_it_ends_although_somebody_else_has_it_still(need_less: bool) -> None:
    """As a window's thread has it end, while the thread that handed it over leaves its last function."""
    gone: list[int] = []
    memory = owned(gone)
    elsewhere = memory
    if need_less:
        memory.keep(partial(gone.append, 7))
    memory.end()
    assert gone == [7]
    memory.end()
    del memory, elsewhere
    assert gone == [7], "once"


@pytest.mark.parametrize("give_back", [False, True])
def test_it_is_given_back_once(give_back: bool) -> None:
    gone: list[int] = []
    memory = owned(gone)
    assert (memory.value, gone) == (7, [])
    if give_back:
        memory.give_back()
    del memory
    assert gone == [7]
