# SPDX-License-Identifier: Apache-2.0
"""Signs a published map: manages its keys, and the metadata that names its current version.

There are three keys.  ``root.pem`` authorises the others, is needed to make and to rotate them, and should
be kept offline.  ``targets.pem`` signs versions on the machine that publishes.  ``online.pem`` signs snapshot
and timestamp, and is the only key that a refresh needs.  Vehicles trust ``ROOT.json``.  A version is current
as soon as the timestamp names it.  ``CURRENT`` is updated afterwards, for vehicles that do not verify; if
that fails, the next signing repairs it.

The map stays valid at each moment of a rotation, even if the rotation is killed.  The next key is stored
beside the old one, as ``<name>.next.pem``.  A new root names both keys, and the metadata is signed again by
both; then another root names only the next key, which replaces the old one.  To rotate the root's own key
takes only one root, signed by the old and the next key.
"""

from __future__ import annotations

import copy
import os
import stat
from collections.abc import Sequence
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
from shmmap.private_directory import require_private

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
    """Result of a refresh: the version that stays current, and the expiry of each role."""

    current: Current
    timestamp: datetime
    snapshot: datetime
    targets: datetime


class Rotated(NamedTuple):
    """Result of a rotation: the roles with a new key, the key's file, and the number of the newest root."""

    roles: tuple[str, ...]
    key: str
    root: int


