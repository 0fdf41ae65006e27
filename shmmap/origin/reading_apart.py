# SPDX-License-Identifier: Apache-2.0
"""Reading a map in a process of its own (`shmmap.origin.reread`).

Python's share of reading a million cells takes seconds of the interpreter, and memory that is not given
back.  A number of ten million digits takes a third of a second to parse, while no other thread runs at all.
What the process finds comes through a pipe: an error, or the catalogue.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import IO, Final, cast

import msgspec

from shmmap.errors import MapDataError, ShmmapError, error_from_wire
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.catalogue_bytes import read_catalogue
from shmmap.processes.start_child import how_ended

__all__ = ["Outcome", "ended_early", "not_started", "read_apart"]

_PIPE_BYTES: Final = 1 << 20
"""As much as every user may have: the reader needs a turn each time that the pipe is full."""


class Outcome(msgspec.Struct):
    """The first line that the process writes: an error, as replies have it, or empty; then the catalogue."""

    error: str = ""
    message: str = ""
    hint: str = ""
    path: str = ""
    offset: int | None = None
    cause: str = ""

    @classmethod
    def of(cls, error: ShmmapError) -> Outcome:
        """Describe an error."""
        found = cls(error.code, error.message, error.hint)
        if isinstance(error, MapDataError):
            found.path, found.offset, found.cause = error.path, error.offset, error.cause
        return found

    def raised(self) -> ShmmapError:
        """Return the error that is described."""
        error = error_from_wire(self.error, self.message, self.hint)
        if isinstance(error, MapDataError):
            error.path, error.offset, error.cause = self.path, self.offset, self.cause
        return error


# made here, once: msgspec ends the process if threads are the first to decode a type at the same time
_OUTCOME: Final = msgspec.json.Decoder(Outcome)


def read_apart(
    map_path: str, words: str, before: Catalogue | None, descriptors: Sequence[int] = ()
) -> Catalogue:
    """Read a map in a process of its own.

    Parameters
    ----------
    map_path
        The map, for messages.
    words
        What the process is given, as JSON: a `MapDirectory`, and the descriptors of its directories by path.
    before
        An earlier state: what has not changed is shared with it.
    descriptors
        Of the directories; the process has them by the same numbers.

    Raises
    ------
    ShmmapError
        What the process raised; or there was none, or it ended before it was done.
    """
    paths = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": paths}
    known = f"{before.fixed_digest:016x}" if before is not None else ""
    command = [sys.executable, "-m", "shmmap.origin.reread", str(os.getpid()), words, known]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            cwd="/",
            pipesize=_PIPE_BYTES,
            pass_fds=descriptors,
        )
    except OSError as error:
        raise not_started(map_path, "reads", error) from error
    try:
        with cast("IO[bytes]", process.stdout) as pipe:
            if line := pipe.readline():
                outcome = _OUTCOME.decode(line)
                if outcome.error:
                    raise outcome.raised()
                return read_catalogue(pipe, before=before)[1]
    except (ValueError, msgspec.MsgspecError):  # it did not get to the end
        pass
    finally:
        process.kill()
        process.wait()
    raise ended_early(map_path, "reads", process.returncode)


def not_started(what: str, does: str, error: OSError) -> ShmmapError:
    """Return the error that a process that ``does`` something with ``what`` cannot be started."""
    return ShmmapError(
        f"{what}: cannot start a process that {does} it: {error.strerror}",
        hint="raise the limit of processes or memory (TasksMax=, ulimit -u, MemoryMax=)",
    )


def ended_early(what: str, does: str, code: int) -> ShmmapError:
    """Return the error that such a process ended before it had answered."""
    return ShmmapError(
        f"{what}: the process that {does} it ended with {how_ended(code)}",
        hint="was it killed, or is its memory too small?",
    )
