# SPDX-License-Identifier: Apache-2.0
"""Stores the accepted (*taken*) version of a published map, which is served until a newer one is taken.

This is state, not cache: it decides which versions may be taken next, and contains the root, so that a
vehicle can start offline.  Each instance, URL and root of trust has a file
``DIRECTORY/origins/<name>.taken``, the name being the first 32 hex digits of the SHA-256 of the MessagePack
array [instance, URL, root of trust]::

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
from typing import Final

import msgspec

from shmmap.errors import MapDataError
from shmmap.failpoints import step
from shmmap.formats.durable_file import appearing_file, flush_directory, writing_errors
from shmmap.origin.remote.map_versions import Current
from shmmap.origin.remote.published_index import MAX_ROOT_BYTES
from shmmap.private_directory import NotPrivate, require_private

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
        Name of the daemon's instance; URL of the store (`Store.url`); SHA-256 of the trusted root in hex,
        empty without a root of trust.
    version
        Number of the version.
    root
        Object of the version's root, as fetched.
    taken_s
        Time at which the version was taken, Unix time.
    signed_s
        Time at which the last verified metadata was signed, Unix time; 0: none was verified.
    expires_s
        Expiry of the signature, Unix time; 0: the version is not signed.
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
        """Content of ``CURRENT`` for this version."""
        return Current(self.version, sha256(self.root).hexdigest(), len(self.root))


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_DECODER: Final = msgspec.msgpack.Decoder(TakenVersion)


class TakenVersionFile:
    """File that keeps the taken version of one instance, URL and root of trust.

    Parameters
    ----------
    directory
        State directory of the instance; created when the first version is taken.

    Attributes
    ----------
    problem
        Why `load` returned None although a version had been taken, for ``health``; else empty.
    """

    def __init__(self, directory: str, instance: str, url: str, trust: str = "") -> None:
        self._of = (instance, url, trust)
        name = sha256(msgspec.msgpack.encode(self._of)).hexdigest()[:32]
        self.path = os.path.join(directory, "origins", f"{name}.taken")
        self.problem = ""

    def load(self) -> TakenVersion | None:
        """Return the taken version, which a starting daemon serves; None if there is none that can be read.

        A file that is damaged, or of a later format, is renamed and kept; `problem` gives its new name.
        """
        self.problem = ""
        try:
            require_private(os.path.dirname(self.path), make=0)
            self._remove_interim()
            fd = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
            with open(fd, "rb") as file:
                data = file.read(_MAX_BYTES + 1)
        except FileNotFoundError:
            return None
        except NotPrivate as error:
            self.problem = f"{error.filename}: {error.strerror} ({error.hint})"
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
        """Write the taken version; it is flushed to the disk when this returns.

        If the process is killed meanwhile, the file contains either the previous version or this one.

        Raises
        ------
        CannotWrite
            The file cannot be written; the previous version stays.
        """
        body = _HEAD.pack(_MAGIC, _FORMAT) + msgspec.msgpack.encode(taken)
        with writing_errors(self.path):
            require_private(os.path.dirname(self.path))
            with appearing_file(self.path) as file:
                file.write(body)
                step("taken.head")
                file.write(sha256(body).digest())
                step("taken.written")
            step("taken.named")

    def _unpack(self, data: bytes) -> TakenVersion:
        """Decode the file; raise ValueError with the reason if it is malformed."""
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
        """Remove half-written files of killed processes."""
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


def refusal_of(taken: TakenVersion | None, offered: Current, *, accept: int = 0) -> MapDataError | None:
    """Return why the version that an origin offers is refused; None if it may be taken, or was.

    The first version is taken, then every version with a greater number.  The same version changes nothing.

    Parameters
    ----------
    accept
        A lower number that the user accepts; 0: none.

    Returns
    -------
    The error, whose cause is ``older`` or ``altered``.
    """
    if taken is None or offered.version > taken.version:
        return None
    when = datetime.datetime.fromtimestamp(taken.taken_s, datetime.timezone.utc)
    before = f"version {taken.version}, which was taken on {when:%Y-%m-%d at %H:%M} UTC"
    if offered.version == taken.version:
        if offered.root == taken.current.root:
            return None
        return MapDataError(
            f"{taken.url} offers another map as {before}: it is not taken",
            cause="altered",
            hint="a map that is published gets a number of its own: publish it again",
        )
    if offered.version == accept:
        return None
    return MapDataError(
        f"{taken.url} offers version {offered.version}, older than {before}: it is not taken",
        cause="older",
        hint=f"if it is meant, --accept-version {offered.version}; `shmmap versions --rollback` gives an"
        " older map a greater number",
    )
