# SPDX-License-Identifier: Apache-2.0
"""Find the daemon, or report exactly why it cannot be reached."""

from __future__ import annotations

import errno
import os
import stat
import time
from collections.abc import Mapping, Sequence
from typing import Final

from shmmap.errors import (
    BadRequest,
    ConfigError,
    DaemonUnreachable,
    NoAnswer,
    NoSocket,
    ProtocolMismatch,
    SocketPermission,
    StaleSocket,
)
from shmmap.protocol.endpoint import (
    DEFAULT_INSTANCE,
    SYSTEM_RUNTIME_DIR,
    endpoint_path,
    runtime_dirs,
    socket_path,
)
from shmmap.segment.names import check_instance

_SIGNATURE_BYTES: Final = 10
_FULL_S: Final = 0.005
_START_HINT: Final = (
    "start one with `shmmap serve MAP`, or name another: connect(instance=...) or connect(PATH);"
    " --instance and --endpoint, or SHMMAP_INSTANCE and SHMMAP_ENDPOINT, for programs"
)


def candidates(
    endpoint: str | os.PathLike[str] | None = None,
    environ: Mapping[str, str] = os.environ,
    *,
    instance: str | None = None,
) -> list[str]:
    """Return the socket paths to try, in order: the given path, else those of the instance.

    Parameters
    ----------
    endpoint
        A socket path or an ``ipc://`` URL; a string without slash and point is an instance's name.
        None means ``SHMMAP_ENDPOINT``.
    environ
        Without an endpoint, ``SHMMAP_INSTANCE`` names the instance, ``SHMMAP_RUNTIME_DIR`` its directory.
    instance
        The instance, instead of an endpoint.

    Raises
    ------
    BadRequest
        If the name cannot be a socket path or an instance's.
    """
    if instance is None and isinstance(endpoint, str) and endpoint and not {"/", ".", "@"} & set(endpoint):
        endpoint, instance = None, endpoint
    if instance is None:
        named = _path_of(endpoint) or environ.get("SHMMAP_ENDPOINT", "")
        if named:
            return [endpoint_path(named)]
    elif endpoint is not None:
        raise BadRequest("give an endpoint or an instance, not both")
    directory = environ.get("SHMMAP_RUNTIME_DIR", "")
    places = [os.path.abspath(directory)] if directory else runtime_dirs(environ)
    name = _checked(environ.get("SHMMAP_INSTANCE", "") or DEFAULT_INSTANCE if instance is None else instance)
    return [endpoint_path(socket_path(place, name)) for place in places]


def _path_of(endpoint: str | os.PathLike[str] | None) -> str:
    if endpoint is None or isinstance(endpoint, str):
        return endpoint or ""
    try:
        return os.path.abspath(os.fsdecode(endpoint))
    except TypeError:
        raise BadRequest(f"an endpoint is a path or an instance's name, not {endpoint!r}") from None


def _checked(instance: str) -> str:
    try:
        return check_instance(instance)
    except TypeError:
        raise BadRequest(f"an instance's name is a string, not {instance!r}") from None
    except ConfigError as error:
        raise BadRequest(error.message, hint=error.hint) from None


def find_socket(paths: Sequence[str], deadline_s: float) -> str:
    """Return the first path at which a ZeroMQ peer answers.

    A path at which nothing listens is skipped at once.  A daemon that accepts but stays silent ends the
    search: the next path might be that of another map.

    Parameters
    ----------
    deadline_s
        On the clock of `time.monotonic`.

    Raises
    ------
    NoSocket, SocketPermission, StaleSocket
        None of the paths can be connected to; the message names each of them, and the kind
        is that of the first one that at least exists.
    NoAnswer, ProtocolMismatch
        See `check_socket`.
    """
    refusals: list[DaemonUnreachable] = []
    for path in paths:
        try:
            check_socket(path, deadline_s)
        except (NoSocket, SocketPermission, StaleSocket) as refusal:  # noqa: PERF203  two paths at most
            refusals.append(refusal)
        else:
            return path
    worst = next((refusal for refusal in refusals if not isinstance(refusal, NoSocket)), refusals[0])
    if len(refusals) == 1:
        raise worst
    raise type(worst)("; ".join(refusal.message for refusal in refusals), hint=worst.hint) from None


