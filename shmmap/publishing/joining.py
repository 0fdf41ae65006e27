# SPDX-License-Identifier: Apache-2.0
"""Joins a run: makes the parts of its slices the current version, in one step.

Only a join switches the version, slices never do.  If a join is killed at any moment, the current version
stays complete; running the join again finishes it.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Final

import numpy as np

from shmmap.errors import BadRequest, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.origin.remote.map_versions import (
    CurrentState,
    changed_meanwhile,
    new_entry,
    read_current,
    read_shards,
)
from shmmap.origin.remote.published_index import Root, map_version_of, pack_root
from shmmap.origin.remote.slice_part import (
    MAX_PART_BYTES,
    Part,
    RunName,
    part_number,
    read_run,
    shards_of,
    slice_of_shards,
    unpack_part,
    with_parts,
)
from shmmap.origin.remote.store import Store, refuse_read_only
from shmmap.processes.request_threads import RequestThreads
from shmmap.progress import Progress
from shmmap.publishing.new_version import (
    CONCURRENT_REQUESTS,
    absent_objects,
    begin_version,
    refuse_if_late,
    send_packed,
    switch_version,
)
from shmmap.publishing.publish import packed_root
from shmmap.publishing.slicing import BaseVersion, changed_layers, new_objects, read_base

if TYPE_CHECKING:
    from shmmap.publishing.signing import MapSigner

_OLD_S: Final = 6 * 86_400.0  # after seven days, pruning may remove objects that no version names
_CONCURRENT_READS: Final = 16


@dataclass(frozen=True, slots=True)
class Joined:
    """Result of a join.

    Attributes
    ----------
    version
        Number of the new version; None if the current version already has these layers.
    current, map_version, root
        Number, map version, and hash of the root of the version that is current now.
    cells, layers
        Cells and layers of that version.
    objects
        Number of objects that were checked.
    """

    run: RunName
    version: int | None
    current: int
    map_version: int
    root: str
    cells: int
    layers: tuple[str, ...]
    objects: int = 0


def join_slices(store: Store, run: str, *, progress: Progress, signer: MapSigner | None = None) -> Joined:
    """Create a version from the parts of all slices of a run, and make it current.

    Parameters
    ----------
    run
        Name of the run, as returned by `prepare_slice`.
    signer
        Signs the version; required for a signed map.

    Raises
    ------
    BadRequest
        ``run`` is not a run's name; the run was made from another version than the current one; the store is
        read-only; or the map is signed and there is no signer.
    MapMissing
        Nothing is published there, or slices are missing; the message names them.
    MapDataError
        A part, or an object that it names, is damaged or missing, or parts are from different builders.
    InstanceBusy
        Another publisher was quicker: its version is current.
    CannotWrite, Offline
        The store refuses or does not answer, or the join took longer than a day.
    """
    refuse_read_only(store)
    name = read_run(run)
    seen = begin_version(store, signer, "join")
    if seen.current is None:
        raise MapMissing(f"no map is published at {store.url}")
    base = read_base(store, seen.current)
    return _Join(store, name, base, seen, progress, signer).run()


class _Join:
    """State of one join."""

    def __init__(
        self,
        store: Store,
        run: RunName,
        base: BaseVersion,
        seen: CurrentState,
        progress: Progress,
        signer: MapSigner | None,
    ) -> None:
        self._store = store
        self._run = run
        self._base = base
        self._seen = seen
        self._progress = progress
        self._signer = signer
        self._began_s = time.monotonic()

    def run(self) -> Joined:
        parts = self._read_parts()
        if self._are_joined(parts):
            return self._unchanged(parts)
        self._check(parts)
        layers = next(iter(parts.values())).layers.keys()
        root = with_parts(self._base.root, list(parts.values()))
        unpacked = packed_root(root, self._store.url)
        if unpacked == pack_root(self._base.root):
            return self._unchanged(parts)
        step("join.root")
        sent = send_packed(self._store, unpacked)
        step("join.entry")
        # from here on pruning spares the version's objects; the check below finds those removed earlier
        entry = new_entry(self._store, sent.sha256.hex(), sent.size, self._base.current)
        objects = self._look_for_objects(root, layers)
        step("join.looked")
        refuse_if_late(self._began_s, f"joining at {self._store.url}", "run the same command again")
        switch_version(self._store, entry, self._seen, self._signer)
        self._remove(parts)
        self._progress.done(root.cells)
        return Joined(
            self._run,
            entry.version,
            entry.version,
            map_version_of(unpacked),
            entry.root,
            root.cells,
            tuple(root.layers),
            objects,
        )

    def _unchanged(self, parts: Mapping[int, Part]) -> Joined:
        current, root = self._base.current, self._base.root
        if self._signer is not None:
            self._signer.keep(current)
        self._remove(parts)
        self._progress.done(root.cells)
        return Joined(
            self._run,
            None,
            current.version,
            root.map_version,
            current.root,
            root.cells,
            tuple(root.layers),
        )

    # --- parts ----------------------------------------------------------------------------------

    def _read_parts(self) -> dict[int, Part]:
        """Read the existing parts, by slice number, ascending."""
        run, store = self._run, self._store
        found = (part_number(run, listed.path) for listed in store.list(run.path))
        numbers = sorted(number for number in found if number is not None)

        def read(number: int) -> Part:
            path = run.part_path(number)
            try:
                return unpack_part(store.get(path, MAX_PART_BYTES), run, number, name=f"{store.url}/{path}")
            except MapDataError as error:
                error.hint = error.hint or f"make slice {number} again, which replaces it"
                raise

        try:
            with RequestThreads(_CONCURRENT_READS, "part") as threads:
                return {part.slice: part for part in threads.map(read, numbers)}
        except MapMissing:
            self._refuse_if_changed()  # another join may have removed the part
            raise

    def _refuse_if_changed(self) -> None:
        if read_current(self._store).current != self._base.current:
            raise changed_meanwhile(self._store)

    def _are_joined(self, parts: Mapping[int, Part]) -> bool:
        """Whether the current version contains all these parts: a join was killed after its switch."""
        root = self._base.root
        has_shards = False
        for part in parts.values():
            numbers = shards_of(root, part)
            has_shards |= len(part.keys) > 0
            is_in = (
                part.layers.items() <= root.layers.items()
                and numbers is not None
                and np.array_equal(root.sizes[numbers], part.sizes)
                and np.array_equal(root.hashes[numbers], part.hashes)
            )
            if not is_in:
                return False
        return has_shards and all(part.root_content != self._base.content for part in parts.values())

    def _check(self, parts: Mapping[int, Part]) -> None:
        """Check that the parts are of all slices, of the current version, and by one builder version."""
        run, store, base = self._run, self._store, self._base
        if not parts:
            self._refuse_if_changed()
            raise MapMissing(
                f"no slice of run {run} is at {store.url}",
                hint="`shmmap prepare URL --layer ... --shards I/N` makes them; of a joined run none is left",
            )
        first = next(iter(parts.values()))
        if first.root_content != base.content:  # equal in all parts: the name of the run contains it
            same = first.version == base.current.version
            raise BadRequest(
                f"run {run} was made from {'another ' * same}version {first.version},"
                f" version {base.current.version} is current: its slices have to be made again",
                hint="`shmmap prepare URL` with the same options makes them from the current version",
            )
        missing = sorted(set(range(1, run.slices + 1)) - parts.keys())
        if missing:
            raise MapMissing(
                f"slices {numbers_text(missing)} of {run.slices} are not made yet: run {run} at {store.url}",
                hint=f"make them: `shmmap prepare URL` with the same options and"
                f" --shards {missing[0]}/{run.slices}",
            )
        self._check_builders(parts)

    def _check_builders(self, parts: Mapping[int, Part]) -> None:
        first = next(iter(parts.values()))
        for layer, built in first.layers.items():
            others = [part for part in parts.values() if part.layers[layer] != built]
            if others:
                other = others[0].layers[layer]
                slices = numbers_text(part.slice for part in others if part.layers[layer] == other)
                raise MapDataError(
                    f"{layer} of slices {slices} of {self._run.slices} is of builder version {other},"
                    f" of slice {first.slice} of {built}",
                    path=self._store.url,
                    cause="other_builder",
                    hint="use one version of shmmap on all machines, and make those slices again",
                )

    def _remove(self, parts: Mapping[int, Part]) -> None:
        """Remove the parts, those without shards first: only parts with shards show that a run is joined."""
        for number, _ in sorted(parts.items(), key=lambda one: len(one[1].keys)):
            step("join.part")
            self._store.delete(self._run.part_path(number))

    # --- objects --------------------------------------------------------------------------------

    def _look_for_objects(self, root: Root, layers: Collection[str]) -> int:
        """Check that all objects of a root exist, and return the number checked.

        The root may differ from the current one in ``layers``.
        """
        base = self._base.root
        belongs = slice_of_shards(base, self._run.slices).tolist()
        since_s = time.time() - _OLD_S
        absent: dict[int, int] = {}  # number of missing objects by slice; 0: those of the version before
        looked = 0
        self._progress.stage("look for objects", root.cells)
        shards = zip(belongs, read_shards(self._store, base), read_shards(self._store, root), strict=True)
        with RequestThreads(CONCURRENT_REQUESTS, "head") as threads:
            for number, (of_slice, before, after) in enumerate(shards):
                path = f"{self._store.url}/{self._run.part_path(of_slice)}"
                changed = changed_layers(before, after, layers, name=path)
                kept = after.layers.keys() - set(changed)
                old = {one for name in kept for one in after.layers[name].objects()}
                new = new_objects(root, number, after, changed) - old
                for key, objects, since in ((0, old, 0.0), (of_slice, new, since_s)):
                    looked += len(objects)
                    gone = absent_objects(self._store, sorted(objects), threads, since_s=since)
                    if gone:
                        absent[key] = absent.get(key, 0) + len(gone)
                self._progress.advance(len(after))
        self._refuse_absent(absent)
        return looked

    def _refuse_absent(self, absent: Mapping[int, int]) -> None:
        slices = sorted(absent.keys() - {0})
        if slices:
            count = sum(absent[number] for number in slices)
            raise MapDataError(
                f"{count:,} objects of slices {numbers_text(slices)} of {self._run.slices} are not there, or"
                " older than six days",
                path=self._store.url,
                hint="make those slices again: `shmmap prepare URL` with the same options",
            )
        if absent:
            raise MapDataError(
                f"{absent[0]:,} objects of version {self._base.current.version} are not there",
                path=self._store.url,
                hint="publish its map again, with --resend",
            )


def numbers_text(numbers: Iterable[int]) -> str:
    """Return ascending numbers as text, with ranges as ``first-last``, e.g. ``3, 7-9``."""
    ordered = list(numbers)
    places = [number - place for place, number in enumerate(ordered)]
    found = []
    for _, group in groupby(zip(places, ordered, strict=True), key=lambda one: one[0]):
        some = [number for _, number in group]
        found.append(str(some[0]) if len(some) == 1 else f"{some[0]}-{some[-1]}")
    return ", ".join(found)
