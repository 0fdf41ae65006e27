# SPDX-License-Identifier: Apache-2.0
"""A disk in memory that loses at a power cut whatever it may lose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field


class PowerCut(BaseException):
    """The machine is off."""


@dataclass
class _File:
    data: bytes
    synced: bool = False


@dataclass
class CutDisk:
    """Files of one directory (`shmmap.daemon.live.folder.Files`); it fails after so many ``operations``.

    What is written is safe after `sync`, a name after `sync_names`.  After a cut, `after` gives the disk as
    it may be found: of the names that were changed since the last `sync_names` any are as before, and of a
    file that was not synced there is nothing, a part, or zeros in the place of the rest.
    """

    operations: int = 10**9
    _names: dict[str, _File] = field(default_factory=dict)
    _safe: dict[str, _File] = field(default_factory=dict)
    _changes: list[tuple[str, _File | None]] = field(default_factory=list)

    def _count(self) -> None:
        if self.operations == 0:
            raise PowerCut
        self.operations -= 1

    def _set(self, name: str, file: _File | None) -> None:
        self._changes.append((name, file))
        if file is None:
            del self._names[name]
        else:
            self._names[name] = file

    def names(self) -> list[str]:
        """All names."""
        return list(self._names)

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return len(self._names[name].data)

    def read(self, name: str, most: int = -1) -> bytes:
        """The first bytes of a file, or all."""
        if name not in self._names:
            raise FileNotFoundError(name)
        data = self._names[name].data
        return data if most < 0 else data[:most]

    def write(self, name: str, data: bytes) -> None:
        """Make a file."""
        assert name not in self._names
        self._count()
        self._set(name, _File(data))

    def sync(self, name: str) -> None:
        """Its content is safe."""
        self._count()
        self._names[name].synced = True

    def rename(self, old: str, new: str) -> None:
        """Another name, at once: never both, never none."""
        self._count()
        file = self._names.pop(old)
        self._names[new] = file
        self._changes.append((f"{old}\0{new}", file))

    def remove(self, name: str) -> None:
        """Remove a file."""
        if name not in self._names:
            raise FileNotFoundError(name)
        self._count()
        self._set(name, None)

    def sync_names(self) -> None:
        """All names are safe."""
        self._count()
        self._safe, self._changes = dict(self._names), []

    def after(self, keeps: Callable[[], bool], part: Callable[[int], int]) -> CutDisk:
        """The disk as it is found when the power is back.

        Parameters
        ----------
        keeps
            Whether one change of a name was kept.
        part
            How much of so many bytes is there; a negative number: zeros follow.
        """
        found = dict(self._safe)
        for name, file in self._changes:
            if not keeps():
                continue
            old, _, new = name.partition("\0")
            if new:
                found.pop(old, None)
                assert file is not None
                found[new] = file
            elif file is None:
                found.pop(name, None)
            else:
                found[name] = file
        disk = CutDisk()
        for name, file in found.items():
            data = file.data
            if not file.synced:
                size = part(len(data))
                data = data[:size] if size >= 0 else data[:-size] + bytes(len(data) + size)
            disk._names[name] = disk._safe[name] = _File(data, synced=True)
        return disk
