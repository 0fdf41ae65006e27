# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels in processes of the tests: none while tests are collected, each compiled by one of them.

Modules of kernels compile as they are imported, and many tests import them at their top.  Here such a module
is executed when something of it is first used.  A process that lacks a kernel on disk takes its lock, and the
others wait for the file.
"""

from __future__ import annotations

import fcntl
import os
import sys
import threading
import types
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any, Final

LATE: Final = frozenset(
    {
        "shmmap.chunks.applying_kernels",
        "shmmap.chunks.marking_kernels",
        "shmmap_clients.elevation_map.holes",
        "shmmap_clients.elevation_map.surface",
        "shmmap_clients.ndt_scan_matcher.backends.kernels",
    }
)
"""Modules of kernels that others import as modules, at their top."""
COMPILING: Final = "shmmap.compiling"


def watch(*, late: bool) -> None:
    """Have kernels compiled under locks beside their files; and, if ``late``, their modules executed late."""
    locks = Path(os.environ["NUMBA_CACHE_DIR"], "locks")
    locks.mkdir(exist_ok=True)
    sys.meta_path.insert(0, _Finder(locks, LATE if late else frozenset()))


class _Finder(MetaPathFinder):
    def __init__(self, locks: Path, late: frozenset[str]) -> None:
        self._locks = locks
        self._late = late

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in self._late and fullname != COMPILING:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            late = fullname in self._late
            spec.loader = (
                _Late(spec.loader, Path(str(spec.origin))) if late else _Locked(spec.loader, self._locks)
            )
        return spec


class _LateModule(types.ModuleType):
    """A module that is executed when the first of its names is looked for."""

    def __getattr__(self, name: str) -> Any:
        loader = self.__spec__.loader if self.__spec__ is not None else None
        if isinstance(loader, _Late) and name in loader.text:  # pytest looks for its own in all that it finds
            loader.execute(self)
        return types.ModuleType.__getattribute__(self, name)  # its class is another one now


class _Late(Loader):
    def __init__(self, loader: Loader, source: Path) -> None:
        self.text = source.read_text(encoding="utf-8")
        self._loader = loader
        self._lock = threading.RLock()
        self._begun = False

    def create_module(self, spec: ModuleSpec) -> types.ModuleType:
        return _LateModule(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        pass

    def execute(self, module: types.ModuleType) -> None:
        """Execute it, once; other threads wait."""
        with self._lock:
            if not self._begun:
                self._begun = True
                self._loader.exec_module(module)
                module.__class__ = types.ModuleType


class _Locked(Loader):
    """Loads `shmmap.compiling`, whose cache then takes a kernel's lock from a miss until it is stored."""

    def __init__(self, loader: Loader, locks: Path) -> None:
        self._loader = loader
        self._locks = locks

    def create_module(self, spec: ModuleSpec) -> types.ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: types.ModuleType) -> None:
        self._loader.exec_module(module)
        files: Any = vars(module)["_KernelFiles"]
        load, save = files.load_overload, files.save_overload
        held: dict[str, int] = {}

        def load_or_lock(cache: Any, sig: Any, target_context: Any) -> Any:
            found = load(cache, sig, target_context)
            name = cache._name(sig, target_context.codegen())
            if found is None and name not in held:
                fd = os.open(self._locks / f"{name}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
                fcntl.flock(fd, fcntl.LOCK_EX)
                held[name] = fd
                found = load(cache, sig, target_context)
                if found is not None:
                    unlock(name)
            return found

        def unlock(name: str) -> None:
            if (fd := held.pop(name, None)) is not None:
                fcntl.flock(fd, fcntl.LOCK_UN)  # a fork may have it open
                os.close(fd)

        def save_and_unlock(cache: Any, sig: Any, data: Any) -> None:
            save(cache, sig, data)
            unlock(cache._name(sig, data.codegen))

        files.load_overload, files.save_overload = load_or_lock, save_and_unlock