class MapSigner:
    """Signs versions of the map at one store.

    Parameters
    ----------
    directory
        Directory of the keys.  If it has none and nothing is signed at the store, both are created.

    Raises
    ------
    ConfigError
        A key's file is readable by others, is not a key, or is not the key that the root of trust names.
    BadRequest
        The map is signed, and these are not its keys; or the store is read-only.
    MapDataError
        The store's signed metadata is damaged, or signed by other keys.
    """

    def __init__(self, store: Store, directory: str, *, make_keys: bool = True) -> None:
        store.require_conditions()
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
        for name in dict.fromkeys(_KEYS.values()):
            self._finish_rotation(name)

    def begin(self) -> CurrentState:
        """Return the version that a new one replaces: the signed one, or that in ``CURRENT`` if none is.

        Entry and ``CURRENT`` are repaired if they differ from the signed version.

        Raises
        ------
        ConfigError
            A key for signing versions is missing, or cannot be used.
        """
        for role in (Targets.type, Timestamp.type):
            self._signers(role)
        return self._repaired()

    def _repaired(self) -> CurrentState:
        for _ in range(_MAX_TRIES):
            seen = read_current(self._store)  # read first, so that it is never newer than the signed state
            state = self._state()
            if state is None or state.current == seen.current:
                return seen
            self._repair(state.current, seen)
        raise InstanceBusy(f"other publishers keep changing {self._store.url}", hint="try again later")

    def switch(self, entry: Entry) -> None:
        """Sign a new version, whose entry exists, and then update ``CURRENT``.

        Raises
        ------
        InstanceBusy
            Another publisher has signed a version meanwhile, which stays.
        """
        self._sign(entry.current, entry.before)
        step("sign.signed")
        self._follow(entry.current)
        step("sign.switched")

    def keep(self, current: Current) -> None:
        """Sign the current version if it is unsigned, and renew signatures after half of their validity."""
        self._sign(current, current.version)

    def refresh(self) -> Refreshed:
        """Sign the timestamp again, the snapshot after half of its validity, and repair ``CURRENT``.

        Raises
        ------
        MapMissing
            The store has no signed map.
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

    def rotate(self, role: str) -> Rotated:
        """Replace the key of a role; snapshot and timestamp share a key, so both get the new one.

        The old key is removed.  A rotation that was killed is continued.

        Raises
        ------
        MapMissing
            The store has no signed map.
        ConfigError
            A required key is missing; ``root.pem`` is always required.
        InstanceBusy
            Another rotation ran meanwhile.
        """
        if self._state() is None:
            raise MapMissing(
                f"nothing is signed at {self._store.url}", hint="shmmap publish MAP URL --sign KEYDIR"
            )
        if not os.path.lexists(self._key_path("root")):
            raise ConfigError(
                f"{self._key_path('root')} is not there, and it alone says which keys sign the map",
                hint="it is offline: put it there for as long as this takes",
            )
        name = _KEYS[role]
        roles = tuple(one for one, key in _KEYS.items() if key == name)
        following = self._next_key(name)
        if role != Root.type:
            if following.public_key.keyid not in self._root.signed.roles[role].keyids:
                self._add_root(roles, following, keep=True)
            self._sign(None, 0)
            step("sign.renewed")
        before = self._root
        self._add_root(roles, following, keep=False)
        step("sign.rotated")
        if role != Root.type:
            # a publisher with the old key may have signed until now; after this root none can
            self._sign(None, 0, read_under=before)
        self._finish_rotation(name)
        return Rotated(roles, self._key_path(name), self._root.signed.version)

    def _add_root(self, roles: Sequence[str], following: CryptoSigner, *, keep: bool) -> None:
        """Write the next root, which gives roles the key ``following``, besides the old one if ``keep``."""
        signers = self._signers(Root.type)
        root = copy.deepcopy(self._root.signed)
        root.version += 1
        root.expires = _now() + LIFETIMES[Root.type]
        for role in roles:
            for keyid in () if keep else tuple(root.roles[role].keyids):
                root.revoke_key(keyid, role)
            root.add_key(following.public_key, role)
        if Root.type in roles:
            signers.append(following)
        data = _signed_by(root, signers)
        step("sign.nextroot")
        if not self._store.put_new(metadata_path(Root.type, root.version), data):
            raise InstanceBusy(
                f"another rotation of {self._store.url} came between", hint="run the same command again"
            )
        self._root = Metadata.from_bytes(data)

    def _finish_rotation(self, name: str) -> None:
        """Replace the old key's file by the next one's, if the root no longer names the old key."""
        following = self._key_path(f"{name}.next")
        if not os.path.lexists(following):
            return
        role = next(role for role, key in _KEYS.items() if key == name)
        named = [signer.public_key.keyid for signer in self._keys_here(role)]
        if named == [_read_key(self._directory, f"{name}.next").public_key.keyid]:
            with writing_errors(following):
                os.replace(following, self._key_path(name))

    # --- metadata -------------------------------------------------------------------------------

    def _state(self) -> SignedState | None:
        return read_signed_state(self._store, self._root)

    def _sign(
        self, current: Current | None, before: int, *, read_under: Metadata[Root] | None = None
    ) -> SignedState:
        """Make targets, snapshot and timestamp name ``current``; None: the version they already name.

        ``before`` is the version that was current when this one was made: if another version is current by
        now, that one stays.  ``read_under`` is the root whose keys signed the present state, if that is not
        the newest root.
        """
        made: tuple[Current, int, Metadata[Targets]] | None = None
        for _ in range(_MAX_TRIES):
            state = read_signed_state(self._store, read_under or self._root)
            if self._has_newer_root():  # read after the state, whose successor needs this root's keys
                continue
            named = state.current if state is not None else None
            if current is not None and named is not None and named != current and named.version != before:
                raise changed_meanwhile(self._store)
            wanted = current or named
            assert wanted is not None  # noqa: S101  refresh and rotation have checked this
            targets = seen = state.targets if state is not None else None
            is_over = targets is None or named != wanted or (current is not None and _is_half_over(targets))
            if targets is None or is_over or not self._is_signed(targets):
                if made is None or made[:2] != (wanted, self._root.signed.version):
                    added = self._add(Targets, targets, Targets(targets={TARGET: target_of(wanted)}))
                    made = wanted, self._root.signed.version, added
                targets = made[2]
            snapshot = state.snapshot if state is not None else None
            if (
                snapshot is None
                or targets is not seen
                or _is_half_over(snapshot)
                or not self._is_signed(snapshot)
            ):
                meta = {f"{Targets.type}.json": MetaFile(targets.signed.version)}
                snapshot = self._add(Snapshot, snapshot, Snapshot(meta=meta))
            elif state is not None and current is not None and not _is_half_over(state.timestamp):
                return state  # refresh and rotation always sign the timestamp again
            written = self._write_timestamp(state, snapshot, targets)
            if written is not None:
                return written
        raise InstanceBusy(f"other publishers keep signing {self._store.url}", hint="try again later")

    def _write_timestamp(
        self, state: SignedState | None, snapshot: Metadata[Snapshot], targets: Metadata[Targets]
    ) -> SignedState | None:
        """Replace the timestamp if it is still that of ``state``; return None if it has changed."""
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
        """Write metadata under the next free number, skipping numbers of metadata that was never named."""
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
        return _signed_by(signed, self._signers(signed.type))

    def _has_newer_root(self) -> bool:
        """Read the newest root; return True if keys were rotated since the last read."""
        newest = newest_root(self._store, self.trusted)
        before, self._root = self._root, newest
        return newest.signed.version != before.signed.version

    def _is_signed(self, metadata: Metadata[_Role]) -> bool:
        """Whether all local keys have signed the metadata; False during a rotation."""
        here = self._keys_here(metadata.signed.type)
        return all(signer.public_key.keyid in metadata.signatures for signer in here)

    def _check_origin(self) -> None:
        """Write the first root to the store; an existing one must be the root of these keys."""
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
        """Make entry and ``CURRENT`` name the signed version; any other version there was never signed."""
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
        """Make ``CURRENT`` name this version, unless it names a later one already."""
        for _ in range(_MAX_TRIES):
            seen = read_current(self._store)
            if seen.current is not None and seen.current.version >= current.version:
                return
            step("sign.switch")
            if put_over(self._store, CURRENT, pack_json(current), seen.tag):
                return

    # --- keys -----------------------------------------------------------------------------------

    def _make_keys(self) -> None:
        """Create missing keys, and then the root of trust that names them."""
        with writing_errors(self._directory):
            require_private(self._directory)
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
                pass  # another run with the same keys was quicker

    def _key_path(self, name: str) -> str:
        return os.path.join(self._directory, f"{name}.pem")

    def _next_key(self, name: str) -> CryptoSigner:
        """Return the next key: that of a killed rotation, or a new one."""
        path = self._key_path(f"{name}.next")
        with writing_errors(self._directory):
            if not os.path.lexists(path):
                _write_key(path)
        step("sign.nextkey")
        return _read_key(self._directory, f"{name}.next")

    def _keys_here(self, role: str) -> list[CryptoSigner]:
        """Return a role's local keys that the root names; during a rotation the old and the next one."""
        names = (_KEYS[role], f"{_KEYS[role]}.next")
        here = [_read_key(self._directory, name) for name in names if os.path.lexists(self._key_path(name))]
        return [signer for signer in here if signer.public_key.keyid in self._root.signed.roles[role].keyids]

    def _signers(self, role: str) -> list[CryptoSigner]:
        """Return the keys that a role signs with; raise an error if there are none."""
        if not (here := self._keys_here(role)):
            _read_key(self._directory, _KEYS[role])  # raises the reason if the key cannot be read
            raise ConfigError(
                f"{self._key_path(_KEYS[role])} is not the key that the map's root of trust names for {role}",
                hint="if that was rotated elsewhere, the new key belongs here",
            )
        return here


def _signed_by(signed: _Role, signers: Sequence[CryptoSigner]) -> bytes:
    metadata = Metadata(signed)
    for signer in signers:
        metadata.sign(signer, append=True)
    return metadata.to_bytes()


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
