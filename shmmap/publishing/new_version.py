# SPDX-License-Identifier: Apache-2.0
"""Steps that publishing, joining and restoring share: they send or check objects, then switch the version.

The objects of the version are sent or checked between `begin_version` and `switch_version`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from hashlib import sha256
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from shmmap.errors import CannotWrite, error_from_wire
from shmmap.failpoints import step
from shmmap.origin.remote.map_versions import (
    CurrentState,
    Entry,
    add_version,
    read_current,
    refuse_if_signed,
    require_served,
)
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.store import Store
from shmmap.origin.remote.zstd_frame import pack_frame
from shmmap.prepare.task_pool import CellTask, TaskPool
from shmmap.publishing.messages import (
    TASKS_AHEAD,
    CellSent,
    NotSent,
    WorkerSettings,
    decode_sent,
)

if TYPE_CHECKING:
    from shmmap.publishing.signing import MapSigner

CONCURRENT_REQUESTS: Final = 32
_YOUNG_S: Final = 86_400.0
"""Age below which an existing object is reused even if no version has it; pruning spares it much longer."""


def send_object(store: Store, path: str, frame: bytes, *, look: bool = True) -> bool:
    """Send an object unless the store has it, and return whether it was sent.

    Parameters
    ----------
    look
        Whether to check first if the store has the object.
    """
    if look:
        found = store.head(path)
        if found is not None and found.size == len(frame) and abs(time.time() - found.modified_s) < _YOUNG_S:
            return False
    step("publish.send")
    store.put(path, frame)
    return True


class SentObject(NamedTuple):
    """An object of the store: its SHA-256 and size, and the number of bytes sent; 0: the store had it."""

    sha256: bytes
    size: int
    sent_bytes: int


def send_packed(store: Store, unpacked: bytes, *, look: bool = True) -> SentObject:
    """Pack an object and send it as `send_object` does."""
    frame = pack_frame(unpacked)
    digest = sha256(frame).digest()
    is_new = send_object(store, blob_path(digest), frame, look=look)
    return SentObject(digest, len(frame), len(frame) * is_new)


def absent_objects(
    store: Store, objects: Iterable[tuple[bytes, int]], threads: Executor, *, since_s: float = 0.0
) -> list[bytes]:
    """Return the hashes of the objects, given by hash and size, that are missing in the store.

    Parameters
    ----------
    since_s
        Unix time; objects written earlier also count as missing.
    """

    def is_absent(named: tuple[bytes, int]) -> bool:
        found = store.head(blob_path(named[0]))
        return found is None or found.size != named[1] or found.modified_s < since_s

    asked = list(objects)
    absent = threads.map(is_absent, asked)
    return [digest for digest, _ in itertools.compress(asked, absent)]


def run_workers(
    module: str,
    settings: WorkerSettings,
    tasks: Iterator[CellTask],
    workers: int,
    *,
    finished: Callable[[CellTask, CellSent | NotSent], None],
    died: Callable[[CellTask, str], None],
) -> None:
    """Run workers of ``module``, which make and send layers of cells, until all tasks are done.

    Parameters
    ----------
    finished
        Called with each task and its result.
    died
        Called with a task of which two workers died, and a description of the second crash.

    Raises
    ------
    ShmmapError
        The store refuses an object, and so would refuse all others.
    """

    def answered(task: CellTask, done: CellSent | NotSent) -> None:
        if isinstance(done, NotSent) and not done.layer:
            raise error_from_wire(done.code, done.message, done.hint)
        finished(task, done)

    pool: TaskPool[CellTask, CellSent | NotSent] = TaskPool(
        module,
        [msgspec.json.encode(settings).decode()],
        workers=workers,
        decode=decode_sent,
        finished=answered,
        died=died,
        ahead=TASKS_AHEAD,
    )
    pool.run(tasks)


_MAX_RUN_S: Final = 86_400.0  # so that reused objects do not reach the age at which pruning removes them


def begin_version(store: Store, signer: MapSigner | None, verb: str) -> CurrentState:
    """Return the current version, which the new one replaces.

    Parameters
    ----------
    signer
        Signs the new version; None for a map that is not signed.
    verb
        Action that needs the keys, for the hint: ``"publish it"``.

    Raises
    ------
    BadRequest
        The map is signed and there is no signer.
    CannotWrite
        The store cannot switch versions safely.
    """
    store.require_conditions()
    if signer is not None:
        seen = signer.begin()
    else:
        refuse_if_signed(store, f"{verb} with the keys that signed it: --sign KEYDIR")
        seen = read_current(store)
    store.require_conditions(seen.tag)
    return seen


def refuse_if_late(began_s: float, what: str, hint: str) -> None:
    """Raise `CannotWrite` if more than a day has passed since ``began_s`` (`time.monotonic`)."""
    if time.monotonic() - began_s > _MAX_RUN_S:
        raise CannotWrite(f"{what} took longer than a day: the version is not made current", hint=hint)


def switch_version(store: Store, entry: Entry, seen: CurrentState, signer: MapSigner | None) -> None:
    """Make an entry's version current; raise `InstanceBusy` if ``seen`` is no longer current.

    Then read it back, as a store may say that it did what it did not.
    """
    if signer is None:
        add_version(store, entry, seen)
    else:
        signer.switch(entry)
    require_served(store, entry.current)
