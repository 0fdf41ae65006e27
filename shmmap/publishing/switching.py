# SPDX-License-Identifier: Apache-2.0
"""What publishing, joining and going back share: a new version becomes current, signed or not.

Between `begin_version` and `switch_version` the objects of the version are sent or checked.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from shmmap.errors import CannotWrite
from shmmap.origin.remote.map_versions import CurrentState, Entry, add_version, read_current, refuse_if_signed
from shmmap.origin.remote.store import Store

if TYPE_CHECKING:
    from shmmap.publishing.signing import MapSigner

__all__ = ["begin_version", "refuse_if_late", "switch_version"]

_LONGEST_S: Final = 86_400.0  # objects that a run reuses must not become as old as those that pruning removes


def begin_version(store: Store, signer: MapSigner | None, verb: str) -> CurrentState:
    """Return the current version, which the new one replaces.

    Parameters
    ----------
    signer
        Signs the new version; None for a map that is not signed.
    verb
        What to do with the keys, for the hint: ``"publish it"``.

    Raises
    ------
    BadRequest
        The map is signed and there is no signer.
    """
    if signer is not None:
        return signer.begin()
    refuse_if_signed(store, f"{verb} with the keys that signed it: --sign KEYDIR")
    return read_current(store)


def refuse_if_late(began_s: float, what: str, hint: str) -> None:
    """Raise `CannotWrite` if a run that began then, by `time.monotonic`, took longer than a day."""
    if time.monotonic() - began_s > _LONGEST_S:
        raise CannotWrite(f"{what} took longer than a day: the version is not made current", hint=hint)


def switch_version(store: Store, entry: Entry, seen: CurrentState, signer: MapSigner | None) -> None:
    """Make the version of an entry current, unless another one than ``seen`` is: `InstanceBusy`."""
    if signer is None:
        add_version(store, entry, seen)
    else:
        signer.switch(entry)
