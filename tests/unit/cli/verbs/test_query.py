# SPDX-License-Identifier: Apache-2.0
"""``--held ID[@VERSION]`` is split at the last @."""

from __future__ import annotations

import pytest

from shmmap.cli.verbs.query import held_cell
from shmmap.errors import BadRequest


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("cell.pcd", "cell.pcd"),
        ("cell.pcd@1f", ("cell.pcd", 0x1F)),
        ("/maps/a@b/cell.pcd", "/maps/a@b/cell.pcd"),
        ("/maps/a@b/cell@2.pcd", "/maps/a@b/cell@2.pcd"),
        ("/maps/a@b/cell.pcd@ffffffffffffffff", ("/maps/a@b/cell.pcd", (1 << 64) - 1)),
        ("cell@c0ffee", ("cell", 0xC0FFEE)),
    ],
)
def test_held(text: str, held: str | tuple[str, int]) -> None:
    assert held_cell(text) == held


@pytest.mark.parametrize(
    "text", ["cell.pcd@", "@1f", "cell.pcd@xyz", "cell.pcd@1ffffffffffffffff", "cell.pcd@-1"]
)
def test_not_held(text: str) -> None:
    with pytest.raises(BadRequest, match="--held"):
        held_cell(text)
