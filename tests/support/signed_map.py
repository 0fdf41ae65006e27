# SPDX-License-Identifier: Apache-2.0
"""A signed map, read and changed with python-tuf alone: nothing of shmmap's own signing is used."""

from __future__ import annotations

import json
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.serialization import load_pem_private_key
from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata

__all__ = ["Signed", "read_signed"]


class Signed:
    """The newest metadata of a map in a directory, each verified with the key of its role."""

    def __init__(self, store: Path, keys: Path) -> None:
        self.store, self.keys = store, keys
        self.root: Any = Metadata.from_file(str(store / "1.root.json"))
        assert (store / "1.root.json").read_bytes() == (keys / "ROOT.json").read_bytes()
        while (path := store / f"{self.root.signed.version + 1}.root.json").exists():
            following: Any = Metadata.from_file(str(path))
            for root in (self.root, following):
                root.signed.verify_delegate("root", following.signed_bytes, following.signatures)
            assert following.signed.version == self.root.signed.version + 1
            self.root = following
        self.timestamp: Any = self._read("timestamp.json", "timestamp")
        number = self.timestamp.signed.snapshot_meta.version
        self.snapshot: Any = self._read(f"{number}.snapshot.json", "snapshot")
        number = self.snapshot.signed.meta["targets.json"].version
        self.targets: Any = self._read(f"{number}.targets.json", "targets")
        (self.target,) = self.targets.signed.targets.values()
        assert self.target.path == "root"

    def _read(self, name: str, role: str) -> Any:
        found: Any = Metadata.from_file(str(self.store / name))
        self.root.signed.verify_delegate(role, found.signed_bytes, found.signatures)
        assert found.signed.type == role
        return found

    @property
    def version(self) -> int:
        number: int = self.target.custom["map_version"]
        return number

    @property
    def current(self) -> dict[str, Any]:
        """What ``CURRENT`` has to say."""
        return {
            "version": self.version,
            "root": self.target.hashes["sha256"],
            "bytes": self.target.length,
        }

    def write(self, role: str, **fields: Any) -> None:
        """Sign a role's newest metadata again, with other fields, under the same name."""
        metadata = getattr(self, role)
        for name, value in fields.items():
            setattr(metadata.signed, name, value)
        key = {"snapshot": "online", "timestamp": "online"}.get(role, role)
        private = load_pem_private_key((self.keys / f"{key}.pem").read_bytes(), None)
        metadata.sign(CryptoSigner(private))
        name = "timestamp.json" if role == "timestamp" else f"{metadata.signed.version}.{role}.json"
        metadata.to_file(str(self.store / name))

    def write_all(self, number: int, *, timestamp: int = 0, **fields: Any) -> None:
        """Sign targets with other fields, snapshot and timestamp, all with this number."""
        self.write("targets", version=number, **fields)
        self.snapshot.signed.meta["targets.json"].version = number
        self.timestamp.signed.snapshot_meta.version = number
        self.write("snapshot", version=number)
        self.write("timestamp", version=timestamp or number)


def read_signed(store: Path, keys: Path) -> Signed:
    """Read a signed map whose entry and ``CURRENT`` say what is signed."""
    signed = Signed(store, keys)
    current = json.loads((store / "CURRENT").read_bytes())
    entry = json.loads((store / f"versions/{signed.version}.json").read_bytes())
    assert current == signed.current
    assert {name: entry[name] for name in current} == current
    return signed


def in_days(days: float) -> datetime:
    return datetime.now(timezone.utc).replace(microsecond=0) + timedelta(days=days)
