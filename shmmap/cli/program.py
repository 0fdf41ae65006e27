# SPDX-License-Identifier: Apache-2.0
"""What all programs of the package share: error messages, exit codes, interrupts, output files."""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # `signal` takes 2 ms to import
import argparse
import contextlib
import errno
import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn, TextIO

from shmmap.cli.compiling_lines import CompilingLines
from shmmap.compile_notices import watch
from shmmap.errors import CannotWrite, InternalError, ShmmapError, ShmmapWarning
from shmmap.formats.durable_file import writing_errors
from shmmap.private_directory import open_output

_EXIT_INTERRUPTED: Final = 130  # 128 + SIGINT, as in a shell

_EXIT_BROKEN_PIPE: Final = 141  # 128 + SIGPIPE, as in a shell

_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_LATER_S: Final = 0.005
"""Seconds after which a callback that a signal has interrupted has usually ended."""
_AGAIN_S: Final = 0.02
"""Seconds until the next try, if the callback has not ended yet."""
_NEGATIVE_NUMBERS: Final = re.compile(r"-[\d.][\d.eE+,\-]*|-inf(,.*)?")


class Parser(argparse.ArgumentParser):
    """Argument parser whose error messages look like the program's others: the problem, then a hint."""

    def __init__(self, **settings: Any) -> None:
        # an abbreviation may become ambiguous when options are added
        super().__init__(**settings, allow_abbrev=False)
        self._words: list[str] = []

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse; each verb rejects its own unknown words, so that the hint names the help of that verb."""
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

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse ignores errors of writing here, so that help for a full disk would be lost with exit code 0
        if message:
            stream = file or sys.stderr
            stream.write(message)
            stream.flush()

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            self._refuse(f"there is no {str(action.metavar).lower()} {value!r}", str(value), action.choices)
        super()._check_value(action, value)

    def _refuse(self, message: str, word: str, known: Iterable[str] | None = None) -> NoReturn:
        import difflib  # takes 6 ms to import: only for mistakes

        near = difflib.get_close_matches(word, known or self._option_string_actions, n=1)
        self.error(f"{message}; did you mean {near[0]}?" if near else message)

    def error(self, message: str) -> NoReturn:
        """Report a mistake on the command line and exit; a misspelt option is reported first."""
        words, self._words = self._words, []
        options = (word for word in words if word.startswith("--") and len(word) > len("--"))
        unknown = [word for word in options if word.split("=")[0] not in self._option_string_actions]
        missing = message.endswith("required") or message.startswith(
            "the following arguments are required: -"
        )
        if unknown and missing:  # a required option may be missing only because it is misspelt
            self._refuse_unknown(unknown)
        complain(self.prog, message, f"{self.prog} --help")
        sys.exit(2)


def join_negative_values(words: Sequence[str], options: Container[str] | None = None) -> list[str]:
    """Write ``--circle -5,3,40`` as ``--circle=-5,3,40``, for ``options``; if None, for all options.

    Otherwise argparse reads a word that starts with a minus as an option, unless the word is one number.
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
    """Run a program and return its exit code; print its errors on stderr."""
    _open_what_is_closed()
    _write_all_letters()
    _outlive_full_stderr()
    watch(CompilingLines(name))
    _show_warnings(name)
    try:
        with interrupts_kept():
            code = _flushed(run)
    except ShmmapError as error:
        complain(name, error.message, error.hint)
        return error.exit_code
    except BrokenPipeError:
        _drop_output()
        return _EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED
    except Exception as error:  # noqa: BLE001
        if isinstance(error, OSError) and error.errno == errno.EIO and error.filename is None:
            _drop_output()  # of a terminal that is gone
            return _EXIT_BROKEN_PIPE
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


def _flushed(run: Callable[[], int]) -> int:
    """Run a program and write what it printed, also if it ended early, as for ``--help``."""
    try:
        code = run()
    except SystemExit:
        sys.stdout.flush()
        raise
    sys.stdout.flush()
    return code


def check_terminal(*, was_there: bool) -> None:
    """End a program that shows something without end, if the terminal on stdout is gone.

    Its session may be ended without a SIGHUP, or the program may ignore that.

    Raises
    ------
    BrokenPipeError
        The terminal is gone; output is discarded from now on.
    """
    if was_there and not sys.stdout.isatty():
        _drop_output()
        raise BrokenPipeError


def _show_warnings(name: str) -> None:
    """From now on print a `ShmmapWarning` as its text alone: a line of the library means nothing here."""
    before = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if not issubclass(category, ShmmapWarning):
            before(message, category, filename, lineno, file, line)
            return
        from shmmap.cli.screens.output import print_line

        first, *more = str(message).splitlines()
        for text in (f"{name}: {first}", *more):
            print_line(text, file=sys.stderr)

    warnings.showwarning = show


