# SPDX-License-Identifier: Apache-2.0
"""The wheel's description: with one setting, its links lead to the repository."""

from __future__ import annotations

import email.parser
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from shmmap.testing.daemon_process import without_settings
from tests.process.distributions import LINK, description_faults, tree
from tests.support.daemon_process import ROOT

URL = "https://host.test/me/shmmap"


@pytest.mark.parametrize("url", ["", URL])
def test_links_of_the_description(url: str, tmp_path: Path) -> None:
    source = tmp_path / "source"
    for name in tree():
        if name.startswith(("shmmap/", "clients/", "systemd/", ".ci/")) or "/" not in name:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    project = source / "pyproject.toml"
    text = project.read_text(encoding="utf-8")
    assert text.count('\nrepository = "') == 1
    head, _, tail = text.partition('\nrepository = "')
    project.write_text(f'{head}\nrepository = "{url}"{tail.partition(chr(34))[2]}', encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path / "built", source],
        check=False,
        capture_output=True,
        text=True,
        env=without_settings(),
    )
    if "satisfies the requirement hatchling" in done.stderr:
        pytest.skip("pip cannot reach hatchling, which builds the wheel")
    assert done.returncode == 0, done.stderr
    (wheel,) = (tmp_path / "built").glob("shmmap-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        about = email.parser.Parser().parsestr(archive.read(name).decode())
    assert description_faults(about) == []
    links = LINK.findall(str(about.get_payload()))
    assert (f"{URL}/blob/HEAD/shmmap/INSTALL.md" in links, f"{URL}/raw/HEAD/.github/town.svg" in links) == (
        bool(url),
        bool(url),
    )
    assert about["Project-URL"] == (f"Repository, {URL}" if url else None)