def check_socket(path: str, deadline_s: float) -> None:
    """Connect to a socket once, to find out why a connection fails.

    ZeroMQ itself connects in the background and never reports why it fails.

    Raises
    ------
    NoSocket
        There is no socket at ``path``.
    SocketPermission
        This user may not connect.
    StaleSocket
        No process listens any more, or the process ended before it answered.
    NoAnswer
        A process listens, but sent nothing before the deadline.
    ProtocolMismatch
        The process that listens does not speak ZeroMQ.
    """
    import socket  # with selectors, 4 ms: not at import

    with socket.socket(
        socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
    ) as probe:
        while True:
            try:
                probe.connect(path)
                break
            except BlockingIOError:  # its backlog is full; the kernel reports nothing more
                if time.monotonic() >= deadline_s:
                    raise _no_answer(path) from None
                time.sleep(_FULL_S)
            except OSError as error:
                raise _refusal(path, error) from None
        # Every ZMTP peer speaks first: 0xff, eight bytes, 0x7f (https://rfc.zeromq.org/spec/23/)
        received = b""
        while len(received) < _SIGNATURE_BYTES:
            probe.settimeout(max(deadline_s - time.monotonic(), 1e-3))
            try:
                part = probe.recv(_SIGNATURE_BYTES - len(received))
            except TimeoutError:
                raise _no_answer(path) from None
            except ConnectionError:
                part = b""
            received += part
            if not received:  # the connection waited in the backlog of a daemon that ended or never started
                raise StaleSocket(
                    f"{path}: a daemon that ended closed the connection without an answer",
                    hint="see its log, or `systemctl status shmmapd`: did it fail to start?",
                )
            if not part or received[0] != 0xFF or (len(received) == _SIGNATURE_BYTES and received[9] != 0x7F):
                raise ProtocolMismatch(
                    f"{path}: what listens there does not speak ZeroMQ",
                    hint="is this the socket of another program?",
                )


def is_served(path: str) -> bool:
    """Return whether a daemon serves the request socket ``path``, without connecting to that socket.

    A service manager may listen at ``path`` for a daemon that does not run, and would start it on a
    connection. So the events socket is checked instead, which only daemons create.
    """
    import socket

    events = path.removesuffix(".sock") + ".events.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(events)
        except BlockingIOError:  # it listens, but has not accepted yet
            return True
        except OSError:
            return False
    return True


def _no_answer(path: str) -> NoAnswer:
    return NoAnswer(
        f"{path}: the daemon accepts connections but does not answer",
        hint="it is starting, stopped, hung or overloaded: see `shmmap health`",
    )


def _refusal(path: str, error: OSError) -> DaemonUnreachable | ProtocolMismatch:
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return NoSocket(f"{path}: there is no socket", hint=_other_instances(path) or _START_HINT)
    if error.errno in (errno.EACCES, errno.EPERM):
        return SocketPermission(
            f"{path}: this user may not connect",
            hint="join the group that the daemon was started with (--group), then log in again",
        )
    if error.errno == errno.EPROTOTYPE:
        return ProtocolMismatch(f"{path} is a socket of another kind: no shmmap daemon made it")
    if error.errno == errno.ECONNREFUSED:
        try:
            is_socket = stat.S_ISSOCK(os.stat(path).st_mode)
        except OSError:
            is_socket = False
        if is_socket:
            return StaleSocket(
                f"{path}: the daemon that made this socket is gone",
                hint="start it again; it replaces the socket by itself",
            )
        return NoSocket(f"{path} is not a socket", hint=_START_HINT)
    return NoSocket(f"{path}: {error.strerror}", hint=_START_HINT)


def _other_instances(path: str) -> str:
    directory = os.path.dirname(path)
    if not (directory.endswith("/shmmap") or directory == SYSTEM_RUNTIME_DIR):
        return ""
    try:
        sockets = [name.removesuffix(".sock") for name in os.listdir(directory) if name.endswith(".sock")]
    except OSError:
        return ""
    others = sorted(name for name in sockets if "." not in name)  # events' names have a dot
    if not others:
        return ""
    return (
        f"other instances are there: {', '.join(others)}; name one: connect(instance=...), --instance or"
        " SHMMAP_INSTANCE"
    )
