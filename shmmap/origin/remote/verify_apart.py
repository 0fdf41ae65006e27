# SPDX-License-Identifier: Apache-2.0
"""Verifies in a separate process which version of a signed map is current.

Importing python-tuf takes a third of a second and 35 MB, which a daemon should not spend in its own process.
"""

from __future__ import annotations

import contextlib
import os
from hashlib import sha256
from typing import Final

import msgspec

from shmmap.errors import ConfigError, ShmmapError
from shmmap.origin.reading_apart import Outcome, ended_early, not_started
from shmmap.origin.remote.map_versions import MAX_METADATA_BYTES, Current
from shmmap.processes.start_child import packet_buffer, receive_packet, start_child

_TIMEOUT_S: Final = 300.0
_NO_ROOT: Final = "it is the ROOT.json that `publish --sign` makes"


class VerifySettings(msgspec.Struct, frozen=True):
    """Settings of a verification.

    Attributes
    ----------
    url
        URL of the store, as in `Store.url`.
    trust
        Path of the trusted root.
    state_dir
        Directory that keeps the newest metadata seen; older metadata is then refused.
    is_serving
        Use the short time limits of a daemon.
    """

    url: str
    trust: str
    state_dir: str
    insecure_http: bool = False
    instance_credentials: bool = False
    is_serving: bool = False


class Verified(msgspec.Struct, frozen=True):
    """A verified version.

    Attributes
    ----------
    current
        Content of ``CURRENT`` for this version.
    trust
        SHA-256 of the trusted root, in hex.
    signed_s, expires_s
        Time at which the timestamp was signed (0: unknown), and first expiry of any of the metadata; Unix
        time.
    """

    current: Current
    trust: str
    signed_s: float
    expires_s: float


class VerifyReply(msgspec.Struct):
    """Reply of the process: the version, or an error."""

    verified: Verified | None = None
    error: Outcome = msgspec.field(default_factory=Outcome)


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_REPLY: Final = msgspec.json.Decoder(VerifyReply)
_JSON: Final = msgspec.json.Decoder()


def read_trusted_root(path: str) -> bytes:
    """Return the bytes of a trusted root.

    Raises
    ------
    ConfigError
        The file cannot be read, or is not a root of trust.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            data = file.read(MAX_METADATA_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", key="trust", hint=_NO_ROOT) from None
    if len(data) > MAX_METADATA_BYTES:
        raise ConfigError(f"{path} is too large for a root of trust", key="trust", hint=_NO_ROOT)
    try:
        kind = _JSON.decode(data)["signed"]["_type"]
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, KeyError, TypeError):
        kind = ""
    if kind != "root":
        raise no_root_of_trust(path)
    return data


def no_root_of_trust(path: str, why: str = "") -> ConfigError:
    """Return the error for a file that is not a root of trust."""
    return ConfigError(
        f"{path}: this is no root of trust{f': {why}' if why else ''}", key="trust", hint=_NO_ROOT
    )


def memory_directory(state_dir: str, url: str, trusted: bytes) -> str:
    """Return the directory of the metadata seen at a URL under a root of trust."""
    of = msgspec.msgpack.encode([url, sha256(trusted).hexdigest()])
    return os.path.join(state_dir, "trust", sha256(of).hexdigest()[:32])


def verify_apart(settings: VerifySettings, *, timeout_s: float = _TIMEOUT_S) -> Verified:
    """Return the signed version.

    Parameters
    ----------
    timeout_s
        Time after which the process is killed, seconds.

    Raises
    ------
    MapDataError
        The signed version is refused; ``cause`` is ``unsigned``, ``older``, ``expired``, ``altered`` or
        ``foreign_root``.
    ConfigError
        The trusted root cannot be read, or is not a root of trust.
    PackageMissing
        The package python-tuf is missing.
    Offline
        The store does not answer.
    CannotWrite
        The newest metadata cannot be kept.
    ShmmapError
        The process cannot be started, takes too long, or was killed.
    """
    read_trusted_root(settings.trust)
    words = msgspec.json.encode(settings).decode()
    try:
        process, channel = start_child("shmmap.origin.remote.verify_version", words, new_session=False)
    except OSError as error:
        raise not_started(settings.url, "verifies", error) from error
    try:
        with channel:
            channel.settimeout(timeout_s)
            data, _ = receive_packet(channel, packet_buffer())
            reply = _REPLY.decode(data) if data else None
    except TimeoutError:
        raise ShmmapError(
            f"{settings.url}: the process that verifies it has not ended within {timeout_s:.0f} s",
            hint="is this machine short of memory or overloaded, or does the state directory hang?",
        ) from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        code = process.wait()
    if reply is None:
        raise ended_early(settings.url, "verifies", code)
    if reply.verified is None:
        raise reply.error.raised()
    return reply.verified
