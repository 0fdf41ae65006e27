# SPDX-License-Identifier: Apache-2.0
"""Signing a published map: its keys, and the metadata that names its current version.

Three keys: ``root.pem`` names the others, is needed to make and to rotate them, and belongs offline;
``targets.pem`` signs versions, where one publishes; ``online.pem`` signs snapshot and timestamp, which is all
that a refresh needs.  What vehicles trust is ``ROOT.json``.  A version is current as soon as the timestamp
names it; ``CURRENT`` follows, for vehicles that verify nothing, and is repaired when the map is signed next.
"""

from __future__ import annotations

import os
import stat
from datetime import datetime, timedelta, timezone
from typing import Final, NamedTuple, TypeVar

from cryptography.hazmat.primitives.serialization import load_pem_private_key
from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata, MetaFile, Root, Snapshot, Targets, Timestamp

from shmmap.errors import BadRequest, ConfigError, InstanceBusy, MapMissing
from shmmap.failpoints import step
from shmmap.formats.durable_file import appearing_file, writing_errors
from shmmap.origin.remote.map_versions import (
    CURRENT,
    MAX_METADATA_BYTES,
    TIMESTAMP,
    Current,
    CurrentState,
    Entry,
    changed_meanwhile,
    entry_path,
    new_entry_now,
    pack_json,
    read_current,
    read_entry,
)
from shmmap.origin.remote.signed_metadata import (
    FOREIGN_ROOT,
    TARGET,
    SignedState,
    metadata_path,
    newest_root,
    read_signed_state,
    refused,
    target_of,
)
from shmmap.origin.remote.store import Store, put_over

__all__ = ["LIFETIMES", "ROOT_FILE", "MapSigner", "Refreshed"]

ROOT_FILE: Final = "ROOT.json"
LIFETIMES: Final = {
    Root.type: timedelta(days=3652),
    Targets.type: timedelta(days=365),
    Snapshot.type: timedelta(days=30),
    Timestamp.type: timedelta(days=7),
}
_KEYS: Final = {Root.type: "root", Targets.type: "targets", Snapshot.type: "online", Timestamp.type: "online"}
_MAX_TRIES: Final = 1000
_MAX_KEY_BYTES: Final = 1 << 16
_Role = TypeVar("_Role", Root, Timestamp, Snapshot, Targets)


class Refreshed(NamedTuple):
    """What a refresh signed: the version that stays current, and until when each role is valid."""

    current: Current
    timestamp: datetime
    snapshot: datetime
    targets: datetime


