# SPDX-License-Identifier: Apache-2.0
"""Reads a map in a separate process (`shmmap.origin.reread`).

To read a million cells, Python code holds the interpreter lock for seconds and takes memory that it never
returns to the system.  To parse a number of ten million digits takes a third of a second, during which no
other thread runs.  The process writes its result into a pipe: an error, or the catalogue.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import sys
from collections.abc import Sequence
from typing import Final

import msgspec

from shmmap.errors import MapDataError, ShmmapError, error_from_wire
from shmmap.installed import refuse_if_replaced
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.catalogue_bytes import read_catalogue
from shmmap.processes.start_child import how_ended
from shmmap.processes.start_program import start_program

_PIPE_BYTES: Final = 1 << 20
"""The largest pipe that every user may have; a larger pipe needs fewer reads."""
_PROGRAM: Final = """\
import os, sys
os.chdir("/")  # nothing is imported from this process's directory
from shmmap.origin.reread import main
sys.exit(main(sys.argv[1:]))
"""


class Outcome(msgspec.Struct):
    """First line of the process's output: an error as in replies, or empty if the catalogue follows."""

    error: str = ""
    message: str = ""
    hint: str = ""
    path: str = ""
    offset: int | None = None
    cause: str = ""

    @classmethod
    def of(cls, error: ShmmapError) -> Outcome:
        """Return the outcome that describes an error."""
        found = cls(error.code, error.message, error.hint)
        if isinstance(error, MapDataError):
            found.path, found.offset, found.cause = error.path, error.offset, error.cause
        return found

    def raised(self) -> ShmmapError:
        """Return the error that this outcome describes."""
        error = error_from_wire(self.error, self.message, self.hint)
        if isinstance(error, MapDataError):
            error.path, error.offset, error.cause = self.path, self.offset, self.cause
        return error


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_OUTCOME: Final = msgspec.json.Decoder(Outcome)


def read_apart(
    map_path: str, words: str, before: Catalogue | None, descriptors: Sequence[int] = ()
) -> Catalogue:
    """Read a map in a separate process.

    Parameters
    ----------
    map_path
        Path of the map, for messages.
    words
        Argument for the process, as JSON: a `MapDirectory`, and the descriptors of its directories by path.
    before
        An earlier state; unchanged tables are shared with it.
    descriptors
        Descriptors of the directories; the process inherits them under the same numbers.

    Raises
    ------
    ShmmapError
        The error that the process reported, or that it could not be started or ended early.
    """
    refuse_if_replaced("shmmap.origin.reread")
    paths = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": paths}
    known = f"{before.fixed_digest:016x}" if before is not None else ""
    command = [sys.executable, "-c", _PROGRAM, str(os.getpid()), words, known]
    ours, theirs = os.pipe2(os.O_CLOEXEC)
    with open(ours, "rb") as pipe:
        try:
            with contextlib.suppress(OSError):  # this user's pipes are large already
                fcntl.fcntl(ours, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
            pid = start_program(command, environment, theirs, descriptors)
        except OSError as error:
            raise not_started(map_path, "reads", error) from error
        finally:
            os.close(theirs)
        try:
            if line := pipe.readline():
                outcome = _OUTCOME.decode(line)
                if outcome.error:
                    raise outcome.raised()
                return read_catalogue(pipe, before=before)[1]
        except (ValueError, msgspec.MsgspecError):  # the process ended before it had written everything
            pass
        finally:
            os.kill(pid, signal.SIGKILL)
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    raise ended_early(map_path, "reads", code)


def not_started(what: str, does: str, error: OSError) -> ShmmapError:
    """Return the error for a process that cannot be started; it ``does`` something with ``what``."""
    return ShmmapError(
        f"{what}: cannot start a process that {does} it: {error.strerror}",
        hint="raise the limit of processes or memory (TasksMax=, ulimit -u, MemoryMax=)",
    )


def ended_early(what: str, does: str, code: int) -> ShmmapError:
    """Return the error for a process that ended with ``code`` before it had answered."""
    return ShmmapError(
        f"{what}: the process that {does} it ended with {how_ended(code)}",
        hint="was it killed, or is its memory too small?",
    )
