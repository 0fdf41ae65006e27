# SPDX-License-Identifier: Apache-2.0
"""Which kinds of layers exist: shmmap's own, and those that other packages offer.

Another package offers a kind by an entry point of the group ``shmmap.layers`` whose object is a
`LayerKind`::

    [project.entry-points."shmmap.layers"]
    roughness = "my_package.roughness:KIND"
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from shmmap.layers.contract import LayerKind
from shmmap.layers.ground import ELEVATION, GROUND
from shmmap.layers.ndt import NDT
from shmmap.layers.points import POINTS
from shmmap.layers.search import SEARCH
from shmmap.layers.selections import CROP, DENOISE, NORMALS, SAMPLE
from shmmap.layers.voxel import VOXEL
from shmmap.logfmt import log

__all__ = ["find_kind", "kinds", "register"]

GROUP: Final = "shmmap.layers"

_own: Final[dict[str, LayerKind]] = {
    kind.name: kind
    for kind in (POINTS, VOXEL, NDT, SEARCH, SAMPLE, CROP, DENOISE, NORMALS, ELEVATION, GROUND)
}
_registered: Final[dict[str, LayerKind]] = {}


def register(kind: LayerKind) -> None:
    """Make a kind known to this process; an entry point makes it known to all of them.

    Raises
    ------
    ValueError
        If another kind has its name.
    """
    if (find_kind(kind.name) or kind) is not kind or not kind.name.isidentifier() or not kind.name.isascii():
        raise ValueError(f"a layer kind cannot be called {kind.name!r}")
    if not 1 <= kind.builder_version <= 255:
        raise ValueError(f"{kind.name}: builder_version must be 1 to 255")
    _registered[kind.name] = kind


@lru_cache(maxsize=1)
def _offered() -> dict[str, LayerKind]:
    """Kinds of other packages; one that cannot be loaded is left out and logged."""
    from importlib.metadata import entry_points  # a tenth of the time that a loader's imports take

    found: dict[str, LayerKind] = {}
    for entry in entry_points(group=GROUP):
        try:
            kind = entry.load()
        except Exception as error:  # noqa: BLE001  somebody else's module: anything may happen in it
            log.error("layer kind not loaded", kind=entry.name, module=entry.value, error=error)
            continue
        if not isinstance(kind, LayerKind) or kind.name != entry.name or kind.name in _own:
            log.error("layer kind not offered by its module", kind=entry.name, module=entry.value)
            continue
        found[kind.name] = kind
    return found


def find_kind(name: str) -> LayerKind | None:
    """Return the kind of that name; other packages are looked at only for names that are not ours."""
    return _own.get(name) or _registered.get(name) or _offered().get(name)


def kinds() -> tuple[LayerKind, ...]:
    """Return every kind there is: our own first."""
    return (*_own.values(), *_registered.values(), *_offered().values())
