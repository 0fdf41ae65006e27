# SPDX-License-Identifier: Apache-2.0
"""How the programs' modules stand to each other: no circle, also not by imports inside functions."""

from __future__ import annotations

import ast
from pathlib import Path

import shmmap_clients

ROOT = Path(shmmap_clients.__file__).parents[1]


def imports() -> dict[str, set[str]]:
    """Every module with the modules of the package that it imports, anywhere in its code."""
    files = {}
    for path in (ROOT / "shmmap_clients").rglob("*.py"):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        files[name.removesuffix(".__init__")] = path
    found: dict[str, set[str]] = {}
    for module, path in files.items():
        targets = found.setdefault(module, set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in files:
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= (names & files.keys()) or {node.module}
            elif isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names} & files.keys()
        targets.discard(module)
    return found


def test_there_is_no_circle() -> None:
    left = imports()
    assert len(left) > 60
    backends = "shmmap_clients.ndt_scan_matcher.backends"
    assert f"{backends}.numba_backend" in left[f"{backends}.registry"], "imported inside a function"
    while left:
        free = {module for module, targets in left.items() if not targets & left.keys()}
        assert free, f"among these: {sorted(left)}"
        left = {module: targets for module, targets in left.items() if module not in free}
