# SPDX-License-Identifier: Apache-2.0
"""Whether a store writes on conditions, asked before anything is sent.

A publisher creates a version's entry only if there is none, and replaces ``CURRENT`` only if it is still what
the publisher has seen.  Stores and proxies exist that ignore these conditions and answer 200: of two
publishers at once, one would lose its version, and neither would notice.  (s3rver 3.7 ignores both
conditions; OpenStack Swift 2.30 creates nothing with ``If-None-Match: *``.)  An ETag that is weak, as proxies
make that compress, does not name a state.  What was written is read back after each new version.
"""

from __future__ import annotations

import random
import secrets
import time
from typing import Final, Literal, NamedTuple, Protocol, TypeAlias

from shmmap.errors import CannotWrite, MapMissing
from shmmap.origin.remote.store import NoTag, StoreRefused, Tag

ASKED: Final = "conditions.json"
"""The object that publishers write to find out what the store can do; readers and pruning ignore it."""
_NEEDED: Final = "PUBLISHING.md says what a store has to do, and which stores do it"
_OPTION: Final = f"{_NEEDED}; --sole-publisher, if no two programs ever publish there at the same time"
_Outcome: TypeAlias = Literal["replaced", "kept", "another's"]
_ROUNDS: Final = 5
_LONGEST_PAUSE_S: Final = 0.2
_UNCERTAIN: Final = (408, 429, 500, 502, 503, 504)  # says nothing about conditions


class Seen(NamedTuple):
    """What a store returns for an object: its bytes and its tag."""

    data: bytes
    tag: Tag


class ConditionalStore(Protocol):
    """Store whose writes show how it treats conditions."""

    url: str

    def write(
        self, path: str, data: bytes, only_if: Tag | None = None, *, create: bool = False
    ) -> Tag | None:
        """Write an object and return its tag; None if the store has refused because of the condition.

        The conditions: the object is in the state ``only_if``, or does not exist (``create``).
        """

    def look(self, path: str) -> Seen:
        """Return what the store returns for an object, whatever it is; a page is refused."""


def ask_conditions(store: ConditionalStore) -> None:
    """Raise an error if a store does not write on conditions, by five requests for one small object.

    The content of each write is unique, so that several publishers can ask at the same time.  The tag that a
    condition names is that of a read, as when a version is replaced: a proxy may change it, or that of a
    write.

    Raises
    ------
    CannotWrite
        The store ignores conditions, refuses them, or has no tags that could be used for them.
    StoreRefused
        The store does not return what was written: something else answers in its place.
    """
    outcomes: list[_Outcome] = []
    for _ in range(_ROUNDS):
        first, second = asked_content(), asked_content()
        earlier = _written(store, first)
        seen = refuse_foreign(store)
        refuse_unsafe_tag(store.url, seen.tag)
        outcome: _Outcome = "another's"
        if seen.data == first:
            is_replaced = _conditional(store, second, only_if=seen.tag) is not None
            outcome = "replaced" if is_replaced else _after_refusal(store, first, second)
        if outcome == "another's":
            _written(store, asked_content())  # what was read may have been an old state
        if outcome != "kept":
            _refuse_ignored(store, earlier)
        if outcome == "replaced":
            return
        outcomes.append(outcome)
        time.sleep(random.uniform(0.0, _LONGEST_PAUSE_S))  # noqa: S311  no secret
    if set(outcomes) == {"kept"}:
        raise CannotWrite(
            f"{store.url}: the store does not replace an object whose ETag is named: a version cannot be"
            " replaced",
            hint=_OPTION,
        )
    # other publishers keep asking: what could lose a version has been refused each time


def _refuse_ignored(store: ConditionalStore, old: Tag) -> None:
    """Raise `CannotWrite` if the store ignores a condition; ``old`` is the tag of an earlier state."""
    named = {
        "If-Match": _conditional(store, asked_content(), only_if=old),
        "If-None-Match": _conditional(store, asked_content(), create=True),
    }
    ignored = [name for name, written in named.items() if written is not None]
    if ignored:
        refuse_foreign(store)
        raise CannotWrite(
            f"{store.url}: the store ignores the conditions of writes ({' and '.join(ignored)}): of two"
            " publishers at once, one would lose its version",
            hint=_OPTION,
        )


def refuse_unsafe_tag(url: str, tag: Tag) -> None:
    """Raise `CannotWrite` if an object cannot be replaced safely on the condition of its tag."""
    if url.startswith("gs://"):  # compares the generation instead
        return
    if "e_tag" not in tag:
        raise CannotWrite(
            f"{url}: the store gives no ETags: a version cannot be replaced safely", hint=_OPTION
        )
    if tag["e_tag"].startswith("W/"):
        raise CannotWrite(
            f"{url}: the store, or a proxy before it, gives weak ETags: a version cannot be replaced safely",
            hint=_OPTION,
        )


def asked_content() -> bytes:
    """Return new, unique content of the object."""
    return b'{"asked": "%s"}\n' % secrets.token_hex(16).encode()


def _is_content(data: bytes) -> bool:
    return len(data) == len(asked_content()) and data.startswith(b'{"asked": "')


def _written(store: ConditionalStore, data: bytes) -> Tag:
    try:
        tag = store.write(ASKED, data)
    except NoTag:
        refuse_foreign(store)
        raise CannotWrite(
            f"{store.url}: the store gives no ETags for what it is sent: no map can be published there",
            hint=_NEEDED,
        ) from None
    assert tag is not None  # noqa: S101  there was no condition
    return tag


def _conditional(
    store: ConditionalStore, data: bytes, *, only_if: Tag | None = None, create: bool = False
) -> Tag | None:
    """Write on a condition, which the store may refuse to know; it has just taken a write without one."""
    try:
        return store.write(ASKED, data, only_if, create=create)
    except StoreRefused as error:
        if error.status in _UNCERTAIN:
            raise
        why = error.message.rpartition(": ")[2]
    except MapMissing:
        why = "status 404"
    refuse_foreign(store)
    raise CannotWrite(
        f"{store.url}: the store takes no writes on conditions ({why}): of two publishers at once, one"
        " would lose its version",
        hint=_OPTION,
    )


def _after_refusal(store: ConditionalStore, first: bytes, second: bytes) -> _Outcome:
    """Return what has become of the object after the store has refused to replace ``first`` by ``second``."""
    seen = refuse_foreign(store)
    if seen.data == second:  # the answer to an earlier attempt was lost
        return "replaced"
    return "kept" if seen.data == first else "another's"


def refuse_foreign(store: ConditionalStore) -> Seen:
    """Return the object as the store returns it; raise `StoreRefused` if that is no publisher's question."""
    try:
        seen = store.look(ASKED)
    except MapMissing:
        raise StoreRefused(
            f"{store.url}/{ASKED}: the store has accepted it, and does not have it", hint="is it a store?"
        ) from None
    if not _is_content(seen.data):
        raise StoreRefused(
            f"{store.url}: what the store answers is no map: something else",
            hint="does this network want a login first, or is the address that of something else?",
        )
    return seen
