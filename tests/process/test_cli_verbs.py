# SPDX-License-Identifier: Apache-2.0
"""Every verb against a real daemon: its JSON to the field, its text, its exit code."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from shmmap.cli.entry import build_parser
from shmmap.cli.json_output import output_kinds
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import DividedMap, random_points, read_pcd
from tests.support.forked_programs import run_verb

HEX = re.compile(r"[0-9a-f]{16}")


@pytest.fixture
def shmmap(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> Shmmap:
    return Shmmap(daemon(divided_map.root), tmp_path)


def test_query_has_exactly_the_fields_of_the_contract(reading: Shmmap, standing_map: DividedMap) -> None:
    found = reading.json("query", "--circle", "-5,3,25")
    assert list(found) == ["epoch", "map_version", "frame_id", "cells", "removed", "pending", "failed"]
    assert HEX.fullmatch(found["epoch"])
    assert HEX.fullmatch(found["map_version"])
    assert (found["frame_id"], found["removed"], found["pending"], found["failed"]) == ("map", [], [], [])
    names = standing_map.in_circle(-5, 3, 25)
    assert [cell["id"] for cell in found["cells"]] == [standing_map.id(name) for name in names]
    for name, cell in zip(names, found["cells"], strict=True):
        assert sorted(cell) == sorted(
            ["id", "version", "layer", "segment", "offset", "bytes", "points", "stale", "box"]
        )
        assert HEX.fullmatch(cell["version"])
        assert (cell["layer"], cell["offset"], cell["stale"]) == ("points", 0, False)
        assert cell["box"] == list(standing_map.box(name))
        assert cell["points"] == len(standing_map.points(name)["x"])
        segment = Path(reading.daemon.shm_dir, cell["segment"].lstrip("/"))
        assert cell["bytes"] <= segment.stat().st_size


def test_areas_and_ids(reading: Shmmap, standing_map: DividedMap) -> None:
    def names(*words: str, code: int = 0) -> list[str]:
        return [Path(cell["id"]).name for cell in reading.json("query", *words, code=code)["cells"]]

    assert names("--circle=-5,3,25") == standing_map.in_circle(-5, 3, 25)
    assert names("--square", "-5,3,25") == standing_map.in_square(-5, 3, 25)
    assert names("--box", "-1,-1,1,1") == ["-20_-20.pcd", "-20_0.pcd", "0_-20.pcd", "0_0.pcd"]
    assert names("--box", "-1,-1,1,1", "--z", "100,200", code=1) == []
    assert names("--id", "0_0.pcd", standing_map.id("20_0.pcd"), "0_0.pcd") == [
        "0_0.pcd",
        "20_0.pcd",
        "0_0.pcd",
    ]
    assert names("--id", "nowhere.pcd", "0_0.pcd", code=1) == ["0_0.pcd"]


def test_query_differential(reading: Shmmap, standing_map: DividedMap) -> None:
    first = reading.json("query", "--circle", "0,0,5")["cells"]
    held = [f"{cell['id']}@{cell['version']}" for cell in first]
    moved = reading.json("query", "--circle", "20,0,5", "--held", *held, "/unknown/cell.pcd")
    before, after = standing_map.in_circle(0, 0, 5), standing_map.in_circle(20, 0, 5)
    assert [Path(cell["id"]).name for cell in moved["cells"]] == [n for n in after if n not in before]
    gone = [cell["id"] for cell in first if Path(cell["id"]).name not in after]
    assert moved["removed"] == [*gone, "/unknown/cell.pcd"]
    # another version is not the one held; no version means the current one
    other = f"{int(first[0]['version'], 16) ^ 1:x}"
    again = reading.json("query", "--circle", "0,0,5", "--held", f"{first[0]['id']}@{other}", *held[1:])
    assert [cell["id"] for cell in again["cells"]] == [first[0]["id"]]
    names = [cell["id"] for cell in first]
    assert reading.json("query", "--circle", "0,0,5", "--held", *names)["cells"] == []


def test_query_names_what_failed(shmmap: Shmmap, divided_map: DividedMap) -> None:
    (divided_map.pcd_dir / "0_0.pcd").write_bytes(b"not a point cloud")
    found = shmmap.json("query", "--id", "0_0.pcd", "20_0.pcd", code=1)
    assert [Path(cell["id"]).name for cell in found["cells"]] == ["20_0.pcd"]
    (failed,) = found["failed"]
    assert sorted(failed) == ["code", "holders", "id", "layer", "message"]
    assert (failed["id"], failed["code"]) == (divided_map.id("0_0.pcd"), "load_failed")
    text = shmmap("query", "--id", "0_0.pcd", code=1)
    assert "load_failed" in text


def test_what_is_printed_is_as_the_schemas_say(shmmap: Shmmap) -> None:
    """Nothing more, and nothing less."""
    shmmap("query", "--wait", "60", "--circle", "0,0,5", "--layer", "points", "voxel(2)")
    for words in (
        "status", "top", "health", "ls", "clients", "version", "doctor", "pin 0_0.pcd", "unpin --all",
        "reload", "show 0_0.pcd", "query --circle 0,0,5", "query --id 0_0.pcd nowhere.pcd", "evict --all",
        "live ls", f"inspect {shmmap.daemon.map_path}", "config show", "stop",
    ):  # fmt: skip
        args = build_parser().parse_args(words.split())
        document = json.loads(shmmap.run(*words.split(), "--json").stdout)
        outcomes = []
        for kind in output_kinds(args.json_output):
            with contextlib.suppress(msgspec.ValidationError):
                outcomes.append(msgspec.to_builtins(msgspec.convert(document, kind)))
        assert [json.loads(json.dumps(one)) for one in outcomes] == [document], words


@pytest.mark.slow
def test_verbs_that_look_while_the_daemon_is_stopped(shmmap: Shmmap, divided_map: DividedMap) -> None:
    shmmap("query", "--circle", "0,0,5")
    pid = shmmap.daemon.pid
    os.kill(pid, signal.SIGSTOP)
    try:
        os.waitpid(pid, os.WUNTRACED)
        status = shmmap.json("status")
        assert (status["state"], status["pid"], status["instance"]) == (
            "stopped",
            pid,
            shmmap.daemon.instance,
        )
        assert status["endpoint"] == shmmap.daemon.endpoint
        assert status["counters"]["map_cells"] == 36
        assert shmmap.json("health", code=1)["state"] == "stopped"
        assert "PAUSED" in shmmap("top")
        for verb in ("ls", "map"):
            done = shmmap.run(verb)
            assert (done.returncode, done.stdout) == (69, "")
            assert "the daemon does not answer. PAUSED" in done.stderr
            assert f"kill -CONT {pid}" in done.stderr
        assert f'shmmap_up{{daemon="{shmmap.daemon.instance}"}} 0' in shmmap("metrics")
        done = shmmap.run("clients")
        assert done.returncode == 69
        assert "hint: " in done.stderr
    finally:
        os.kill(pid, signal.SIGCONT)
    waiting = Deadline()
    while waiting(json.loads(shmmap.run("health", "--json").stdout)["state"] != "healthy"):
        pass
    assert "0_0.pcd" in shmmap("ls")


def test_verbs_of_a_dead_daemon(shmmap: Shmmap) -> None:
    shmmap.daemon.kill()
    assert shmmap.json("health", code=69)["state"] == "dead"
    assert shmmap.json("status", code=69)["state"] == "dead"
    for words in (["top"], ["ls"], ["map"], ["metrics"], ["tail"], ["query", "--circle", "0,0,5"]):
        shmmap(*words, code=69)


def test_ls_lists_what_is_resident(shmmap: Shmmap, divided_map: DividedMap) -> None:
    handles = {cell["id"]: cell for cell in shmmap.json("query", "--circle", "0,0,25")["cells"]}
    listed = {cell["id"]: cell for cell in shmmap.json("ls")["cells"]}
    assert set(listed) == set(handles)
    for cell_id, row in listed.items():
        for name in ("version", "layer", "segment", "points", "box"):
            assert row[name] == handles[cell_id][name]
        assert row["state"] == "resident"
        blocks = Path(shmmap.daemon.shm_dir, row["segment"].lstrip("/")).stat().st_blocks
        assert row["bytes"] == blocks * 512


def test_show_and_clients(shmmap: Shmmap, divided_map: DividedMap) -> None:
    before = shmmap.json("show", "0_0.pcd")
    assert (before["id"], before["segments"], before["z"]) == (divided_map.id("0_0.pcd"), [], None)
    (cell,) = shmmap.json("query", "--id", "0_0.pcd")["cells"]
    shown = shmmap.json("show", "0_0.pcd")
    (segment,) = shown["segments"]
    assert segment["segment"] == cell["segment"]
    assert (segment["state"], segment["points"], segment["holders"]) == ("resident", 500, [])
    z = divided_map.points("0_0.pcd")["z"]
    assert shown["z"] == [float(z.min()), float(z.max())]
    assert shmmap.run("show", "nowhere.pcd").returncode == 1
    found = shmmap.json("clients")
    me = [row for row in found["clients"] if row["client"] == "shmmap"]
    assert [row["uid"] for row in me] == [os.getuid()]
    assert (found["unknown_holders"], found["unknown_bytes"]) == (0, 0)


def test_reload_and_evict(shmmap: Shmmap, divided_map: DividedMap) -> None:
    first = shmmap.json("query", "--id", "0_0.pcd", "20_0.pcd")
    rng = np.random.default_rng(7)
    divided_map.write_cell("0_0.pcd", (0, 0), random_points(rng, (0, 0), 77))
    divided_map.write_cell("200_0.pcd", (200, 0), random_points(rng, (200, 0), 5))
    divided_map.remove_cell("40_40.pcd")
    divided_map.write_metadata()
    answer = shmmap.json("reload")
    assert (answer["changed"], answer["added"], answer["removed"]) == (1, 1, 1)
    second = shmmap.json("query", "--id", "0_0.pcd", "20_0.pcd")
    assert second["map_version"] == answer["map_version"] != first["map_version"]
    assert [cell["points"] for cell in second["cells"]] == [77, 500]
    assert second["cells"][0]["version"] != first["cells"][0]["version"]
    assert second["cells"][1] == first["cells"][1]
    assert shmmap.json("evict", "20_0.pcd", "nowhere.pcd", code=1)["unknown"] == ["nowhere.pcd"]
    assert not Path(shmmap.daemon.shm_dir, first["cells"][1]["segment"].lstrip("/")).exists()
    assert shmmap.run("evict").returncode == 2
    shmmap("pin", "20_0.pcd")
    shmmap("query", "--id", "20_0.pcd")  # it is in memory from now on
    assert shmmap("evict", "20_0.pcd").splitlines() == [
        "0 segments freed",
        "1 segment kept, pinned by an operator (see `shmmap unpin`):",
        "  20_0.pcd: points",
    ]
    waiting = Deadline()
    while waiting(re.search(r'cells evicted count=1 bytes=\d+ of="1 request"', shmmap.daemon.log) is None):
        pass
    shmmap("unpin", "--all")
    assert shmmap.json("evict", "--all")["still_mapped"] == 0


def test_export_merged_pcd(reading: Shmmap, standing_map: DividedMap) -> None:
    names = standing_map.in_circle(0, 0, 5)
    for encoding in ("ascii", "binary", "binary_compressed"):
        path = f"{encoding}.pcd"
        exported = reading.json("export", "--circle", "0,0,5", "-o", path, "--encoding", encoding)
        (file,) = exported["files"]
        assert (file["path"], file["points"]) == (path, 500 * len(names))
        described = reading.json("inspect", path)
        assert (described["encoding"], described["points"], described["dropped"]) == (encoding, 2000, 0)
    merged = read_pcd(reading.cwd / "binary.pcd")  # what the oracle reads
    for field in ("x", "y", "z", "intensity"):
        wanted = np.concatenate([standing_map.points(name)[field] for name in names])
        assert merged[field].tobytes() == wanted.tobytes()


def test_export_npz_and_single_cells(reading: Shmmap, standing_map: DividedMap) -> None:
    reading("export", "--id", "0_0.pcd", "-o", "cell.npz")
    with np.load(reading.cwd / "cell.npz") as archive:
        source = standing_map.points("0_0.pcd")
        assert sorted(archive.files) == ["intensity", "xyz"]
        assert archive["xyz"].tobytes() == np.column_stack([source[axis] for axis in "xyz"]).tobytes()
    reading("export", "--id", "0_0.pcd", "20_0.pcd", "--output-dir", "cells")
    assert sorted(path.name for path in (reading.cwd / "cells").iterdir()) == ["0_0.pcd", "20_0.pcd"]
    copy, original = read_pcd(reading.cwd / "cells" / "20_0.pcd"), standing_map.points("20_0.pcd")
    assert all(copy[name].tobytes() == original[name].tobytes() for name in original)


def test_export_a_layer_and_ply(reading: Shmmap, standing_map: DividedMap) -> None:
    source = standing_map.points("0_0.pcd")
    low = source["z"] <= 4.0
    reading("export", "--id", "0_0.pcd", "--layer", "crop(z_max=4.0)", "-o", "low.ply")
    described = reading.json("inspect", "low.ply")
    assert (described["points"], described["dropped"]) == (np.count_nonzero(low), 0)
    head, _, body = (reading.cwd / "low.ply").read_bytes().partition(b"end_header\n")
    assert b"property float intensity\n" in head
    rows = np.frombuffer(body, "<f4").reshape(-1, 4)
    assert np.array_equal(rows, np.column_stack([source[name][low] for name in ("x", "y", "z", "intensity")]))
    (file,) = reading.json("export", "--id", "0_0.pcd", "--layer", "voxel(leaf=2.0)", "-o", "leaf.npz")[
        "files"
    ]
    with np.load(reading.cwd / "leaf.npz") as archive:
        assert sorted(archive.files) == ["count", "intensity", "xyz"]
        assert (len(archive["count"]), archive["count"].sum()) == (file["points"], 500)


def test_a_layer_without_points_goes_into_one_npz_per_cell(reading: Shmmap) -> None:
    ndt = ("--id", "0_0.pcd", "--layer", "ndt(leaf=4.0)")
    done = reading.run("export", *ndt, "-o", "ndt.pcd")
    assert done.returncode == 2
    assert "ndt(leaf=4.0) is no table of points" in done.stderr
    assert "--output-dir DIR --format npz" in done.stderr
    reading("export", *ndt, "--output-dir", "ndt", "--format", "npz")
    with np.load(reading.cwd / "ndt" / "0_0.npz") as archive:
        assert {"mean", "inverse_covariance"} <= set(archive.files)


@pytest.mark.slow
def test_export_never_overwrites_unasked_and_writes_all_or_nothing(
    shmmap: Shmmap, divided_map: DividedMap
) -> None:
    target = shmmap.cwd / "out.pcd"
    target.write_bytes(b"precious")
    done = shmmap.run("export", "--id", "0_0.pcd", "-o", "out.pcd")
    assert done.returncode == 2
    assert "--force" in done.stderr
    assert target.read_bytes() == b"precious"
    shmmap("export", "--id", "nowhere.pcd", "0_0.pcd", "-o", "other.pcd", code=1)
    shmmap("export", "--circle", "9000,0,5", "-o", "other.pcd", code=1)
    shmmap("export", "--circle", "9000,0,5", "-o", "other.pcd", "--allow-empty")
    shmmap("export", "--id", "0_0.pcd", "-o", "other.xyz", code=2)
    shmmap("export", "--id", "0_0.pcd", "-o", "", "--format", "pcd", code=2)
    shmmap("export", "--id", "0_0.pcd", "-o", "out.pcd/beneath.pcd", code=73)
    (divided_map.pcd_dir / "20_0.pcd").write_bytes(b"broken")
    shmmap("export", "--id", "0_0.pcd", "20_0.pcd", "--output-dir", ".", code=1)
    assert sorted(path.name for path in shmmap.cwd.iterdir()) == ["map", "out.pcd"]
    shmmap("export", "--id", "0_0.pcd", "-o", "out.pcd", "--force")
    assert len(read_pcd(target)["x"]) == 500


@pytest.mark.slow
def test_who_misspells_a_cell_is_exported_which_there_are(reading: Shmmap) -> None:
    for words in (["show"], ["query", "--id"], ["pin"], ["unpin"], ["evict"]):
        done = reading.run(*words, "/elsewhere/20_0.pdc")
        assert done.returncode == 1, words
        assert re.search(r"hint: did you mean -?20_0\.pcd\?\n$", done.stderr), done.stderr
        done = reading.run(*words, "nothing like it")
        assert done.returncode == 1, words
        assert "hint: `shmmap query --circle X,Y,R` prints the ids" in done.stderr


def test_endpoint_alone_is_enough(reading: Shmmap) -> None:
    reading.environment.pop("SHMMAP_INSTANCE")
    reading.environment.pop("SHMMAP_RUNTIME_DIR")
    for endpoint in (reading.daemon.endpoint, f"ipc://{reading.daemon.endpoint}"):
        assert reading.json("query", "--circle", "0,0,5", "--endpoint", endpoint)["cells"]
        assert reading.json("health", "--endpoint", endpoint)["state"] == "healthy"
    done = reading.run("query", "--circle", "0,0,5", "--endpoint", "tcp://127.0.0.1:1")
    assert done.returncode == 2


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["serve", "/nowhere/at/all"], 66),
        (["serve", ".", "--budget", "much"], 78),
        (["serve", ".", "--eviction", "lru"], 78),
        (["serve", ".", "--instance", "a/b"], 78),
        (["serve", ".", "--config", "missing.toml"], 78),
        (["serve"], 78),
        (["doctor", "--config", "missing.toml"], 78),
        (["inspect", "missing.pcd"], 66),
        (["inspect", "missing"], 66),
        (["inspect", "broken.pcd"], 65),
        (["inspect", "empty"], 66),
        (["prepare", "missing", "--layer", "ndt"], 66),
        (["prepare", "broken.pcd", "--layer", "ndt"], 2),
    ],
)
def test_exit_codes_without_a_daemon(words: list[str], code: int, tmp_path: Path, short_path: Path) -> None:
    (tmp_path / "broken.pcd").write_bytes(b"\0" * 100)
    (tmp_path / "empty").mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")} | {
        "PYTHONPATH": str(ROOT),
        "XDG_RUNTIME_DIR": str(short_path),
        "SHMMAP_SHM_DIR": "/dev/shm",
        "SHMMAP_INSTANCE": f"test-{os.getpid()}-unused",
    }
    done = run_verb(words, environment, tmp_path)
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert any(line.startswith("shmmap: ") for line in done.stderr.splitlines())


def test_help_status_and_errors_need_only_the_standard_library(reading: Shmmap) -> None:
    """A client-only install has no yaml or Open3D, and a broken one perhaps not even numpy."""
    program = (
        "import sys\n"
        "names = ['numpy', 'zmq', 'posix_ipc', 'yaml', 'xxhash', 'lzf', 'open3d']\n"
        "for name in [*names, 'msgspec']:\n"
        "    sys.modules[name] = None\n"
        "from shmmap.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    for words, code in (
        (["status"], 0),
        (["health"], 0),
        (["health", "--instance", "other"], 69),
    ):
        done = subprocess.run(
            [sys.executable, "-c", program, *words],
            env=reading.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code, done.stderr
