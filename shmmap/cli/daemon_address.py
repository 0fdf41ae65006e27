# SPDX-License-Identifier: Apache-2.0
"""Find the daemon that the options mean: flags first, then ``SHMMAP_*`` variables, then the defaults."""

from __future__ import annotations

import argparse
import os
from contextlib import closing
from typing import TYPE_CHECKING, Final

from shmmap.errors import NoAnswer, NoSocket, ProtocolMismatch, ShmmapError
from shmmap.protocol.endpoint import DEFAULT_INSTANCE, endpoint_path, runtime_dirs, socket_path
from shmmap.segment.names import usual_directory

if TYPE_CHECKING:
    from shmmap.client.client import Client
    from shmmap.doctor.daemon_lists import DaemonLists
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

ASKED_S: Final = 2.0
"""Seconds that a verb waits for the owner of a socket to identify itself."""
ANSWER_S: Final = 5.0
"""Seconds that a verb waits for a running daemon to accept a connection, and for each reply."""


def _setting(args: argparse.Namespace, name: str) -> str:
    flag: str | None = getattr(args, name)
    return flag if flag is not None else os.environ.get(f"SHMMAP_{name.upper()}", "")


def endpoint(args: argparse.Namespace) -> str | None:
    """Return the socket that the options name; None for the default places."""
    if named := _endpoint_setting(args):
        return endpoint_path(named)
    directory, name = _setting(args, "runtime_dir"), _setting(args, "instance")
    if directory:
        return endpoint_path(socket_path(directory, name or DEFAULT_INSTANCE))
    if name and (args.instance or name != DEFAULT_INSTANCE):
        places = [socket_path(place, name) for place in runtime_dirs()]
        return next((place for place in places if os.path.exists(place)), places[0])
    return None


def instance(args: argparse.Namespace) -> str:
    """Return the instance's name; with only an endpoint given, the name of its socket."""
    named = _endpoint_setting(args)
    name = args.instance if args.instance or args.endpoint else _setting(args, "instance")
    if name or not named:
        return name or DEFAULT_INSTANCE
    return os.path.basename(endpoint_path(named)).removesuffix(".sock")


def _endpoint_setting(args: argparse.Namespace) -> str:
    """Return the endpoint setting; a flag that selects another daemon overrides ``SHMMAP_ENDPOINT``."""
    return args.endpoint or ("" if args.instance or args.runtime_dir else _setting(args, "endpoint"))


def shm_dir(args: argparse.Namespace) -> str:
    """Return the directory of the instance's segments."""
    return _setting(args, "shm_dir") or usual_directory(instance(args))


def locate(args: argparse.Namespace) -> tuple[str, str]:
    """Return the instance that the options select, and the directory of its segments.

    A socket's name may differ from its instance's name, and the segments may be in any directory.  So if the
    statistics found under the socket's name belong to another daemon, the daemon at the socket is asked. An
    instance name alone selects the daemon with the statistics of that name, wherever it listens.

    Raises
    ------
    NoSocket
        No daemon listens at the socket, and the instance of that name listens elsewhere.
    ProtocolMismatch
        The daemon at this socket is of another version, and no statistics name it.
    """
    named, by_name = endpoint(args) or "", (instance(args), shm_dir(args))
    if _is_at(*by_name, named if _endpoint_setting(args) or _setting(args, "runtime_dir") else ""):
        return by_name
    mismatch: ProtocolMismatch | None = None
    try:
        found = _asked(args, named) if named else None
    except ProtocolMismatch as error:
        found, mismatch = None, error
    if found is None and named:  # no reply, or no permission: look for statistics naming this socket
        places = dict.fromkeys((by_name[1], usual_directory("")))
        found = next(
            ((name, place) for place in places for name in _instances(place) if _is_at(name, place, named)),
            None,
        )
    if found is None and mismatch is not None:
        raise mismatch
    if found is None and named and (other := _endpoint_of(*by_name)):
        raise NoSocket(
            f"no daemon has the socket {named}; instance {by_name[0]!r} listens at {other}",
            hint="name that one with --endpoint or --instance",
        )
    return found or by_name


def _is_at(name: str, directory: str, socket: str) -> bool:
    """Whether the statistics ``name`` exist and their daemon listens at ``socket`` (at any, if empty)."""
    other = _endpoint_of(name, directory)
    return other != "" and (not socket or os.path.realpath(other) == os.path.realpath(socket))


