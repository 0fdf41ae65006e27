# SPDX-License-Identifier: Apache-2.0
"""A root of trust is read before the process is started, and that process has a time limit."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from shmmap.errors import ConfigError, MapDataError, ShmmapError
from shmmap.origin.remote.store import may_be_plain
from shmmap.origin.remote.verify_apart import VerifySettings, read_trusted_root, verify_apart

ROOT_OF_TRUST = b'{"signed": {"_type": "root"}, "signatures": []}'


def test_a_root_of_trust_is_recognised(tmp_path: Path) -> None:
    path = tmp_path / "ROOT.json"
    path.write_bytes(ROOT_OF_TRUST)
    assert read_trusted_root(str(path)) == ROOT_OF_TRUST
    for content in (
        b"", b"{", b"[]", b"{}", b'{"signed": 1}', b'{"signed": {"_type": "timestamp"}}', b"\xff\xfe",
        b"[" * 100_000, b"-----BEGIN PRIVATE KEY-----",
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(ConfigError, match="no root of trust") as caught:
            read_trusted_root(str(path))
        assert (caught.value.key, str(path) in str(caught.value)) == ("trust", True)
        assert "ROOT.json that `publish --sign` makes" in caught.value.hint
    path.write_bytes(b" " * 600_000)
    with pytest.raises(ConfigError, match="too large"):
        read_trusted_root(str(path))
    path.unlink()
    path.mkdir()
    with pytest.raises(ConfigError):
        read_trusted_root(str(path))
    path.rmdir()
    os.mkfifo(path)
    with pytest.raises(ConfigError):  # and no writer is waited for
        read_trusted_root(str(path))


def test_the_process_is_bounded_in_time_and_its_errors_are_raised_here(tmp_path: Path) -> None:
    pytest.importorskip("tuf", reason="tuf is not installed")
    path = tmp_path / "ROOT.json"
    path.write_bytes(ROOT_OF_TRUST)
    (tmp_path / "store").mkdir()
    settings = VerifySettings(str(tmp_path / "store"), str(path), str(tmp_path / "state"))
    with pytest.raises(ShmmapError, match="has not ended within 0 s"):
        verify_apart(settings, timeout_s=1e-6)
    with pytest.raises(ConfigError, match="no root of trust"):  # python-tuf looks closer
        verify_apart(settings)
    with pytest.raises(ConfigError, match="No such file"):
        verify_apart(VerifySettings(settings.url, str(tmp_path / "none"), settings.state_dir))


def test_which_maps_may_be_read_over_plain_http() -> None:
    for url in ("http://store/map", "HTTP://store/map", "https://store/map"):
        assert may_be_plain(url, insecure_http=False, trust="ROOT.json")
        assert may_be_plain(url, insecure_http=True, trust="")
        assert not may_be_plain(url, insecure_http=False, trust="")
        assert not may_be_plain(url, insecure_http=False, trust=None)
    # requests to a bucket carry credentials
    for url in ("s3://maps/town", "az://maps/town", "/srv/map", "file:///srv/map"):
        assert not may_be_plain(url, insecure_http=False, trust="ROOT.json")
        assert may_be_plain(url, insecure_http=True, trust="ROOT.json")


def test_an_offer_is_judged_by_the_latest_time_seen(tmp_path: Path) -> None:
    """If this machine's clock is behind: what had expired when the timestamp was signed has expired."""
    pytest.importorskip("tuf", reason="tuf is not installed")
    from datetime import datetime, timedelta, timezone

    from tuf.api.metadata import Metadata, Timestamp

    import shmmap.publishing.signing as signing
    from shmmap.origin.remote.map_versions import Current
    from shmmap.origin.remote.opened_store import DirectoryStore
    from shmmap.origin.remote.verify_version import verify_version

    store = DirectoryStore(str(tmp_path / "store"))
    signer = signing.MapSigner(store, str(tmp_path / "keys"))
    signer.keep(Current(1, "ab" * 32, 77))
    found = verify_version(store, signer.trusted, str(tmp_path / "state"))
    now = datetime.now(timezone.utc)
    assert (found.version, found.root, found.bytes) == (1, "ab" * 32, 77)
    assert abs(found.signed_s - now.timestamp()) < 60.0
    assert abs(found.expires_s - (now + signing.LIFETIMES["timestamp"]).timestamp()) < 60.0
    # a publisher two years ahead: what is valid by this clock was not when it signed
    later = now + timedelta(days=730)
    path = Path(store.url) / "timestamp.json"
    timestamp: Metadata[Timestamp] = Metadata.from_bytes(path.read_bytes())
    timestamp.signed.version = 2
    timestamp.signed.expires = later + timedelta(days=7)
    timestamp.signed.unrecognized_fields["signed"] = f"{later:%Y-%m-%dT%H:%M:%SZ}"
    timestamp.sign(signer._signers("timestamp")[0])
    path.write_bytes(timestamp.to_bytes())
    with pytest.raises(MapDataError, match=r"snapshot\.json was valid until") as caught:
        verify_version(store, signer.trusted, str(tmp_path / "state"))
    assert caught.value.cause == "expired"
    assert f"the timestamp was signed on {later:%Y-%m-%d}" in caught.value.message
    assert f"this machine's clock says {now:%Y-%m-%d}" in caught.value.message
