# SPDX-License-Identifier: Apache-2.0
"""Which maps are divided first, and what stays in the cache."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing import served_cloud
from shmmap.dividing.served_cloud import DividedCloud, find_origin
from shmmap.errors import CannotWrite, MapDataError, MapMissing
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin import map_directory
from shmmap.origin.map_directory import MapDirectory


def cloud(path: Path, points: int = 100) -> Path:
    rng = np.random.default_rng(points)
    write_pcd(path, {"xyz": rng.uniform(-30, 30, (points, 3)).astype(np.float32)})
    return path


def test_which_maps_are_divided_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def kind(path: Path) -> type[object]:
        return type(find_origin(str(path), cache_dir=str(tmp_path / "cache")))

    for name in ("a.las", "b.LAZ", "c.ply", "d.xyz"):
        (tmp_path / name).write_bytes(b"")
        assert kind(tmp_path / name) is DividedCloud
    small = cloud(tmp_path / "small.pcd")
    assert kind(small) is MapDirectory
    assert kind(tmp_path) is MapDirectory
    (tmp_path / "bad.pcd").write_bytes(b"nothing like it")
    assert kind(tmp_path / "bad.pcd") is MapDirectory
    monkeypatch.setattr(map_directory, "MAX_SINGLE_PCD_BYTES", 500)
    assert kind(small) is DividedCloud
    with pytest.raises(MapMissing):
        kind(tmp_path / "gone.las")


def test_the_cache_keeps_what_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served_cloud, "_KEPT_CLOUDS", 1)
    sent: list[str] = []
    served = DividedCloud(
        str(cloud(tmp_path / "0.pcd")), str(tmp_path / "cache"), notify=lambda *lines: sent.extend(lines)
    )
    assert len(served.load()) > 4
    assert any(line.startswith("STATUS=") for line in sent)
    for i in (1, 2):
        origin = DividedCloud(str(cloud(tmp_path / f"{i}.pcd")), str(tmp_path / "cache"))
        origin.load()
        os.close(origin._use_lock)  # as when its daemon ends
    assert {name.split("-")[0] for name in os.listdir(tmp_path / "cache" / "divided")} == {"0", "2"}
    assert len(served.load(fresh=True)) > 4


def test_a_planted_division_is_not_served(tmp_path: Path) -> None:
    """Its name can be computed by all who may write to the cache; a daemon says why it does not start."""
    origin = DividedCloud(str(cloud(tmp_path / "0.pcd")), str(tmp_path / "cache"))
    origin.load()
    (divided,) = (tmp_path / "cache" / "divided").iterdir()
    for plant, why in (
        (lambda: divided.chmod(0o775), r"may be written by other users \(mode 0775\).*chmod go-w"),
        (lambda: (tmp_path / "cache").chmod(0o777), r"cache: it may be written by other users \(mode 0777\)"),
        (lambda: divided.rename(tmp_path / "aside"), ""),
        (lambda: divided.symlink_to(tmp_path / "aside"), "is a symbolic link"),
    ):
        plant()
        if why:
            with pytest.raises(CannotWrite, match=why):
                origin.load(fresh=True)
        for path in (divided, tmp_path / "cache"):
            if path.exists() and not path.is_symlink():
                path.chmod(0o700)
    divided.unlink()
    (tmp_path / "aside").rename(divided)
    (divided.parent / "link").symlink_to(tmp_path)
    assert len(origin.load(fresh=True)) > 4


def test_a_change_is_seen_and_nothing_old_stays(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.pcd")
    origin = DividedCloud(str(path), str(tmp_path / "cache"))
    first = origin.load()
    assert origin.load().map_version == first.map_version
    cloud(path, 200)
    second = origin.load(fresh=True)
    assert second.map_version != first.map_version
    assert second.id_prefix == first.id_prefix
    (folder,) = (tmp_path / "cache" / "divided").iterdir()
    assert len([name for name in os.listdir(folder) if not name.startswith(".")]) == 2


def test_where_the_daemon_was_started_plays_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies there is not imported, and a cache named from there is found again from elsewhere."""
    (tmp_path / "json.py").write_text("raise SystemExit('another program wrote this')")
    monkeypatch.chdir(tmp_path)
    cloud(tmp_path / "a.laz.pcd")
    monkeypatch.setattr(map_directory, "MAX_SINGLE_PCD_BYTES", 500)
    catalogue = find_origin("a.laz.pcd", cache_dir="cache").load()
    assert catalogue.id_prefix.startswith(f"{tmp_path}/cache/divided/")


def test_errors_of_the_divider_are_the_daemon_s(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.pcd")
    os.truncate(path, path.stat().st_size - 3)
    origin = DividedCloud(str(path), str(tmp_path / "cache"))
    with pytest.raises(MapDataError, match="points"):
        origin.load()
    path.unlink()
    with pytest.raises(MapMissing):
        origin.load()
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        DividedCloud(str(cloud(tmp_path / "b.pcd")), str(tmp_path / "file")).load()
