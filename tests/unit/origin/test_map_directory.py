# SPDX-License-Identifier: Apache-2.0
"""Maps on disk in every layout, ids, liberal and strict reading, and what is reported."""

from __future__ import annotations

import contextlib
import os
import resource
import struct
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from shmmap.errors import LimitReached, MapDataError, MapMissing
from shmmap.geometry import Circle
from shmmap.origin.map_directory import open_map
from shmmap.segment.layout import SourceStamp
from tests.support.divided_map import write_pcd

NAMES = ("t_0_0.pcd", "t_20_0.pcd", "t_-20_40.pcd")
CORNERS = {"t_0_0.pcd": (0, 0), "t_20_0.pcd": (20, 0), "t_-20_40.pcd": (-20, 40)}


def metadata_text(names: Sequence[str] = NAMES, extra: str = "") -> str:
    entries = "".join(f"{name}: [{CORNERS[name][0]}, {CORNERS[name][1]}]\n" for name in names)
    return "x_resolution: 20\ny_resolution: 20\n" + entries + extra


def put_cells(directory: Path, names: Sequence[str] = NAMES) -> None:
    """A divided map's files are not opened before they are loaded: any bytes do."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in names:
        (directory / name).write_bytes(name.encode())


def autoware_map(root: Path) -> Path:
    put_cells(root / "pointcloud_map.pcd")
    (root / "pointcloud_map_metadata.yaml").write_text(metadata_text())
    return root


def check(map_path: Path | str, cells: Path, **options: object) -> None:
    catalogue = open_map(map_path, **options).load()  # type: ignore[arg-type]
    assert catalogue.ids(np.arange(len(catalogue))) == sorted(str(cells / name) for name in NAMES)
    assert catalogue.problems == ()
    for name in NAMES:
        index = catalogue.find(name)
        assert index is not None
        x, y = CORNERS[name]
        assert catalogue.box(index) == (x, y, x + 20, y + 20)
        status = (cells / name).stat()
        assert catalogue.stamp(index) == SourceStamp.of(status).token
        assert catalogue.source_bytes(index) == status.st_size
    assert catalogue.ids(catalogue.query(Circle(-10.0, 50.0, 1.0))[0]) == [str(cells / "t_-20_40.pcd")]


def test_metadata_beside_or_inside_a_directory_of_any_name(tmp_path: Path) -> None:
    root = autoware_map(tmp_path / "beside")
    cells = root / "pointcloud_map.pcd"
    check(root, cells, strict=True)
    for path in (root, cells, root / "pointcloud_map_metadata.yaml"):
        check(path, cells)
    (root / "pointcloud_map_metadata.yaml").rename(cells / "pointcloud_map_metadata.yaml")
    check(root, cells)
    check(cells, cells)
    root = tmp_path / "plain"
    cells = root / "cells"
    put_cells(cells)
    (cells / "pointcloud_data_metadata.yaml").write_text(metadata_text())
    check(cells, cells)
    (cells / "pointcloud_data_metadata.yaml").rename(root / "pointcloud_map_metadata.yaml")
    check(cells, cells)
    check(root, cells)


def test_nested_folders_of_the_divider_s_large_grid(tmp_path: Path) -> None:
    for name in NAMES:
        put_cells(tmp_path / "pointcloud_map.pcd" / f"{CORNERS[name][0]}_{CORNERS[name][1]}", [name])
    (tmp_path / "pointcloud_map_metadata.yaml").write_text(metadata_text())
    catalogue = open_map(tmp_path).load()
    assert len(catalogue) == 3
    assert catalogue.find("t_20_0.pcd") == catalogue.find(
        str(tmp_path / "pointcloud_map.pcd/20_0/t_20_0.pcd")
    )
    assert catalogue.problems == ()
    with pytest.raises(MapMissing, match="no PCD file"):
        open_map(tmp_path, strict=True).load()


def test_the_same_base_name_twice_is_served_twice(tmp_path: Path) -> None:
    put_cells(tmp_path / "a", ["t_0_0.pcd"])
    put_cells(tmp_path / "b", ["t_0_0.pcd"])
    (tmp_path / "pointcloud_map_metadata.yaml").write_text(metadata_text(["t_0_0.pcd"]))
    catalogue = open_map(tmp_path).load()
    assert [catalogue.box(i) for i in range(2)] == [(0.0, 0.0, 20.0, 20.0)] * 2
    assert "same box" in catalogue.problems[0]


def test_ids_are_the_same_however_the_map_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = autoware_map(tmp_path / "city")
    (tmp_path / "other").mkdir()
    spellings = [
        (tmp_path, "city"),
        (tmp_path, "./city/"),
        (tmp_path, "city//."),
        (root, "."),
        (root, ""),
        (root / "pointcloud_map.pcd", ".."),
        (tmp_path / "other", "../city"),
        (Path("/"), str(root)),
        (Path("/"), os.path.relpath(root, "/")),
    ]
    versions = set()
    for directory, path in spellings:
        monkeypatch.chdir(directory)
        check(path or os.curdir, root / "pointcloud_map.pcd")
        versions.add(open_map(path or os.curdir).load().map_version)
    assert len(versions) == 1


def test_links_keep_their_names_and_lead_where_the_kernel_says(tmp_path: Path) -> None:
    root = autoware_map(tmp_path / "v1")
    (tmp_path / "current").symlink_to(root)
    check(tmp_path / "current", tmp_path / "current" / "pointcloud_map.pcd")
    deep = tmp_path / "x" / "y"
    deep.mkdir(parents=True)
    (tmp_path / "link").symlink_to(deep)
    # "link/.." is x, not the link's own directory
    (tmp_path / "x" / "city").symlink_to(root)
    check(f"{tmp_path}/link/../city", tmp_path / "v1" / "pointcloud_map.pcd")


def test_linked_files_and_directory_loops(tmp_path: Path) -> None:
    put_cells(tmp_path / "store")
    cells = tmp_path / "map" / "pointcloud_map.pcd"
    cells.mkdir(parents=True)
    for name in NAMES:
        (cells / name).symlink_to(tmp_path / "store" / name)
    (cells / "loop").symlink_to(cells)
    (tmp_path / "map" / "pointcloud_map_metadata.yaml").write_text(metadata_text())
    check(tmp_path / "map", cells)


def test_entries_without_a_file_and_files_without_an_entry(tmp_path: Path) -> None:
    root = autoware_map(tmp_path)
    (root / "pointcloud_map.pcd" / "t_20_0.pcd").unlink()
    (root / "pointcloud_map.pcd" / "stray.PCD").write_bytes(b"")
    (root / "pointcloud_map.pcd" / "notes.txt").write_bytes(b"")
    catalogue = open_map(root).load()
    assert [Path(catalogue.id(i)).name for i in range(len(catalogue))] == ["t_-20_40.pcd", "t_0_0.pcd"]
    lacking, stray = catalogue.problems
    assert lacking.endswith("entries whose file is missing, not served: t_20_0.pcd")
    assert stray.endswith("files without an entry, not served: stray.PCD")
    with pytest.raises(
        MapDataError, match=r"metadata\.yaml: these entries have no file in .*: t_20_0\.pcd"
    ) as caught:
        open_map(root, strict=True).load()
    assert caught.value.cause == "missing_files"


@pytest.mark.parametrize(
    ("names", "metadata", "why"),
    [
        (["other.pcd", "another.pcd"], metadata_text(), "have no file"),
        (NAMES, metadata_text([]), "lists no cells"),
        (NAMES, None, r"3 PCD files but no pointcloud_map_metadata\.yaml"),
    ],
)
def test_no_cell_to_serve(tmp_path: Path, names: Sequence[str], metadata: str | None, why: str) -> None:
    put_cells(tmp_path, names)
    if metadata is not None:
        (tmp_path / "pointcloud_map_metadata.yaml").write_text(metadata)
    with pytest.raises(MapDataError, match=why) as caught:
        open_map(tmp_path).load()
    assert caught.value.exit_code == 65
    assert metadata is not None or caught.value.cause == "no_metadata"


def test_nothing_there(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path, why in ((tmp_path / "gone", "no such file"), (tmp_path / "file" / "map", "not a directory")):
        with pytest.raises(MapMissing, match=f"{path}: {why}"):
            open_map(path)
    with pytest.raises(MapMissing, match="no metadata file"):
        open_map(tmp_path, metadata=tmp_path / "none.yaml")
    with pytest.raises(MapMissing, match="no PCD file"):
        open_map(tmp_path).load()
    assert MapMissing("x").exit_code == 66


def test_one_file_that_is_no_cloud_says_which_files_are_read(tmp_path: Path) -> None:
    for name, says in (("README.md", "files that end in .md are not read"), ("README", "without a suffix")):
        path = tmp_path / name
        path.write_text("# A map\n")
        with pytest.raises(MapDataError, match=says) as caught:
            open_map(path).load()
        assert caught.value.exit_code == 65
        assert caught.value.hint.startswith("readable are .pcd, .las, ")
    write_pcd(tmp_path / "map", dict.fromkeys("xyz", np.zeros(1, np.float32)))
    assert len(open_map(tmp_path / "map").load()) == 1, "a PCD file may be called anything"


def test_what_is_no_file_costs_its_own_cell_alone(tmp_path: Path) -> None:
    root = autoware_map(tmp_path)
    cells = root / "pointcloud_map.pcd"
    (cells / "t_0_0.pcd").unlink()
    os.mkfifo(cells / "t_0_0.pcd")
    (cells / "dangling.pcd").symlink_to(cells / "nowhere")
    (cells / "itself").symlink_to(cells / "itself")
    (cells / "0.pcd").symlink_to(cells / "0.pcd")
    (cells / "empty.pcd").mkdir()
    catalogue = open_map(root).load()
    assert len(catalogue) == 2
    text = "\n".join(catalogue.problems)
    assert f"no regular file: {cells / 't_0_0.pcd'}" in text
    assert f"cannot be read (No such file or directory): {cells / 'dangling.pcd'}" in text
    looping = f"{cells / '0.pcd'}, {cells / 'itself'}"
    assert f"cannot be read (Too many levels of symbolic links): {looping}" in text


def test_names_that_no_client_could_say(tmp_path: Path) -> None:
    """They are reported in readable form, and neither served nor looked into."""
    root = autoware_map(tmp_path)
    cells = os.fsencode(root / "pointcloud_map.pcd")
    Path(os.fsdecode(cells + b"/Stra\xdfe.pcd")).write_bytes(b"")
    os.mkdir(cells + b"/\xff")
    os.rename(cells + b"/t_0_0.pcd", cells + b"/\xff/t_0_0.pcd")
    Path(os.fsdecode(cells), "Stra\u00dfe.txt").write_bytes(b"")
    catalogue = open_map(root).load()
    assert len(catalogue) == 2
    odd, lacking = catalogue.problems
    assert odd == (
        f"the name is not UTF-8: {root}/pointcloud_map.pcd/Stra\\xdfe.pcd, {root}/pointcloud_map.pcd/\\xff"
    )
    assert lacking.endswith("entries whose file is missing, not served: t_0_0.pcd")


def test_path_that_no_client_could_name(tmp_path: Path) -> None:
    odd = os.fsencode(tmp_path) + b"/\xff"
    os.mkdir(odd)
    with pytest.raises(MapDataError, match="not UTF-8"):
        open_map(os.fsdecode(odd))


def make_single(path: Path) -> None:
    points = [[1.5, -2.0, 3.0], [-7.25, 9.0, 1.0], [np.nan, 1e9, 0.0], [0.0, 0.0, 50.0]]
    write_pcd(path, dict(zip("xyz", np.array(points, dtype=np.float32).T, strict=True)))


@pytest.mark.parametrize("name", ["city.pcd", "pointcloud_map.pcd", "CITY.PCD"])
def test_one_pcd_is_one_cell_with_the_bounds_of_its_points(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    make_single(file)
    (tmp_path / "lanelet2_map.osm").write_text("")
    for path in (file, tmp_path):
        for strict in (False, True):
            catalogue = open_map(path, strict=strict).load()
            assert len(catalogue) == 1
            assert catalogue.id(0) == str(file)
            assert catalogue.box(0) == (-7.25, -2.0, 1.5, 9.0)
            assert catalogue.stamp(0) == SourceStamp.of(file.stat()).token


@pytest.mark.parametrize("points", [0, 100_000_000])
def test_one_pcd_too_large_wants_dividing(tmp_path: Path, points: int) -> None:
    """Neither a large file nor one of very many points is read or decompressed."""
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    head += f"WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA binary_compressed\n"
    with open(tmp_path / "city.pcd", "wb") as out:
        if points:
            out.write(head.encode() + struct.pack("<II", 100 << 20, points * 12))
        out.truncate(101 << 20 if points else (256 << 20) + 1)
    with pytest.raises(MapDataError, match="1144 MiB of points" if points else "divide it") as caught:
        open_map(tmp_path / "city.pcd").load()
    assert (caught.value.cause, caught.value.exit_code) == ("needs_dividing", 65)


def test_one_pcd_without_points_or_sense(tmp_path: Path) -> None:
    file = tmp_path / "city.pcd"
    write_pcd(file, dict.fromkeys("xyz", np.full(2, np.nan, dtype=np.float32)))
    with pytest.raises(MapDataError, match="no finite point"):
        open_map(file).load()
    file.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(MapDataError) as caught:
        open_map(file).load()
    assert caught.value.cause == "lfs_pointer"


@contextlib.contextmanager
def only(count: int) -> Iterator[None]:
    """Limit how many more files this process can open."""
    free = [os.open("/", os.O_PATH) for _ in range(count + 1)]
    for fd in free:
        os.close(fd)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(free), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("kind", ["divided", "volume", "nested", "inside"])
def test_without_descriptors_a_map_is_whole_or_the_limit_is_named(tmp_path: Path, kind: str) -> None:
    """A directory that could not be opened would be cells that are gone, or a link that may be switched."""
    root = tmp_path / "map"
    if kind == "volume":
        autoware_map(root / "..2026")
        (root / "..data").symlink_to("..2026")
        for name in ("pointcloud_map.pcd", "pointcloud_map_metadata.yaml"):
            (root / name).symlink_to(f"..data/{name}")
    elif kind == "inside":
        root = autoware_map(root) / "pointcloud_map.pcd"
    else:
        autoware_map(root)
    if kind == "nested":
        cells = root / "pointcloud_map.pcd"
        (cells / "inner").mkdir()
        (cells / NAMES[0]).rename(cells / "inner" / NAMES[0])
    whole = open_map(root).load().map_version
    refused: list[str] = []
    versions: list[int] = []
    for count in range(12):
        with only(count):
            try:
                versions.append(open_map(root).load().map_version)
            except LimitReached as error:
                refused.append(error.hint)
    assert versions == [whole] * (12 - len(refused))
    assert len(refused) > 2
    assert all("LimitNOFILE=" in hint for hint in refused)


def test_a_map_both_whole_and_in_cells_names_the_cells(tmp_path: Path) -> None:
    for name, beside in (("pointcloud_map", True), ("cells of 20 m", True), ("pointcloud_map", False)):
        root = tmp_path / f"{name} {beside}"
        put_cells(root / name)
        lists = root if beside else root / name
        (lists / "pointcloud_map_metadata.yaml").write_text(metadata_text())
        write_pcd(root / "pointcloud_map.pcd", {axis: np.arange(3, dtype=np.float32) for axis in "xyz"})
        if beside:  # the list is not that of the one file
            with pytest.raises(MapDataError, match="have no file in") as refused:
                open_map(root).load()
            assert refused.value.hint == f"the map in cells seems to be {root / name}: name that"
        else:
            assert len(open_map(root).load()) == 1
        check(root / name, root / name)
        os.truncate(root / "pointcloud_map.pcd", 300 << 20)  # sparse
        with pytest.raises(MapDataError) as refused:
            open_map(root / "pointcloud_map.pcd").load()
        assert str(root / name) in refused.value.hint


@pytest.mark.parametrize(("listed", "stored"), [("NFC", "NFD"), ("NFD", "NFC"), ("NFC", "NFC")])
@pytest.mark.parametrize(
    "names", [("Straße_ö.pcd", "Zürich.pcd"), ("Zürich.pcd", "plain.pcd"), ("가.pcd", "ệ.pcd")]
)
def test_accents_are_equal_however_they_are_written(
    tmp_path: Path, names: tuple[str, str], listed: Literal["NFC", "NFD"], stored: Literal["NFC", "NFD"]
) -> None:
    written = [unicodedata.normalize(stored, name) for name in names]
    put_cells(tmp_path, written)
    lines = [f"{unicodedata.normalize(listed, name)}: [{20 * n}, 0]" for n, name in enumerate(names)]
    text = "x_resolution: 20\ny_resolution: 20\n" + "\n".join(lines)
    (tmp_path / "pointcloud_map_metadata.yaml").write_text(text, encoding="utf-8")
    catalogue = open_map(tmp_path).load()
    assert catalogue.problems == ()
    boxes = {catalogue.id(n): catalogue.box(n)[0] for n in range(len(catalogue))}
    assert boxes == {str(tmp_path / name): 20 * n for n, name in enumerate(written)}


@pytest.mark.parametrize("place", [".", ".."])
def test_a_list_under_another_name_is_named(tmp_path: Path, place: str) -> None:
    cells = tmp_path / "cells"
    put_cells(cells)
    lists = cells / place / "metadata.yaml"
    lists.write_text(metadata_text())
    with pytest.raises(MapDataError, match=r"3 PCD files but no pointcloud_map_metadata\.yaml") as refused:
        open_map(cells).load()
    assert f"--metadata FILE (is it {os.path.normpath(lists)}?)" in refused.value.hint
    assert len(open_map(cells, metadata=lists).load()) == 3


def test_cells_that_state_another_unit_are_reported(tmp_path: Path) -> None:
    header = (
        "# .PCD v0.7\n# units: mm\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        "WIDTH 1\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3\n"
    )
    root = autoware_map(tmp_path / "divided")
    for name in NAMES:
        (root / "pointcloud_map.pcd" / name).write_text(header)
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "a.pcd").write_text(header)
    for place in (root, alone):
        (problem,) = open_map(place).load().problems
        assert "not in metres: x, y and z are in millimetres" in problem


def test_a_whole_map_that_is_served_beside_cells_is_reported(tmp_path: Path) -> None:
    """The metadata lies within the cells' folder, where it is not found from the folder above."""
    make_single(tmp_path / "pointcloud_map.pcd")
    put_cells(tmp_path / "pointcloud_map")
    (tmp_path / "pointcloud_map" / "pointcloud_map_metadata.yaml").write_text(metadata_text())
    (problem,) = open_map(tmp_path).load().problems
    assert f"seems to be {tmp_path / 'pointcloud_map'}: name that" in problem
    assert open_map(tmp_path / "pointcloud_map.pcd").load().problems == ()
    assert len(open_map(tmp_path / "pointcloud_map").load()) == len(NAMES)


def test_two_lists_of_cells_that_differ_are_reported(tmp_path: Path) -> None:
    name = "pointcloud_map_metadata.yaml"
    beside, among = autoware_map(tmp_path) / name, tmp_path / "pointcloud_map.pcd" / name
    among.write_text(beside.read_text())
    assert not open_map(tmp_path).load().problems
    among.write_text(beside.read_text() + "# of another day\n")
    assert f"{beside} is read, not {among}" in " ".join(open_map(tmp_path).load().problems)
    assert not open_map(tmp_path, metadata=among).load().problems


def test_the_only_file_whose_name_is_no_utf_8_is_named(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    (tmp_path / os.fsdecode(b"cells/\xe4.pcd")).write_bytes(b"")
    with pytest.raises(MapMissing, match="the name is not UTF-8"):
        open_map(tmp_path / "cells").load()
