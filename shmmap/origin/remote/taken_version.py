# SPDX-License-Identifier: Apache-2.0
"""Which version of a published map was taken: it is served from then on, whatever the origin says later.

This is state, not cache: it says what may be taken next, and it holds the root, so that a vehicle starts
without a link.  Each instance, URL and root of trust has a file ``DIRECTORY/origins/<name>.taken``, the name
being the first 32 hex digits of the SHA-256 of the MessagePack array [instance, URL, root of trust]::

    0   8   "SHMTAKEN"
    8   4   u32 version of this format, little-endian: 1
    12  n   MessagePack map: the fields of `TakenVersion`, root as bin
    end 32  SHA-256 of all bytes before
"""

from __future__ import annotations

import contextlib
import datetime
import os
import struct
import time
from hashlib import sha256
from typing import Final, NamedTuple

import msgspec

from shmmap.failpoints import step
from shmmap.formats.durable_file import appearing_file, flush_directory, writing_errors
from shmmap.origin.remote.map_versions import Current
from shmmap.origin.remote.published_index import MAX_ROOT_BYTES

__all__ = ["Judgement", "TakenVersion", "TakenVersionFile", "judge_offer"]

_MAGIC: Final = b"SHMTAKEN"
_FORMAT: Final = 1
_HEAD: Final = struct.Struct("<8sI")
_HASH_BYTES: Final = 32
_MAX_BYTES: Final = MAX_ROOT_BYTES + (1 << 16)


class TakenVersion(msgspec.Struct, frozen=True):
    """A version that was taken.

    Attributes
    ----------
    instance, url, trust
        Of the daemon; of the store (`Store.url`); SHA-256 of the trusted root in hex, empty without one.
    version
        Its number.
    root
        The root's object, as it was fetched.
    taken_s
        When it was taken, Unix time.
    signed_s
        When the metadata that was last verified was signed, Unix time; 0: none was.
    expires_s
        When its signature expires, Unix time; 0: it is not signed.
    """

    instance: str
    url: str
    trust: str
    version: int
    root: bytes
    taken_s: float
    signed_s: float = 0.0
    expires_s: float = 0.0

    @property
    def current(self) -> Current:
        """What ``CURRENT`` said of it."""
        return Current(self.version, sha256(self.root).hexdigest(), len(self.root))


# made here, once: msgspec ends the process if threads are the first to decode a type at the same time
_DECODER: Final = msgspec.msgpack.Decoder(TakenVersion)


class TakenVersionFile:
    """Where the taken version of one instance, URL and root of trust is kept.

    Parameters
    ----------
    directory
        State directory of the instance; made when the first version is taken.

    Attributes
    ----------
    problem
        Why `load` returned nothing although something was taken, for ``health``; else empty.
    """

    def __init__(self, directory: str, instance: str, url: str, trust: str = "") -> None:
        self._of = (instance, url, trust)
        name = sha256(msgspec.msgpack.encode(self._of)).hexdigest()[:32]
        self.path = os.path.join(directory, "origins", f"{name}.taken")
        self.problem = ""

    def load(self) -> TakenVersion | None:
        """Return what was taken, which is what a start serves; None if nothing was, or it cannot be read.

        A file that is damaged, or of a later format, is kept beside under another name: `problem` says which.
        """
        self.problem = ""
        try:
            self._remove_interim()
            fd = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
            with open(fd, "rb") as file:
                data = file.read(_MAX_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            self.problem = f"{self.path}: {error.strerror}"
            return None
        try:
            return self._unpack(data)
        except ValueError as error:
            self.problem = f"{self.path}: {error}; {self._set_aside()}"
            return None

    def save(self, taken: TakenVersion) -> None:
        """Keep what was taken, on the disk when this returns.

        A process killed meanwhile leaves the one before, or this one.

        Raises
        ------
        CannotWrite
            It cannot be written; the one before stays.
        """
        body = _HEAD.pack(_MAGIC, _FORMAT) + msgspec.msgpack.encode(taken)
        with writing_errors(self.path):
            directory = os.path.dirname(self.path)
            os.makedirs(directory, mode=0o700, exist_ok=True)
            with appearing_file(self.path) as file:
                file.write(body)
                step("taken.head")
                file.write(sha256(body).digest())
                step("taken.written")
            step("taken.named")

    def _unpack(self, data: bytes) -> TakenVersion:
        """Read the file; ValueError says what is wrong with it."""
        if len(data) > _MAX_BYTES:
            raise ValueError("it is too large")
        if len(data) < _HEAD.size + _HASH_BYTES or data[:8] != _MAGIC:
            raise ValueError("it is no state of a taken version")
        _, version = _HEAD.unpack_from(data)
        body = memoryview(data)[:-_HASH_BYTES]
        if sha256(body).digest() != data[-_HASH_BYTES:]:
            raise ValueError("it is damaged")
        if version != _FORMAT:
            raise ValueError(f"its format is {version}, this program reads {_FORMAT}")
        try:
            taken = _DECODER.decode(body[_HEAD.size :])
        except msgspec.MsgspecError as error:
            raise ValueError(f"it is not what it should be: {error}") from None
        if (taken.instance, taken.url, taken.trust) != self._of:
            raise ValueError(f"it is of {taken.url}, instance {taken.instance}")
        return taken

    def _remove_interim(self) -> None:
        """Remove what a killed process left half written."""
        directory, name = os.path.split(self.path)
        for left in os.listdir(directory):
            if left.startswith(f".{name}.") and left.endswith(".tmp"):
                os.unlink(os.path.join(directory, left))

    def _set_aside(self) -> str:
        aside = f"{self.path}.{time.time_ns()}.unreadable"
        try:
            os.rename(self.path, aside)
            with contextlib.suppress(OSError):
                flush_directory(os.path.dirname(aside))
        except OSError as error:
            return f"it cannot be renamed: {error.strerror}"
        return f"it is kept as {aside}"


class Judgement(NamedTuple):
    """Whether an offered version is taken.

    Attributes
    ----------
    is_taken
        It is: its root is fetched, saved, and then served.
    problem, hint
        What is wrong with the offer, for ``health``, and what to do about it; empty if nothing is.
    cause
        Short name of the problem: ``older`` or ``altered``.
    """

    is_taken: bool
    problem: str = ""
    hint: str = ""
    cause: str = ""


def judge_offer(taken: TakenVersion | None, offered: Current, *, accept: int = 0) -> Judgement:
    """Judge the version that an origin offers; what was taken is served meanwhile, whatever comes out.

    The first one is taken, then those with a greater number.  The same one is no news.

    Parameters
    ----------
    accept
        The number that a person accepts although it is lower; 0: none.
    """
    if taken is None or offered.version > taken.version:
        return Judgement(True)
    when = datetime.datetime.fromtimestamp(taken.taken_s, datetime.timezone.utc)
    before = f"version {taken.version}, which was taken on {when:%Y-%m-%d at %H:%M} UTC"
    if offered.version == taken.version:
        if offered.root == taken.current.root:
            return Judgement(False)
        return Judgement(
            False,
            f"{taken.url} offers another map as {before}: it is not taken",
            "a map that is published gets a number of its own: publish it again",
            "altered",
        )
    if offered.version == accept:
        return Judgement(True)
    return Judgement(
        False,
        f"{taken.url} offers version {offered.version}, older than {before}: it is not taken",
        f"if it is meant, --accept-version {offered.version}; `shmmap versions --rollback` gives an older map"
        " a greater number",
        "older",
    )
