# SPDX-License-Identifier: Apache-2.0
"""A root of trust is read before the process is started, and that process has a time limit."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from shmmap.errors import ConfigError, ShmmapError
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
