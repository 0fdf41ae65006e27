# SPDX-License-Identifier: Apache-2.0
"""Find the input files, and check that the output's place is allowed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

from shmmap.errors import BadRequest, CannotWrite, MapMissing
from shmmap.formats.cloud import CLOUD_SUFFIXES
from shmmap.formats.source_file import refusal
from shmmap.origin.map_report import REPORT_NAME
from shmmap.origin.metadata import METADATA_NAME
from shmmap.quantities import format_bytes

_MAP_PARTS = frozenset({"pointcloud_map.pcd", METADATA_NAME, REPORT_NAME})


@dataclass(frozen=True, slots=True)
class InputFile:
    """An input file, and its state when it was found: size in bytes, mtime and ctime."""

    path: str
    size: int
    mtime_ns: int
    ctime_ns: int

    @classmethod
    def of(cls, path: str) -> InputFile:
        """Return the current state of a file."""
        try:
            status = os.stat(path)
        except OSError as error:
            _refuse(error)
        return cls(path, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def find_inputs(paths: Sequence[str]) -> list[InputFile]:
    """Return the clouds that ``paths`` name: files, and all clouds in and below directories, in path order.

    Raises
    ------
    MapMissing
        A path does not exist, or a directory has no cloud or cannot be read.
    """
    found: dict[str, InputFile] = {}
    for path in map(os.path.abspath, paths):
        if os.path.isdir(path):
            names = [
                os.path.join(folder, name)
                for folder, _, files in os.walk(path, onerror=_refuse)
                for name in files
                if name.lower().endswith(CLOUD_SUFFIXES) and not name.startswith(".")
            ]
            if not names:
                raise MapMissing(
                    f"there is no cloud in {path}", hint=f"clouds are {', '.join(CLOUD_SUFFIXES)}"
                )
        else:
            names = [path]
        for name in sorted(names):
            found.setdefault(name, InputFile.of(name))
    return list(found.values())


def check_unchanged(files: Sequence[InputFile]) -> None:
    """After reading, check that the inputs have not changed since they were found.

    Raises
    ------
    MapDataError
        An input was written to meanwhile (cause ``changed``): the points read may mix two states.
    """
    for file in files:
        if InputFile.of(file.path) != file:
            raise refusal("changed", "the file changed while it was being read", path=file.path)


def _refuse(error: OSError) -> NoReturn:
    is_missing = isinstance(error, FileNotFoundError)
    raise MapMissing(
        f"cannot read {error.filename}: {error.strerror}",
        hint=f"name clouds ({', '.join(CLOUD_SUFFIXES)}) or directories of them" if is_missing else "",
    ) from error


def check_output_place(inputs: Sequence[str], files: Sequence[InputFile], out: str) -> None:
    """Refuse an output inside an input directory, or one that would replace an input.

    Raises
    ------
    BadRequest
        The output is refused.
    """
    real = os.path.realpath(out)
    for path in map(os.path.realpath, inputs):
        if os.path.isdir(path) and _is_within(real, path):
            raise BadRequest(
                f"the output {out} lies inside the input {path}", hint="choose a place outside the inputs"
            )
    for file in files:
        if _is_within(os.path.realpath(file.path), real):
            raise BadRequest(
                f"the input {file.path} lies inside the output {out}", hint="choose another output"
            )


def check_output_directory(out: str, *, force: bool) -> None:
    """Refuse to replace anything at ``out`` but a divided map, and that only with ``force``.

    Raises
    ------
    BadRequest
        The output is refused.
    """
    if not os.path.lexists(out):
        return
    if os.path.islink(out) or not os.path.isdir(out):
        raise BadRequest(f"{out} is not a directory", hint="choose another output")
    there = set(os.listdir(out))
    if not there:
        return
    if there - _MAP_PARTS or METADATA_NAME not in there:
        odd = sorted(there - _MAP_PARTS) or sorted(there)
        raise BadRequest(
            f"{out} is not a divided map: it has {', '.join(odd[:3])}{', ...' if len(odd) > 3 else ''}",
            hint="choose another output; nothing but a divided map is ever replaced",
        )
    if not force:
        raise BadRequest(f"{out} is a map already", hint="--force replaces it, once the new one is complete")


def check_space(what: str, needed: int, directory: str, *, place: str = "") -> None:
    """Refuse an output that cannot fit on the disk of ``directory``, before anything is written.

    Raises
    ------
    CannotWrite
        Fewer than ``needed`` bytes are free.
    """
    have = os.statvfs(directory)
    free = have.f_bavail * have.f_frsize
    if needed > free:
        raise CannotWrite(
            f"{what} needs about {format_bytes(needed)}{place}, {format_bytes(free)} are free",
            hint="free some space, or choose another disk",
        )


def _is_within(path: str, directory: str) -> bool:
    return path == directory or path.startswith(os.path.join(directory, ""))
