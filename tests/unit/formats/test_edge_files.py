# SPDX-License-Identifier: Apache-2.0
"""The collection of corner-case files, each with its stated outcome."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_pcd
from shmmap.formats.source_file import CAUSES

WORDS = {
    "13_duplicate_field_names": "intensity",
    "34_wh_ne_points_less": "WIDTH",
    "59_lowercase_keys": "lower case",
    "61_utf8_bom": "byte order mark",
    "74_ascii_blank_lines_comments": "comment",
    "79_viewpoint_nonidentity": "VIEWPOINT",
}
NAMED = {
    "41_truncated_binary": "truncated",
    "43_lzf_compsize_too_big": "truncated",
    "44_lzf_uncomp_huge": "bad_lzf",
    "56_empty_file": "empty_file",
    "58_data_unknown": "unknown_encoding",
    "62_no_z": "no_xyz",
    "71_ascii_fewer_rows": "truncated",
    "76_ascii_garbage_token": "bad_row",
    "83_git_lfs_pointer": "lfs_pointer",
    "86_nested_text_file": "not_pcd",
    "87_all_zero_4k": "zero_filled",
    "93_compressed_stored_raw": "bad_lzf",
}


def test_every_file_has_its_outcome(data_dir: Path) -> None:
    folder = data_dir / "pcd_edge"
    expected = json.loads((folder / "expected.json").read_text())
    assert len(expected) == len(list(folder.glob("*.pcd"))) == 65
    for name, outcome in expected.items():
        path = folder / f"{name}.pcd"
        if outcome["expect"] == "error":
            with pytest.raises(MapDataError) as caught:
                read_pcd(path)
            assert caught.value.cause == NAMED.get(name, caught.value.cause)
            assert caught.value.cause in CAUSES
            assert caught.value.path == str(path)
            assert caught.value.offset is not None
            continue
        cloud = read_pcd(path, keep_non_finite=True)
        assert (cloud.points, len(cloud.xyz)) == (outcome["points"],) * 2, name
        warnings = [one for one in cloud.warnings if "so far from zero" not in one]  # any bits may be a float
        assert bool(warnings) == (outcome["expect"] == "warn"), name
        if name in WORDS:
            assert WORDS[name] in " ".join(cloud.warnings)
        assert describe(path).points == outcome["points"]


def test_bad_files_need_no_memory(data_dir: Path) -> None:
    """All refusals in one process whose address space may grow by 100 MB at most."""
    program = """
import json, resource, sys
from pathlib import Path
from shmmap.errors import MapDataError
from shmmap.formats.cloud import read_pcd
folder = Path(sys.argv[1])
expected = json.loads((folder / "expected.json").read_text())
read_pcd(folder / "01_base_binary.pcd")
read_pcd(folder / "98_lzf_backref_valid.pcd")
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + (100 << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
refused = 0
for name, outcome in expected.items():
    if outcome["expect"] == "error":
        try:
            read_pcd(folder / f"{name}.pcd")
        except MapDataError:
            refused += 1
print(refused, sum(outcome["expect"] == "error" for outcome in expected.values()))
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(data_dir / "pcd_edge")],
        capture_output=True,
        text=True,
        check=True,
    )
    refused, bad = done.stdout.split()
    assert refused == bad != "0"


def test_the_real_map_equals_an_independent_read(data_dir: Path) -> None:
    path = data_dir / "kitti0005_map" / "map_static_v010.pcd"
    data = path.read_bytes()
    start = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    records = np.frombuffer(data, "<f4", offset=start).reshape(-1, 4)
    cloud = read_pcd(path)
    assert np.array_equal(cloud.xyz, records[:, :3])
    assert np.array_equal(cloud.columns["intensity"], records[:, 3])
    assert np.array_equal(cloud.bounds[0], records[:, :3].min(axis=0))
    assert np.array_equal(cloud.bounds[1], records[:, :3].max(axis=0))