def _endpoint_of(name: str, directory: str) -> str:
    """Read a daemon's socket from its statistics; empty if they are missing or unreadable.

    Also empty for a daemon in another container, whose paths are not valid here.
    """
    from shmmap.statistics.identity import pid_namespace
    from shmmap.statistics.reader import read_statistics

    try:
        identity = read_statistics(name, directory).identity
    except (ShmmapError, OSError):
        return ""
    if identity is None or identity.pid_namespace != pid_namespace():
        return ""
    return identity.endpoint


def _asked(args: argparse.Namespace, socket: str) -> tuple[str, str] | None:
    """Ask the daemon at a socket for its instance and directory; None if it does not reply."""
    from shmmap.client.discovery import is_served

    if not is_served(socket):
        return None
    import shmmap

    try:
        with shmmap.connect(socket, timeout=ASKED_S, connect_timeout=ASKED_S, name="shmmap") as client:
            return client.welcome.instance, _setting(args, "shm_dir") or client.welcome.shm_dir
    except ProtocolMismatch:
        raise
    except ShmmapError:
        return None


def snapshot(args: argparse.Namespace) -> tuple[Snapshot, DaemonIdentity]:
    """Read the daemon's statistics segment, which needs no reply from the daemon.

    Raises
    ------
    NoSocket
        The segment does not exist: the daemon was never started, or was stopped.
    """
    from shmmap.statistics.reader import read_statistics

    name, directory = locate(args)
    found = read_statistics(name, directory)
    if found.identity is None:
        others = ", ".join(_instances(directory))
        raise NoSocket(
            f"no daemon runs as instance {name!r} with segments in {directory}",
            hint=f"other instances are there: {others}; name one with --instance or SHMMAP_INSTANCE"
            if others
            else "start one with `shmmap serve MAP`, or say which: --endpoint, or --instance with --shm-dir",
        )
    return found, found.identity


def lists(args: argparse.Namespace, name: str = "shmmap") -> closing[DaemonLists]:
    """Return what asks the daemon for its clients and live maps, which its statistics lack."""
    from shmmap.doctor.daemon_lists import DaemonLists

    return closing(DaemonLists(name, endpoint(args)))


def connect_to(args: argparse.Namespace, found: Snapshot) -> Client:
    """Connect to the daemon whose statistics were found, for what only it can list.

    Raises
    ------
    NoAnswer
        It is paused, starting or dead.
    """
    from shmmap.doctor.daemon_lists import socket_of
    from shmmap.doctor.verdicts import state_problem

    problem = state_problem(found)
    if problem is not None and found.state != "hung":  # one that cannot write its statistics looks hung
        raise NoAnswer(f"the daemon does not answer. {problem.fact}", hint=problem.advice)
    path = socket_of(found.identity, endpoint(args)) if found.identity is not None else None
    return _connected(args, path, "shmmap")


def has_lost_socket(found: Snapshot) -> bool:
    """Whether another program removed the socket of a running daemon, so that clients cannot find it."""
    from shmmap.statistics.identity import pid_namespace

    if found.identity is None or found.counters.get("sockets_missing", 0):
        return found.identity is not None
    if found.identity.pid_namespace != pid_namespace():  # paths of another container are not valid here
        return False
    try:
        os.lstat(found.identity.endpoint)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return False


def _instances(directory: str) -> list[str]:
    """Return the instances with statistics in ``directory``."""
    from shmmap.segment.names import statistics_name

    begin, end = statistics_name("*").removeprefix("/").split("*")
    try:
        names = sorted(os.listdir(directory))
    except OSError:
        return []
    return [
        name.removeprefix(begin).removesuffix(end)
        for name in names
        if name.startswith(begin) and name.endswith(end)
    ]


def connect(args: argparse.Namespace, name: str = "shmmap") -> Client:
    """Connect to the daemon with a shorter timeout than programs use, since a person is waiting.

    Parameters
    ----------
    args
        Parsed options, those of `shmmap.cli.options.add_daemon_options` among them.
    name
        Name of the session in ``shmmap clients``.
    """
    return _connected(args, endpoint(args), name)


def _connected(args: argparse.Namespace, path: str | None, name: str) -> Client:
    import shmmap

    timeout_s = ANSWER_S if args.timeout is None else args.timeout
    return shmmap.connect(
        path,
        timeout=timeout_s,
        connect_timeout=timeout_s,
        name=name,
        shm_dir=_setting(args, "shm_dir") or None,
    )
