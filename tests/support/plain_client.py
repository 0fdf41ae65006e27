# SPDX-License-Identifier: Apache-2.0
"""A client with neither a ZeroMQ nor a MessagePack library, by PROTOCOL.md and LAYOUT.md alone."""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import re
import socket
import stat
import struct
import time
import zlib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any, Final

from tests.support.message_pack import pack, unpack
from tests.support.segment_reader import SegmentBytes, parse

PROTOCOL: Final = files("shmmap.protocol").joinpath("PROTOCOL.md").read_text(encoding="utf-8")

_MORE, _LONG, _COMMAND = 1, 2, 4
_PAGE: Final = 4096
_TAIL: Final = 72
_OFD_SETLK: Final = 37


class Refused(Exception):
    """An ``error`` reply."""

    def __init__(self, request: int, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.request = request
        self.code = code


class Stale(Exception):
    """A handle's segment is gone: ask the daemon again."""


def documented_bytes(name: str) -> bytes:
    """Bytes that the page's block of hexadecimal gives a name."""
    (row,) = re.findall(rf"^{name} +((?:[0-9a-f]{{2}})[0-9a-f ]*)(?: and (\d+) bytes 00)?$", PROTOCOL, re.M)
    return bytes.fromhex(row[0]) + bytes(int(row[1] or 0))


def socket_paths(environ: Mapping[str, str]) -> list[str]:
    """Paths to try, in order ("Finding the daemon")."""
    endpoint = environ.get("SHMMAP_ENDPOINT", "").removeprefix("ipc://")
    if endpoint:
        return [os.path.join(os.getcwd(), endpoint)]
    name = (environ.get("SHMMAP_INSTANCE") or "default") + ".sock"
    if directory := environ.get("SHMMAP_RUNTIME_DIR"):
        return [os.path.join(os.getcwd(), directory, name)]
    own = environ.get("XDG_RUNTIME_DIR", "")
    found = [f"{own}/shmmap/{name}"] if own.startswith("/") else []
    with contextlib.suppress(FileNotFoundError):
        status = os.lstat(f"/tmp/shmmap-{os.geteuid()}")
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077:
            found.append(f"/tmp/shmmap-{os.geteuid()}/{name}")
    return [*found, f"/run/shmmap/{name}"]


def connect_first(paths: list[str]) -> socket.socket:
    """Connect to the first path at which a daemon listens."""
    for path in paths:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.connect(path)
        except (FileNotFoundError, NotADirectoryError, ConnectionRefusedError, PermissionError):
            connection.close()
            continue
        return connection
    raise FileNotFoundError(paths)


class PlainClient:
    """One connection; what `hello` answers are its attributes.

    Parameters
    ----------
    path
        Socket, of requests or of events.
    ready
        What the page calls this end's ready.
    """

    def __init__(
        self, path: str | list[str], *, ready: str = "ready of a DEALER", timeout_s: float = 60.0
    ) -> None:
        self.connection = connect_first([path] if isinstance(path, str) else path)
        self.connection.settimeout(timeout_s)
        self.connection.sendall(documented_bytes("greeting") + documented_bytes(ready))
        self._received = b""
        self._request = 0
        self._replies: dict[int, list[Any]] = {}
        self.commands: list[bytes] = []
        greeting = documented_bytes("greeting")
        theirs = self._take(len(greeting))
        assert (theirs[0], theirs[9]) == (0xFF, 0x7F)
        assert theirs[10] >= 3
        assert theirs[12:32] == greeting[12:32]

    def close(self) -> None:
        """End the connection."""
        self.connection.close()

    # --- frames -----------------------------------------------------------------------------------

    def _take(self, count: int) -> bytes:
        while len(self._received) < count:
            part = self.connection.recv(1 << 16)
            if not part:
                raise ConnectionError("the daemon closed the connection")
            self._received += part
        taken, self._received = self._received[:count], self._received[count:]
        return taken

    def send_frame(self, body: bytes, flags: int = 0) -> None:
        """Send a frame."""
        if len(body) < 256:
            self.connection.sendall(bytes((flags, len(body))) + body)
        else:
            self.connection.sendall(bytes((flags | _LONG,)) + len(body).to_bytes(8, "big") + body)

    def frame(self) -> tuple[int, bytes]:
        """Return flags and body of the next frame, whatever it is."""
        flags = self._take(1)[0]
        size = int.from_bytes(self._take(8), "big") if flags & _LONG else self._take(1)[0]
        return flags, self._take(size)

    def message(self) -> Any:
        """Return the next message; commands in between are noted."""
        while True:
            flags, body = self.frame()
            if flags & _COMMAND:
                self.commands.append(body)
                if body[1:5] == b"PING":
                    self.send_frame(b"\x04PONG" + body[7:], _COMMAND)
                continue
            assert not flags & _MORE
            return unpack(body)

    # --- requests ---------------------------------------------------------------------------------

    def send(self, tag: str, *elements: Any) -> int:
        """Send a request; returns its id."""
        self._request += 1
        self.send_frame(pack([tag, self._request, *elements]))
        return self._request

    def reply_to(self, request: int) -> list[Any]:
        """Return the reply to a request; `Refused` if it is an error.  Other replies are kept for later."""
        while request not in self._replies:
            reply = self.message()
            self._replies[reply[1]] = reply
        reply = self._replies.pop(request)
        if reply[0] == "error":
            raise Refused(*reply[1:4])
        return reply

    def ask(self, tag: str, *elements: Any) -> list[Any]:
        """Send a request and return its reply."""
        return self.reply_to(self.send(tag, *elements))

    def hello(self, *, minor: int = 0, name: str = "plain", session: int = 0) -> list[Any]:
        """Open the session; Use what this `welcome` says from now on."""
        welcome = self.ask("hello", 3, minor, name, session)
        self.epoch, self.session, self.map_version = welcome[6:9]
        self.shm_dir, self.id_prefix, self.segment_prefix = welcome[11:14]
        self.events = welcome[19]
        self.owner = os.lstat(self.shm_dir + self.segment_prefix + "statistics").st_uid
        return welcome

    # --- attaching --------------------------------------------------------------------------------

    def attach(self, handle: list[Any]) -> tuple[SegmentBytes, mmap.mmap]:
        """Map what a handle names, as LAYOUT.md has it; it is in use as long as the mapping exists."""
        path = self.shm_dir + self.segment_prefix + handle[3]
        offset, nbytes = handle[4:6]
        end_s = time.monotonic() + 0.2
        while True:
            try:
                fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
                break
            except FileNotFoundError as error:
                raise Stale(path) from error
            except BlockingIOError:
                assert time.monotonic() < end_s
                time.sleep(0.0002)
        try:
            status = os.fstat(fd)
            if not stat.S_ISREG(status.st_mode) or status.st_uid != self.owner:
                raise Stale(path)
            fcntl.fcntl(fd, _OFD_SETLK, struct.pack("@hhqqi4x", fcntl.F_RDLCK, 0, self.session, 1, 0))
            assert status.st_size >= offset + nbytes
            page = os.pread(fd, _PAGE, offset)
            header_bytes, total_bytes = struct.unpack_from("<QQ", page, 16)
            assert _PAGE <= header_bytes <= total_bytes <= status.st_size - offset
            header = os.pread(fd, header_bytes, offset)
            end = header_bytes - _TAIL
            assert zlib.crc32(header[:end]) == int.from_bytes(header[end : end + 4], "little")
            mapping = mmap.mmap(fd, offset + nbytes, prot=mmap.PROT_READ, flags=mmap.MAP_SHARED)
        finally:
            os.close(fd)
        return parse(mapping[offset:]), mapping
