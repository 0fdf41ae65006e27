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
from itertools import starmap
from typing import Any

__all__ = ["Owned"]


class Owned:
    """One thing that a built-in function gives and another one takes back when this object ends.

    Parameters
    ----------
    given
        Yields one tuple, whose first is the thing: a `zip` of a `map` of the built-in function that gives it.
    take_back
        Built in, too; is called with what is in the tuple, once, and then returns None or 0.

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

    def __init__(self, given: Iterable[tuple[Any, ...]], take_back: Callable[..., Any]) -> None:
        kept: list[tuple[Any, ...]] = []
        # each in the list is taken back once, since an iterator is at an end after that
        self.__del__ = partial(any, starmap(take_back, kept))
        kept.extend(given)
        self.value = kept[0][0]

    def keep(self, take_back: Callable[[], object]) -> None:
        """Need less memory from now on: ``take_back``, built in, does all when this object ends."""
        self.__del__ = take_back

    def give_back(self) -> None:
        """Give it back now, not only when this object ends; not after `keep`."""
        self.__del__()

    def end(self) -> None:
        """Give it back now, whoever else still has this object; in a thread that runs no signal handlers."""
        take_back, self.__del__ = self.__del__, bool  # which does nothing
        take_back()
