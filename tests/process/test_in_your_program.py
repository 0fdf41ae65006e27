# SPDX-License-Identifier: Apache-2.0
"""The page "In your program": its lines run as they stand, or are those of an example; the notebook."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.pages import read_page
from tests.support.skips import open3d_or_skip

PAGE = read_page("clients/IN_YOUR_PROGRAM.md")
EXAMPLES = ROOT / "clients/examples"
PRINTED = {  # what each block prints
    "cells": "",
    "numpy": r"(\S+\.pcd float32 \(500, 3\) m\n)+",
    "window": r"\d+ cells, \d+ points within 20 m\n",
    "matplotlib": "",
    "tables": "",
    "numba": r"\d+ points above 2 m\n",
    "ray": r"\d+ points\n",
    "dask": r"\d+ points\n",
}
QUOTED = ("many_processes", "torch_loader", "asyncio_follow")
NEEDED = {"matplotlib": "matplotlib", "tables": "pandas polars pyarrow", "ray": "ray", "dask": "distributed"}


def run(program: list[str], one: DaemonProcess, folder: Path) -> str:
    """Run lines of the page around a place of the test's map; returns what they print."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
    environment |= {"SHMMAP_ENDPOINT": one.endpoint, "SHMMAP_SHM_DIR": one.shm_dir, "MPLBACKEND": "Agg"}
    file = folder / "program.py"
    file.write_text("\n".join(["x, y = 5.0, 5.0", *program]) + "\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, file],
        capture_output=True,
        text=True,
        timeout=120.0,
        env={**environment, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_page_is_short() -> None:
    assert len(PAGE.text.split()) < 1000


@pytest.mark.parametrize("name", QUOTED)
def test_what_is_quoted_is_the_file(name: str) -> None:
    program = textwrap.dedent((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))
    quoted = "\n".join(PAGE.blocks[name])
    lines = program.splitlines()
    starts = [n for n, line in enumerate(lines) if line.strip() == PAGE.blocks[name][0]]
    found = ["\n".join(lines[n : n + len(PAGE.blocks[name])]) for n in starts]
    assert quoted in map(textwrap.dedent, found), name


@pytest.mark.parametrize("name", PRINTED)
def test_lines_for_a_library(standing: DaemonProcess, tmp_path: Path, name: str) -> None:
    for package in NEEDED.get(name, "").split():
        pytest.importorskip(package, reason=f"{package} is not installed")
    printed = run([*PAGE.blocks["cells"], *PAGE.blocks[name]], standing, tmp_path)
    assert re.fullmatch(PRINTED[name], printed), printed


def test_clouds_for_the_window_of_open3d(standing: DaemonProcess, tmp_path: Path) -> None:
    """Everything but the window itself, which needs a display."""
    open3d_or_skip()
    *clouds, window = PAGE.blocks["open3d"]
    assert window == "o3d.visualization.draw_geometries(clouds)"
    check = [
        "low = min(cloud.get_min_bound()[0] for cloud in clouds)",
        "print(type(clouds[0]).__module__, low)",
    ]
    where, low = run([*PAGE.blocks["cells"], *clouds, *check], standing, tmp_path).split()
    assert where.startswith("open3d.")
    assert not where.endswith(".t.geometry")
    assert -50.0 < float(low) < 0.0


def test_the_packages_of_the_system_for_open3d_are_those_of_the_page_of_installs() -> None:
    (line,) = re.findall(r"`(sudo apt-get install libegl1[^`]*)`", PAGE.text)
    assert line in read_page("shmmap/INSTALL.md").text


def test_an_explicit_signature_of_numba_refuses_shared_memory(standing: DaemonProcess) -> None:
    """As the page says; without a signature one compilation serves all cells."""
    numba = pytest.importorskip("numba", reason="numba is not installed")

    def first(xyz: Any) -> Any:
        return xyz[0, 0]

    with shmmap.connect(standing.endpoint) as client:
        cells = client.around(5.0, 5.0, 30.0, wait=60.0)
    explicit, lazy = numba.njit("float32(float32[:, ::1])")(first), numba.njit(first)
    with pytest.raises(TypeError, match="No matching definition"):
        explicit(cells[0].xyz)
    assert [lazy(cell.xyz) for cell in cells] == [cell.xyz[0, 0] for cell in cells]
    assert len(lazy.signatures) == 1


# --- an own Autoware map to a window -----------------------------------------------------------------------


def test_an_autoware_map_to_a_window_in_one_command_and_the_page_s_lines(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """The command is the one of Autoware's page; cells and metadata are as Autoware has them."""
    (serve,) = read_page("shmmap/origin/AUTOWARE_MAP.md").commands("serve")
    assert re.fullmatch(r"shmmap serve \S+", serve)
    one = daemon(divided_map.root)
    printed = run(["import shmmap", *PAGE.blocks["window"]], one, tmp_path)
    assert re.fullmatch(r"[1-9]\d* cells, [1-9]\d* points within 20 m\n", printed), printed


# --- the notebook -------------------------------------------------------------------------------------------


class Shown:
    """What the cells of a notebook show, in order: HTML where a value has it, else its text."""

    def __init__(self, path: Path) -> None:
        self.document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        self.outputs: list[str] = []

    @property
    def programs(self) -> list[str]:
        return ["".join(cell["source"]) for cell in self.document["cells"] if cell["cell_type"] == "code"]

    def run(self) -> None:
        """Run the cells one after the other as a notebook does: the value of a last expression is shown."""
        names: dict[str, Any] = {"__name__": "__main__"}
        for program in self.programs:
            tree = ast.parse(program)
            last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
            exec(compile(tree, "<notebook>", "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), "<notebook>", "eval"), names)
                html = getattr(value, "_repr_html_", lambda: None)()
                self.outputs.append(html or repr(value))
        names["client"].close()


def test_the_notebook(
    standing: DaemonProcess, standing_map: DividedMap, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    path = EXAMPLES / "first_look.ipynb"
    assert path.stat().st_size < 20_000
    shown = Shown(path)
    assert (shown.document["nbformat"], shown.document["nbformat_minor"]) == (4, 5)
    code = [cell for cell in shown.document["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert len({cell["id"] for cell in shown.document["cells"]}) == len(shown.document["cells"])
    monkeypatch.setenv("SHMMAP_ENDPOINT", standing.endpoint)
    monkeypatch.setenv("SHMMAP_SHM_DIR", standing.shm_dir)
    shown.run()
    client, cells, cell, ground, columns, *_ = shown.outputs
    assert str(standing_map.root) in client
    assert "<img" not in client
    for picture in (cells, cell, ground):
        assert picture.count("data:image/png;base64,") == 1
    assert "'min'" in columns
    assert "points" in capsys.readouterr().out


def test_a_notebook_goes_on_without_a_daemon(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """Nothing is asked, and nothing is waited for: what was shown is shown again, after a kill -9, too."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        cells = client.around(5.0, 5.0, 30.0, wait=60.0)
        before, requests = cells._repr_html_(), client.stats().counters["requests"]
        assert "connected" in (client._repr_html_() or "")
        assert cells[0]._repr_html_()
        assert client.stats().counters["requests"] == requests + 1, "the statistics alone"
        one.kill()
        assert cells._repr_html_() == before
        assert cells[0]._repr_html_()
        assert "<table>" in (client._repr_html_() or "")
    assert "<table>" in (client._repr_html_() or ""), "closed"


def test_a_notebook_whose_package_is_replaced_shows_text(standing: DaemonProcess, tmp_path: Path) -> None:
    package = tmp_path / "shmmap"
    shutil.copytree(Path(shmmap.__file__).parent, package)
    program = f"""
import os, shmmap
with shmmap.connect({standing.endpoint!r}, shm_dir={standing.shm_dir!r}) as client:
    cells = client.around(5, 5, 2, wait=60)
    os.rename({str(package)!r}, {str(tmp_path / "old")!r})
    print(cells._repr_html_(), cells[0]._repr_html_(), client._repr_html_(), cells)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.startswith("None None None <CellSet of 1 cells"), done.stderr
