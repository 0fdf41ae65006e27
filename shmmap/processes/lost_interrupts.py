# SPDX-License-Identifier: Apache-2.0
"""An interrupt that comes while Python runs a weak reference's callback or a finalizer is not lost.

Python prints "Exception ignored in" there, and goes on: of those sent while modules are imported, one in
ten (https://github.com/python/cpython/issues/95959).  What was ignored is signalled again a moment later.
"""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # `signal` takes 2 ms to import
import sys
from types import FrameType
from typing import Any, Final

__all__ = ["keep_interrupts"]

LATER_S: Final = 0.005
"""By then the callback is over, as a rule."""
AGAIN_S: Final = 0.02
"""By then it is, where it was not."""


def keep_interrupts() -> None:
    """Have ends that Python ignores (`KeyboardInterrupt`, `SystemExit`) signalled again, in this process."""
    before = sys.unraisablehook

    def ignored(what: Any) -> None:
        if not issubclass(what.exc_type, KeyboardInterrupt | SystemExit):
            before(what)
            return
        number = signal.SIGINT if issubclass(what.exc_type, KeyboardInterrupt) else signal.SIGTERM

        def again(_alarm: int, frame: FrameType | None) -> None:
            while frame is not None and frame.f_code is not ignored.__code__:
                frame = frame.f_back
            if frame is None:
                signal.raise_signal(number)
            else:  # in here Python would ignore it for good
                signal.setitimer(signal.ITIMER_REAL, AGAIN_S)

        signal.signal(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, LATER_S)

    sys.unraisablehook = ignored
