# SPDX-License-Identifier: Apache-2.0
"""The store that a daemon and its loaders serve a published map from; the one place where they open it."""

from __future__ import annotations

from typing import NamedTuple

from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import HASTY, Patience, Store

__all__ = ["ServedFrom", "open_for_serving"]


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


def open_for_serving(served: ServedFrom, patience: Patience = HASTY) -> Store:
    """Return the store: somebody waits for what it gives.

    What is immutable is read by `Store.get_exactly` alone.  Errors are those of `open_store`.
    """
    return open_store(
        served.url,
        patience=patience,
        insecure_http=served.insecure_http,
        instance_credentials=served.instance_credentials,
    )
