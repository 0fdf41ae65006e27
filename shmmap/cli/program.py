# SPDX-License-Identifier: Apache-2.0
"""What every program of the package does alike: how it complains, and what becomes of its errors."""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # `signal` takes 2 ms to import
import argparse
import errno
import os
import re
import sys
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn

from shmmap.errors import CannotWrite, InternalError, ShmmapError
from shmmap.formats.durable_file import writing_errors

__all__ = [
    "Parser",
    "add_allow_empty",
    "complain",
    "exit_code_of",
    "join_negative_values",
    "keep_interrupts",
    "nothing_found",
    "output_file",
    "write_text",
    "writing_errors",
]


_EXIT_INTERRUPTED: Final = 130  # 128 + SIGINT, as shells report it

_EXIT_BROKEN_PIPE: Final = 141  # 128 + SIGPIPE

_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_LATER_S: Final = 0.005
"""After this time a callback that a signal has interrupted has usually ended."""
_AGAIN_S: Final = 0.02
"""Time until the next try, if the callback had not ended yet."""
_NEGATIVE_NUMBERS: Final = re.compile(r"-[\d.][\d.eE+,\-]*|-inf(,.*)?")


class Parser(argparse.ArgumentParser):
    """A parser that complains as the rest of the program does: what is wrong, then a hint."""

    def __init__(self, **settings: Any) -> None:
        # an abbreviation that works today would break with tomorrow's options
        super().__init__(**settings, allow_abbrev=False)
        self._words: list[str] = []

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse; each verb refuses the words that it does not know, so that the hint names its help."""
        self._words = list(sys.argv[1:] if args is None else args)
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self._refuse_unknown(unknown)
        return found, unknown

    def _refuse_unknown(self, unknown: Sequence[str]) -> NoReturn:
        word = unknown[0].split("=")[0]
        if word.startswith("-"):
            self._refuse(f"unknown option {word}", word)
        self._refuse(f"unexpected argument: {' '.join(unknown)}", word)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            self._refuse(f"there is no {str(action.metavar).lower()} {value!r}", str(value), action.choices)
        super()._check_value(action, value)

    def _refuse(self, message: str, word: str, known: Iterable[str] | None = None) -> NoReturn:
        import difflib  # 6 ms, for mistakes alone

        near = difflib.get_close_matches(word, known or self._option_string_actions, n=1)
        self.error(f"{message}; did you mean {near[0]}?" if near else message)

    def error(self, message: str) -> NoReturn:
        """Complain about the command line and exit; name a misspelt option first."""
        words, self._words = self._words, []
        options = (word for word in words if word.startswith("--") and len(word) > len("--"))
        unknown = [word for word in options if word.split("=")[0] not in self._option_string_actions]
        missing = message.endswith("required") or message.startswith(
            "the following arguments are required: -"
        )
        if unknown and missing:  # a misspelt option is why another one is missing
            self._refuse_unknown(unknown)
        complain(self.prog, message, f"{self.prog} --help")
        sys.exit(2)


def join_negative_values(words: Sequence[str], options: Container[str] | None = None) -> list[str]:
    """Write ``--circle -5,3,40`` as ``--circle=-5,3,40``, behind these options or else behind all.

    argparse takes a word that starts with a minus for an option unless it is a single number.
    """
    joined: list[str] = []
    for word in words:
        before = joined[-1] if joined else ""
        named = before.startswith("--") and "=" not in before
        takes = before in options if options is not None else named
        if takes and _NEGATIVE_NUMBERS.fullmatch(word):
            joined[-1] = f"{before}={word}"
        else:
            joined.append(word)
    return joined


def exit_code_of(name: str, run: Callable[[], int]) -> int:
    """Run a program to its end and return its exit code; its errors are printed on stderr."""
    _open_what_is_closed()
    keep_interrupts()
    try:
        code = run()
        sys.stdout.flush()
    except ShmmapError as error:
        complain(name, error.message, error.hint)
        return error.exit_code
    except BrokenPipeError:
        _drop_output()
        return _EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        _forget_interrupt()
        return _EXIT_INTERRUPTED
    except Exception as error:  # noqa: BLE001
        if _is_of_interrupt(error):
            _forget_interrupt()
            return _EXIT_INTERRUPTED
        if isinstance(error, OSError) and error.errno in _FULL and error.filename is None:
            _drop_output()
            complain(
                name, f"cannot write the output: {error.strerror}", "free some space, or choose another disk"
            )
            return CannotWrite.exit_code
        import traceback

        traceback.print_exc()
        complain(
            name,
            f"internal error: {type(error).__name__}: {error}",
            "this is a defect in shmmap: please report it with the lines above",
        )
        return InternalError.exit_code
    return code


def _forget_interrupt() -> None:
    """Let the exit code count.

    CPython remembers that `exec` of a text was interrupted, as dataclasses use it while modules are imported,
    and ends ``python -m`` by SIGINT instead, although the interrupt was caught; the next `exec` forgets it.
    """
    exec("")  # noqa: S102


def _is_of_interrupt(error: BaseException) -> bool:
    """Whether an error comes of cleaning up after an interrupt, which came in the middle of a call."""
    context: BaseException | None = error
    while context is not None and not isinstance(context, KeyboardInterrupt):
        context = context.__context__
    return context is not None


def _open_what_is_closed() -> None:
    """Let what is printed go nowhere if stdout or stderr was closed when this process was started."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def _drop_output() -> None:
    """Let what stdout still holds go nowhere: the interpreter flushes it once more at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def complain(name: str, message: str, hint: str = "") -> None:
    """Say on stderr what is wrong, and what can be done about it."""
    from shmmap.cli.screens.output import print_line  # 5 ms, for complaints alone

    print_line(f"{name}: {message}", file=sys.stderr)
    if hint:
        print_line(f"hint: {hint}", file=sys.stderr)


def add_allow_empty(parser: argparse.ArgumentParser) -> None:
    """Add ``--allow-empty``."""
    parser.add_argument("--allow-empty", action="store_true", help="exit with 0 also when nothing is found")


def nothing_found(args: argparse.Namespace, message: str, hint: str = "", *, name: str = "shmmap") -> int:
    """Report once that nothing was found, and return the exit code: 1, or 0 with ``--allow-empty``.

    It is 1 because a script would otherwise take an empty output for a result.
    """
    complain(name, message, hint)
    return 0 if args.allow_empty else 1


def keep_interrupts() -> None:
    """Signal again, in this process, the ends that Python ignores (`KeyboardInterrupt`, `SystemExit`).

    In a weak reference's callback or a finalizer Python prints "Exception ignored in", and goes on: of those
    sent while modules are imported, one in ten (https://github.com/python/cpython/issues/95959).
    """
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
                signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

        signal.signal(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, _LATER_S)

    sys.unraisablehook = ignored


def output_file(text: str) -> Path:
    """Read the name of a file to write, and find out before the work begins that it can be.

    Raises
    ------
    CannotWrite
        There is no such directory, or it or the file may not be written to.
    """
    path = Path(text)
    with writing_errors(str(path)):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        try:
            os.stat(os.path.join(path.parent, "."))  # a directory, and there
        except OSError as error:
            error.filename = text  # the name that the caller knows
            raise
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), text)
    return path


def write_text(path: Path, text: str) -> None:
    """Write a file; what keeps it from being written is `CannotWrite`."""
    with writing_errors(str(path)):
        path.write_text(text, encoding="utf-8")