class MapSigner:
    """Signs versions of the map at one store.

    Parameters
    ----------
    directory
        Where the keys are.  Made, with keys, where there are none and nothing is signed at the store.

    Raises
    ------
    ConfigError
        A key can be read by others, is not a key, or is not the one that the root of trust names.
    BadRequest
        The map is signed, and these are not its keys; or the store is read-only.
    MapDataError
        What is signed there is damaged, or signed by other keys.
    """

    def __init__(self, store: Store, directory: str, *, make_keys: bool = True) -> None:
        if store.read_only:
            raise BadRequest(f"{store.url}: {store.read_only}")
        self._store = store
        self._directory = os.path.abspath(directory)
        root_file = os.path.join(self._directory, ROOT_FILE)
        if not os.path.exists(root_file):
            if not make_keys or store.head(TIMESTAMP) is not None:
                raise BadRequest(
                    f"{store.url} is signed, and {root_file} is not there"
                    if make_keys
                    else f"{root_file} is not there: that is no directory of keys",
                    hint="name the directory of the keys that signed it: --sign KEYDIR",
                )
            self._make_keys()
        with open(root_file, "rb") as file:
            self.trusted = file.read(MAX_METADATA_BYTES + 1)
        self._root = newest_root(store, self.trusted)
        self._check_origin()

    def begin(self) -> CurrentState:
        """Return what is current, for a new version: what is signed, or what ``CURRENT`` says if nothing is.

        Entry and ``CURRENT`` are repaired where they differ.

        Raises
        ------
        ConfigError
            A key that a version needs is not here, or cannot be used.
        """
        for role in (Targets.type, Timestamp.type):
            self._signer(role)
        return self._repaired()

    def _repaired(self) -> CurrentState:
        for _ in range(_MAX_TRIES):
            seen = read_current(self._store)  # before: so it is never ahead of what is signed
            state = self._state()
            if state is None or state.current == seen.current:
                return seen
            self._repair(state.current, seen)
        raise InstanceBusy(f"other publishers keep changing {self._store.url}", hint="try again later")

    def switch(self, entry: Entry) -> None:
        """Sign a new version, whose entry is made, and have ``CURRENT`` follow.

        Raises
        ------
        InstanceBusy
            Another publisher has signed one meanwhile: that stays.
        """
        self._sign(entry.current, entry.before)
        step("sign.signed")
        self._follow(entry.current)
        step("sign.switched")

    def keep(self, current: Current) -> None:
        """Have the current version signed where nothing has changed, and again in time."""
        self._sign(current, current.version)

    def refresh(self) -> Refreshed:
        """Sign the timestamp again, and the snapshot when half of its time is over; `CURRENT` is repaired.

        Raises
        ------
        MapMissing
            Nothing is signed there.
        """
        if self._state() is None:
            raise MapMissing(
                f"nothing is signed at {self._store.url}", hint="shmmap publish MAP URL --sign KEYDIR"
            )
        state = self._sign(None, 0)
        self._repaired()
        return Refreshed(
            state.current,
            state.timestamp.signed.expires,
            state.snapshot.signed.expires,
            state.targets.signed.expires,
        )

    # --- metadata -------------------------------------------------------------------------------

    def _state(self) -> SignedState | None:
        return read_signed_state(self._store, self._root)

    def _sign(self, current: Current | None, before: int) -> SignedState:
        """Have ``current`` named by targets, snapshot and timestamp; None: what is named already.

        ``before`` is the version that was current when this one was made: if another one is by now, that
        one stays.
        """
        state, made = self._state(), None
        for _ in range(_MAX_TRIES):
            named = state.current if state is not None else None
            if current is not None and named is not None and named != current and named.version != before:
                raise changed_meanwhile(self._store)
            targets = seen = state.targets if state is not None else None
            if current is not None and (targets is None or named != current or _is_half_over(targets)):
                if made is None:
                    made = self._add(Targets, targets, Targets(targets={TARGET: target_of(current)}))
                targets = made
            assert targets is not None  # noqa: S101  a refresh has looked
            snapshot = state.snapshot if state is not None else None
            if snapshot is None or targets is not seen or _is_half_over(snapshot):
                meta = {f"{Targets.type}.json": MetaFile(targets.signed.version)}
                snapshot = self._add(Snapshot, snapshot, Snapshot(meta=meta))
            elif state is not None and current is not None and not _is_half_over(state.timestamp):
                return state  # a refresh signs the timestamp again in any case
            written = self._write_timestamp(state, snapshot, targets)
            if written is not None:
                return written
            state = self._state()  # a refresh came between, or another version
        raise InstanceBusy(f"other publishers keep signing {self._store.url}", hint="try again later")

    def _write_timestamp(
        self, state: SignedState | None, snapshot: Metadata[Snapshot], targets: Metadata[Targets]
    ) -> SignedState | None:
        """Replace the timestamp if it is the one that was seen; None: it is another one now."""
        before = state.timestamp.signed.version if state is not None else 0
        signed = Timestamp(
            version=before + 1,
            snapshot_meta=MetaFile(snapshot.signed.version),
            expires=_now() + LIFETIMES[Timestamp.type],
            unrecognized_fields={"signed": _now().strftime("%Y-%m-%dT%H:%M:%SZ")},
        )
        data = self._signed_bytes(signed)
        step("sign.timestamp")
        if not put_over(self._store, TIMESTAMP, data, state.tag if state is not None else None):
            return None
        return SignedState(Metadata.from_bytes(data), {}, snapshot, targets)

    def _add(self, kind: type[_Role], before: Metadata[_Role] | None, signed: _Role) -> Metadata[_Role]:
        """Write metadata under the next free number: those that were never named are passed over."""
        signed.expires = _now() + LIFETIMES[kind.type]
        first = before.signed.version + 1 if before is not None else 1
        for number in range(first, first + _MAX_TRIES):
            signed.version = number
            data = self._signed_bytes(signed)
            step("sign.metadata")
            if self._store.put_new(metadata_path(kind.type, number), data):
                return Metadata.from_bytes(data)
        raise InstanceBusy(f"other publishers take every number at {self._store.url}", hint="try again later")

    def _signed_bytes(self, signed: _Role) -> bytes:
        metadata = Metadata(signed)
        metadata.sign(self._signer(signed.type))
        return metadata.to_bytes()

    def _check_origin(self) -> None:
        """Have the first root at the store, which must be the one of these keys."""
        number = Metadata[Root].from_bytes(self.trusted).signed.version
        path = metadata_path(Root.type, number)
        try:
            found = bytes(self._store.get(path, MAX_METADATA_BYTES))
        except MapMissing:
            step("sign.root")
            if self._store.put_new(path, self.trusted):
                return
            found = bytes(self._store.get(path, MAX_METADATA_BYTES))
        if found != self.trusted:
            raise refused(
                f"{self._store.url}/{path}",
                FOREIGN_ROOT,
                f"it is not {os.path.join(self._directory, ROOT_FILE)}",
                hint="name the directory of the keys that signed the map: --sign KEYDIR",
            )

    # --- entry and CURRENT ----------------------------------------------------------------------

    def _repair(self, current: Current, seen: CurrentState) -> None:
        """Have entry and ``CURRENT`` say what is signed; what ``CURRENT`` says otherwise was never signed."""
        store = self._store
        try:
            is_right = read_entry(store, current.version).current == current
        except MapMissing:
            is_right = False
        else:
            if not is_right:
                store.delete(entry_path(current.version))
        if not is_right:
            earlier = seen.current.version if seen.current is not None else 0
            entry = new_entry_now(current, earlier if earlier < current.version else 0)
            store.put_new(entry_path(current.version), pack_json(entry))
        step("sign.repaired")
        put_over(store, CURRENT, pack_json(current), seen.tag)

    def _follow(self, current: Current) -> None:
        """Have ``CURRENT`` say this version, unless a later one is signed already."""
        for _ in range(_MAX_TRIES):
            seen = read_current(self._store)
            if seen.current is not None and seen.current.version >= current.version:
                return
            step("sign.switch")
            if put_over(self._store, CURRENT, pack_json(current), seen.tag):
                return

    # --- keys -----------------------------------------------------------------------------------

    def _make_keys(self) -> None:
        """Make what is missing of the keys, and then the root of trust that names them."""
        with writing_errors(self._directory):
            os.makedirs(self._directory, mode=0o700, exist_ok=True)
            for name in dict.fromkeys(_KEYS.values()):
                path = os.path.join(self._directory, f"{name}.pem")
                if not os.path.lexists(path):
                    _write_key(path)
            root = Root(expires=_now() + LIFETIMES[Root.type], consistent_snapshot=True)
            signers = {role: _read_key(self._directory, name) for role, name in _KEYS.items()}
            for role, signer in signers.items():
                root.add_key(signer.public_key, role)
            metadata = Metadata(root)
            metadata.sign(signers[Root.type])
            step("sign.keys")
            try:
                with appearing_file(os.path.join(self._directory, ROOT_FILE), replace=False) as file:
                    file.write(metadata.to_bytes())
            except FileExistsError:
                pass  # another run was quicker, with the same keys

    def _signer(self, role: str) -> CryptoSigner:
        signer = _read_key(self._directory, _KEYS[role])
        if signer.public_key.keyid not in self._root.signed.roles[role].keyids:
            path = os.path.join(self._directory, f"{_KEYS[role]}.pem")
            raise ConfigError(f"{path} is not the key that the map's root of trust names for {role}")
        return signer


def _write_key(path: str) -> None:
    data = CryptoSigner.generate_ed25519().private_bytes
    try:
        with appearing_file(path, replace=False) as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(data)
    except FileExistsError:
        pass


def _read_key(directory: str, name: str) -> CryptoSigner:
    path = os.path.join(directory, f"{name}.pem")
    try:
        with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(_MAX_KEY_BYTES)
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}", hint="this key is needed here; a refresh needs online.pem alone"
        ) from None
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077 or status.st_uid not in (os.geteuid(), 0):
        raise ConfigError(
            f"{path}: others can use this private key (mode {mode:04o}, user {status.st_uid})",
            hint=f"chmod 600 {path}; if others may have read it, make new keys",
        )
    try:
        return CryptoSigner(load_pem_private_key(data, None))
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{path}: it is no private key without a password: {error}") from None


def _is_half_over(metadata: Metadata[_Role]) -> bool:
    return metadata.signed.expires - _now() < LIFETIMES[metadata.signed.type] / 2


def _now() -> datetime:
    return datetime.now(timezone.utc).replace(microsecond=0)
