# SPDX-License-Identifier: Apache-2.0
"""Where a daemon and its loaders have a published map from: the store, and what of it is on the disk."""

from __future__ import annotations

from typing import NamedTuple

from shmmap.origin.remote.object_tier import KeptObjects, ObjectTier
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import SERVING, Store, Timeouts

__all__ = ["ServedFrom", "kept_objects", "open_for_serving"]


class ServedFrom(NamedTuple):
    """Where a published map is served from, as the daemon says it to its loaders; see `open_store`."""

    url: str
    insecure_http: bool = False
    instance_credentials: bool = False

    def words(self) -> tuple[str, ...]:
        """Return it as texts."""
        return self.url, *("yes" if one else "" for one in self[1:])

    @classmethod
    def from_words(cls, url: str, *flags: str) -> ServedFrom:
        """Read what `words` has written."""
        return cls(url, *map(bool, flags))


def open_for_serving(served: ServedFrom, timeouts: Timeouts = SERVING) -> Store:
    """Return the store, opened for requests that wait.  Errors are those of `open_store`."""
    return open_store(
        served.url,
        timeouts=timeouts,
        insecure_http=served.insecure_http,
        instance_credentials=served.instance_credentials,
    )


def kept_objects(
    store: Store, cache_dir: str, cache_bytes: int, *, is_index: bool = False, quiet: bool = False
) -> KeptObjects:
    """Return what reads objects: from the disk where they are there, else from the store.

    Parameters
    ----------
    cache_dir, cache_bytes
        Where objects are kept, and how much of them, computed layers included; 0: none.
    is_index, quiet
        As `KeptObjects` and `ObjectTier` have them.
    """
    tier = ObjectTier(cache_dir, limit_bytes=cache_bytes, quiet=quiet) if cache_dir and cache_bytes else None
    return KeptObjects(store, tier, is_index=is_index)