def _open_what_is_closed() -> None:
    """Redirect to the null device stdout and stderr that were closed when this process was started."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def _write_all_letters() -> None:
    """Let stdout show ``?`` for letters that the locale's encoding lacks: no name may end a program."""
    encoding = sys.stdout.encoding or ""
    if encoding.lower() not in ("utf-8", "utf8") and isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


class _Stderr(io.TextIOWrapper):
    """Stderr that discards what does not fit: a full disk with a log of progress must not end the work."""

    before: TextIO  # the stream that it replaces, which would close the file

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._drop_if_full(error)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._drop_if_full(error)

    def _drop_if_full(self, error: OSError) -> None:
        if error.errno not in _FULL:
            raise error
        _drop_output(self)


def _outlive_full_stderr() -> None:
    """Make stderr a `_Stderr`, unless it was replaced already, as by tests."""
    before = sys.stderr
    if type(before) is io.TextIOWrapper:
        sys.stderr = made = _Stderr(
            before.buffer, encoding=before.encoding, errors=before.errors, line_buffering=True
        )
        made.before = before


def _drop_output(stream: TextIO | None = None) -> None:
    """Discard what stdout, or another stream, buffers or gets, since the interpreter flushes it at exit."""
    with open(os.devnull, "wb") as null:
        os.dup2(null.fileno(), (stream or sys.stdout).fileno())


def complain(name: str, message: str, hint: str = "") -> None:
    """Print an error and what can be done about it on stderr."""
    from shmmap.cli.screens.output import print_line  # takes 5 ms to import: only for error messages

    print_line(f"{name}: {message}", file=sys.stderr)
    if hint:
        print_line(f"hint: {hint}", file=sys.stderr)


@contextlib.contextmanager
def hint_if_interrupted(hint: str) -> Iterator[None]:
    """Say on stderr how an interrupted run can be continued."""
    try:
        yield
    except KeyboardInterrupt:
        complain("shmmap", "interrupted", hint)
        raise


def add_allow_empty(parser: argparse.ArgumentParser) -> None:
    """Add ``--allow-empty``."""
    parser.add_argument("--allow-empty", action="store_true", help="exit with 0 also when nothing is found")


def nothing_found(args: argparse.Namespace, message: str, hint: str = "", *, name: str = "shmmap") -> int:
    """Report that nothing was found; return the exit code: 1, or 0 with ``--allow-empty``.

    The code is 1 by default so that a script does not take empty output for a result.
    """
    complain(name, message, hint)
    return 0 if args.allow_empty else 1


@contextlib.contextmanager
def interrupts_kept() -> Iterator[None]:
    """Repeat interrupts and exits that Python would ignore (`KeyboardInterrupt`, `SystemExit`).

    Raised in a weak reference's callback or in a finalizer, they only make Python print "Exception ignored
    in", and the program goes on (https://github.com/python/cpython/issues/95959).  Each import ends with such
    a callback, and verbs import much when they run: it happened to one of 40 interrupts at random moments of
    ``tail``, and to one of 40 at random calls of ``divide``.
    """
    before, number = sys.unraisablehook, 0

    def ignored(what: Any) -> None:
        nonlocal number
        if not issubclass(what.exc_type, KeyboardInterrupt | SystemExit):
            before(what)
            return
        number = signal.SIGINT if issubclass(what.exc_type, KeyboardInterrupt) else signal.SIGTERM
        signal.signal(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, _LATER_S)

    def again(_alarm: int, frame: FrameType | None) -> None:
        while frame is not None and frame.f_code is not ignored.__code__:
            frame = frame.f_back
        if frame is None:
            signal.raise_signal(number)
        else:  # raised here, it would be lost
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

    sys.unraisablehook = ignored
    try:
        yield
    finally:
        sys.unraisablehook = before
        if number:
            signal.setitimer(signal.ITIMER_REAL, 0.0)  # at the interpreter's end it would kill the process


def output_file(text: str) -> Path:
    """Parse the name of an output file; check before the work begins that it can be written.

    Raises
    ------
    CannotWrite
        The directory does not exist, or the directory or the file is not writable.
    """
    path = Path(text)
    with writing_errors(str(path)):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        try:
            os.stat(os.path.join(path.parent, "."))  # a directory, which exists
        except OSError as error:
            error.filename = text  # the name that the caller knows
            raise
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), text)
    return path


def write_text(path: Path, text: str) -> None:
    """Write a text file; raise `CannotWrite` if that fails."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file; raise `CannotWrite` if that fails, or another account has made a link of that name."""
    with writing_errors(str(path)), open(open_output(path), "wb") as file:
        file.write(data)
