# SPDX-License-Identifier: Apache-2.0
"""What the kernel gave and must get back, whatever exception a signal handler raises wherever.

Python runs signal handlers between the steps of its interpreter, as a rule after a call.  So a handler's
exception may come when a function has returned a descriptor and nobody has it yet; or at the first step of a
``__del__`` written in Python, which then does nothing.  Between functions that are built in and call each
other no handler runs: taking, keeping and giving back are made of those alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

__all__ = ["Owned"]


class Owned:
    """One thing that a built-in function gives and another one takes back when this object ends.

    Parameters
    ----------
    given
        Yields the thing: a `map` of the built-in function that gives it.
    take_back
        Built in, too; is called with the thing, once, and then returns None or 0.
    more
        Further arguments of ``take_back``.

    Attributes
    ----------
    value
        What was given.

    Raises
    ------
    Exception
        What the giving function raises.
    """

    __slots__ = ("__del__", "__weakref__", "value")

    __del__: Callable[[], object]  # in a slot: what Python calls is built in, and no function of ours

    def __init__(self, given: Iterable[Any], take_back: Callable[..., Any], *more: Any) -> None:
        kept: list[Any] = []
        # each thing in the list is taken back once, since a map is at an end after that
        self.__del__ = partial(any, map(take_back, kept, *((one,) for one in more)))
        kept.extend(given)
        self.value = kept[0]

    def give_back(self) -> None:
        """Give it back now, not only when this object ends."""
        self.__del__()
