# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt align`` and ``warmup`` as a user runs them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import TrustLimits
from shmmap_clients.ndt_scan_matcher.cli import main
from shmmap_clients.ndt_scan_matcher.matching.settings import Limits

from tests.clients.ndt_scan_matcher.scene import TRUTH, scan_from, street

GUESS = "1.5,0.3,1.9,0.02,-0.03,0.42"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("clouds")
    scan = scan_from(street(7), TRUTH, 1200).astype(np.float32)
    np.savez(folder / "map.npz", xyz=street())
    np.savez(folder / "scan.npz", xyz=scan)
    np.savez(folder / "scan_4mm.npz", xyz_4mm=np.round(scan / 0.004).astype(np.int16))
    np.hstack([scan, np.ones((len(scan), 1), np.float32)]).tofile(folder / "scan.bin")
    return {path.name: path for path in folder.iterdir()}


@pytest.mark.parametrize("scan", ["scan.npz", "scan_4mm.npz", "scan.bin"])
def test_align_prints_json(files: dict[str, Path], scan: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["align", "--map", str(files["map.npz"]), "--scan", str(files[scan]), "--guess", GUESS]
    assert main([*words, "--fine", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    T = np.array(document["T_map_base"])
    np.testing.assert_allclose(T[:3, 3], TRUTH[:3], atol=0.03)
    assert document["converged"] is True
    assert document["iterations"] >= 1
    assert document["nvtl"] > 2.3
    assert document["transform_probability"] > 3.0
    nothing = {"points": 0, "neighbor_points": 0, "neighbors": 0, "voxels": 0, "map_bytes": 0}
    assert document["cut"] == {**nothing, "deadline": False}
    assert np.array(document["covariance"]).shape == (6, 6)


def test_align_prints_text(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    code = main(
        [
            "align",
            "--map",
            str(files["map.npz"]),
            "--scan",
            str(files["scan.npz"]),
            "--guess",
            GUESS,
            "--leaf",
            "2",
            "--epsilon",
            "0.05",
            "--max-iterations",
            "20",
            "--step-size",
            "0.2",
            "--variant",
            "pclomp",
            "--neighbors",
            "direct7",
            "--line-search",
            "--max-points",
            "700",
            "--backend",
            "numpy",
        ]
    )
    out = capsys.readouterr().out
    assert code == 0
    assert "T_map_base" in out
    assert "points 500" in out  # left out by the cap
    assert "worst case for the largest scan allowed: " in out
    assert "(700 points x " in out
    found = re.search(r"^pose +(\S+)$", out, re.MULTILINE)
    assert found is not None
    again = main(
        ["align", "--map", str(files["map.npz"]), "--scan", str(files["scan.npz"]), "--guess", found[1]]
    )
    assert again == 0, "what is printed is what options take"
    assert "trusted                 yes" in out


@pytest.mark.parametrize(
    ("rows", "failed"),
    [
        (slice(0, 1), {"points", "angle", "spread"}),
        (slice(0, 40), {"points"}),
        ("near", {"distance"}),
    ],
)
def test_a_pose_that_rests_on_little_is_not_trusted(
    files: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    rows: slice | str,
    failed: set[str],
) -> None:
    scan = np.load(files["scan.npz"])["xyz"]
    chosen = scan[np.linalg.norm(scan, axis=1) < 6.0] if isinstance(rows, str) else scan[rows]
    np.savez(tmp_path / "part.npz", xyz=chosen)
    words = ["align", "--map", str(files["map.npz"]), "--scan", str(tmp_path / "part.npz"), "--guess", GUESS]
    main([*words, "--steady", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert not document["trustworthy"]
    assert failed <= set(document["failed_limits"])
    assert set(document["evidence"]) == {"points", "distance", "angle", "sharpness", "spread"}
    assert document["evidence"]["points"] <= len(chosen)
    main([*words, "--steady"])
    assert re.search(
        r"^trusted +no: .*fewer than (80 points matched|20 points beyond 10 m)", capsys.readouterr().out, re.M
    )
    lifted = [f"--trust-{name}=0" for name in ("points", "distance", "angle", "sharpness", "spread", "nvtl")]
    main([*words, "--steady", *lifted, "--json"])
    assert set(json.loads(capsys.readouterr().out)["failed_limits"]) <= {"converged"}


def test_the_help_has_the_limits_that_hold(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["align", "--help"])
    said = dict(re.findall(r"--((?:max|trust)-\w+) \w+\s[^(]*\(default:\s+([\d.]+)", capsys.readouterr().out))
    limits, trust = Limits(), TrustLimits().for_leaf(2.0)
    for name in ("points", "distance", "angle", "sharpness", "spread", "oscillations"):
        assert float(said[f"trust-{name}"]) == getattr(trust, name)
    most = {"points": limits.source_points, "neighbors": limits.neighbors, "voxels": limits.voxels}
    assert {name: int(said[f"max-{name}"]) for name in most} == most


def test_align_far_from_the_map_is_a_negative_answer(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["align", "--map", str(files["map.npz"]), "--scan", str(files["scan.npz"]), "--json"]
    assert main([*words, "--guess", "-9000,0,0,0,0,0"]) == 1
    assert json.loads(capsys.readouterr().out)["converged"] is False


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (["--scan", "missing.pcd"], 66),
        (["--scan", __file__], 65),
        (["--guess", "1,2,3"], 2),
        (["--guess", "1,2,3,0,0,0,1"], 2),
        (["--guess", "1,2,3,0,0,0,0", "--pose-format", "tum"], 2),
        (["--backend", "fortran"], 2),
    ],
)
def test_errors_have_the_exit_codes_of_shmmap(files: dict[str, Path], change: list[str], code: int) -> None:
    words = ["align", "--map", str(files["map.npz"]), "--scan", str(files["scan.npz"]), *change]
    assert main(words) == code


def test_wrong_words_are_usage_errors(files: dict[str, Path]) -> None:
    files_ = ["align", "--map", "a", "--scan", "b"]
    for words in ([], ["align"], [*files_, "--guess", "1,2"], [*files_, "--leaf", "0"]):
        with pytest.raises(SystemExit) as exit_:
            main(words)
        assert exit_.value.code == 2


@pytest.mark.slow
def test_warmup_compiles_once(tmp_path: Path) -> None:
    program = [sys.executable, "-m", "shmmap_clients.ndt_scan_matcher", "warmup"]
    environment = {"PATH": "/usr/bin", "NUMBA_CACHE_DIR": str(tmp_path), "HOME": str(tmp_path)}
    for expected in ("compiled", "loaded from the cache"):
        done = subprocess.run(program, capture_output=True, text=True, env=environment, check=True)
        assert expected in done.stdout
