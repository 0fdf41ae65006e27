# SPDX-License-Identifier: Apache-2.0
"""Serve a large cloud as a map: divide it into the cache, and again whenever it changes.

::

    <cache>/divided/<name>-<key of the path>/map -> <key of the stamp>
                                             <key of the stamp>/         the divided map

An unchanged cloud is served at once.  Paths of cells contain the link, so that after a change the cells have
new versions but the same ids.  A separate process divides, so that a malicious file cannot crash the daemon,
and stopping ends the work at once; the next run resumes it.  The cache keeps one division per cloud, of the
clouds used most recently; clouds that a daemon serves are never removed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Callable
from typing import Any, Final

from xxhash import xxh3_64_hexdigest

from shmmap.errors import BadRequest, CannotWrite, InternalError, MapMissing, error_from_wire
from shmmap.formats.cloud import READABLE_SUFFIXES
from shmmap.formats.coordinate_system import LENGTHS
from shmmap.formats.durable_file import locked_entry, locked_file
from shmmap.logfmt import log
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.catalogue_bytes import default_cache_directory
from shmmap.origin.map_directory import MapDirectory, is_served_whole, open_map
from shmmap.origin.map_layout import absolute_path
from shmmap.origin.map_report import LINK_NAME, read_report
from shmmap.private_directory import PRIVATE, NotPrivate, opened_private, require_private
from shmmap.processes.start_child import MAX_PACKET_BYTES, how_ended, start_child

_RECIPE: Final = "cells of 20 m, frame moved, 3"  # changes if the same cloud is divided differently
_KEPT_CLOUDS: Final = 8
_MORE_TIME_USEC: Final = 60_000_000
_USE_LOCK: Final = ".use"  # shared lock, held by every daemon that serves the cloud
_MAKING_LOCK: Final = ".making"  # exclusive lock, held by the daemon that divides it


def find_origin(
    map_path: str,
    *,
    metadata: str = "",
    strict: bool = False,
    cache_dir: str = "",
    unit: str = "",
    vertical_unit: str = "",
    drop_noise: bool = False,
    notify: Callable[..., object] = lambda *_lines: None,
) -> MapDirectory | DividedCloud:
    """Return the origin of the map at a path: a map, or a cloud that must be divided first.

    Parameters
    ----------
    metadata, strict, cache_dir
        As in `open_map`; empty ones are searched for, or default to the user's.
    unit, vertical_unit
        Units of a cloud's coordinates, as in `shmmap.dividing.frame.choose_units`.
    drop_noise
        Leave out points that a LAS file classifies as noise.
    notify
        Sends ``KEY=value`` lines of progress to the service manager, see `DividedCloud`.

    Raises
    ------
    MapMissing
        The path does not exist.
    BadRequest
        Units are given for a divided map, which is always in metres.
    """
    path = absolute_path(map_path)
    suffix = os.path.splitext(path)[1].lower()
    is_cloud = os.path.isfile(path) and suffix in READABLE_SUFFIXES and not metadata
    converts = unit in LENGTHS or vertical_unit in LENGTHS
    if is_cloud and (converts or not (suffix == ".pcd" and is_served_whole(path))):
        cache_dir = absolute_path(cache_dir or default_cache_directory())
        how = (unit, vertical_unit, "drop noise" if drop_noise else "")
        return DividedCloud(path, cache_dir, strict=strict, how=how, notify=notify)
    if drop_noise:
        raise BadRequest(
            f"{path} is no cloud that is divided first: noise is not left out of it",
            hint="divide its cloud again: shmmap divide --drop-noise",
        )
    if converts:
        raise BadRequest(
            f"{path} is a divided map, not a cloud: it is not converted",
            hint="divide its cloud again: shmmap divide --unit",
        )
    return open_map(path, metadata=metadata or None, strict=strict, cache_dir=cache_dir or None)


class DividedCloud:
    """The map made from one cloud file.

    Parameters
    ----------
    path
        Absolute path of the cloud.
    cache_dir
        Absolute path of the directory for divided clouds, and for indexes of large maps.
    strict
        As in `open_map`.
    how
        Units of the cloud's coordinates, in the plane and in height, as in `find_origin`, and a word if noise
        is left out; each may be empty.
    notify
        Sends ``KEY=value`` lines to the service manager.
    """

    def __init__(
        self,
        path: str,
        cache_dir: str,
        *,
        strict: bool = False,
        how: tuple[str, str, str] = ("", "", ""),
        notify: Callable[..., object] = lambda *_lines: None,
    ) -> None:
        self.path = path
        self._how = how
        self._cache_dir = cache_dir
        stem = os.path.basename(path).rpartition(".")[0][:64]
        self._clouds = os.path.join(cache_dir, "divided")
        self._directory = os.path.join(self._clouds, f"{stem}-{xxh3_64_hexdigest(os.fsencode(path))}")
        self._strict = strict
        self._notify = notify
        self._use_lock = -1

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        """Divide the cloud if needed, and return the catalogue of its cells.

        Raises
        ------
        MapMissing, MapDataError, CannotWrite
            The cloud is missing, cannot be read, or does not fit in the cache.
        """
        try:
            status = os.stat(self.path)
        except OSError as error:
            raise MapMissing(f"cannot read {self.path}: {error.strerror}") from error
        stamp = (status.st_size, status.st_mtime_ns, status.st_ctime_ns)
        name = xxh3_64_hexdigest(json.dumps([_RECIPE, *self._how, *stamp]).encode())
        out = os.path.join(self._directory, name)
        link = os.path.join(self._directory, LINK_NAME)
        try:
            require_private(self._directory)
            self._hold()
            with self._alone():
                if not os.path.isdir(out):  # another daemon may have divided it meanwhile
                    self._divide(out)
                _point(link, name)
            self._sweep()
        except OSError as error:
            hint = f"{error.hint}, or " if isinstance(error, NotPrivate) else ""
            raise CannotWrite(
                f"{error.filename or self._directory}: {error.strerror}",
                hint=f"{hint}name another --cache-dir",
            ) from error
        catalogue = MapDirectory(link, strict=self._strict, cache_dir=self._cache_dir).load(
            fresh=fresh, before=before
        )
        with contextlib.suppress(OSError), self._alone():  # the served division is read until the change
            self._remove_others(name)
        report = read_report(out) or {}
        catalogue.problems = (*catalogue.problems, *map(str, report.get("notes", ())))
        return catalogue

    def _divide(self, out: str) -> None:
        log.info("dividing", cloud=self.path, into=out)
        process, channel = start_child(
            "shmmap.dividing.child_main", self.path, out, *self._how, new_session=False
        )
        failure: dict[str, Any] = {}
        stage = ""
        with process, channel:
            try:
                while packet := channel.recv(MAX_PACKET_BYTES):
                    report = json.loads(packet)
                    if "error" in report:
                        failure = report
                        continue
                    if report["stage"] != stage:
                        stage = report["stage"]
                        log.info("dividing", cloud=self.path, stage=stage)
                    part = f" {report['done'] / report['total']:.0%}" if report["total"] else ""
                    self._notify(
                        f"STATUS={stage} {self.path}{part}", f"EXTEND_TIMEOUT_USEC={_MORE_TIME_USEC}"
                    )
            except BaseException:
                process.kill()
                raise
        if failure:
            raise error_from_wire(failure["error"], failure["message"], failure["hint"])
        if process.returncode or not os.path.isdir(out):
            how = how_ended(process.returncode)
            raise InternalError(f"dividing {self.path} ended with {how}", hint="shmmap divide says more")

    # --- the cache ------------------------------------------------------------------------------

    def _hold(self) -> None:
        """Mark the cloud as served by this process until the process ends."""
        if self._use_lock < 0:
            self._use_lock = locked_entry(self._directory, _USE_LOCK, fcntl.LOCK_SH, mode=PRIVATE)
            os.utime(self._use_lock)

    def _alone(self) -> contextlib.AbstractContextManager[None]:
        """Wait for the lock without which no daemon divides the cloud."""
        return locked_file(os.path.join(self._directory, _MAKING_LOCK))

    def _remove_others(self, present: str) -> None:
        """Remove divisions of earlier states of the cloud, complete or not."""
        for entry in os.scandir(self._directory):
            if entry.is_dir(follow_symlinks=False) and entry.name != present:
                shutil.rmtree(entry.path, ignore_errors=True)

    def _sweep(self) -> None:
        """Remove the least recently used clouds above the limit, unless a daemon serves them."""
        used: list[tuple[int, str]] = []
        for entry in os.scandir(self._clouds):
            with contextlib.suppress(OSError), opened_private(entry.path) as fd:
                status = os.stat(_USE_LOCK, dir_fd=fd, follow_symlinks=False)
                used.append((status.st_mtime_ns, entry.path))
        for _, path in sorted(used, reverse=True)[_KEPT_CLOUDS:]:
            with contextlib.suppress(OSError):
                fd = os.open(os.path.join(path, _USE_LOCK), os.O_RDWR | os.O_CLOEXEC)
                try:
                    fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    log.info("divided cloud removed from the cache", path=path)
                    shutil.rmtree(path)
                finally:
                    os.close(fd)


def _point(link: str, name: str) -> None:
    """Make ``link`` refer to ``name``, in one step."""
    if os.path.islink(link) and os.readlink(link) == name:
        return
    interim = f"{link}.{os.getpid()}"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(interim)
    os.symlink(name, interim)
    os.replace(interim, link)
