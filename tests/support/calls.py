# SPDX-License-Identifier: Apache-2.0
"""How much work something does, whatever the machine's speed: the calls of Python functions that it takes."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from types import FrameType


class Calls:
    """Number of calls so far."""

    count = 0


@contextlib.contextmanager
def counted_calls() -> Iterator[Calls]:
    """Count the calls of this thread, generators that go on among them, from now to the end."""
    calls = Calls()

    def note(_frame: FrameType, event: str, _argument: object) -> None:
        calls.count += event == "call"

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        yield calls
    finally:
        sys.setprofile(before)
