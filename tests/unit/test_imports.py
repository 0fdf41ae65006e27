# SPDX-License-Identifier: Apache-2.0
"""Imports point downward, stay light where they must, and every ``__all__`` is true.

How long the client's import takes is measured by ``tests/benchmarks/import_client.py``.
"""

from __future__ import annotations

import ast
import functools
import importlib
import json
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import shmmap_clients
import site_contents

import shmmap

PACKAGE = Path(shmmap.__file__).parent
CLIENTS = Path(shmmap_clients.__file__).parent
TESTS = Path(__file__).parents[1]

BASE = {
    "errors",
    "columns",
    "failpoints",
    "logfmt",
    "processes",
    "geometry",
    "installed",
    "quantities",
    "lacking",
    "kernel_cache",
    "compile_notices",
    "open3d_loading",
    "compiling",
    "large_tables",
    "disk_budget",
    "lazy_imports",
    "mounts",
    "private_directory",
    "progress",
    "work_room",
    "version",
    "config_table",
}
PARTS = {
    # part: what it may import besides itself
    "errors": set[str](),
    "columns": set[str](),
    "failpoints": set[str](),
    "logfmt": set[str](),
    "quantities": set[str](),
    "lacking": {"errors", "geometry", "quantities"},
    "installed": {"errors"},
    "processes": {"installed"},
    "geometry": {"errors"},
    "formats": {"errors", "columns", "geometry", "logfmt", "private_directory", "processes"},
    "segment": {"errors", "columns", "geometry", "failpoints", "lazy_imports", "mounts"},
    "protocol": {"errors", "columns", "geometry", "private_directory"},
    "kernel_cache": {"logfmt", "private_directory", "version"},
    "compile_notices": {"logfmt"},
    "compiling": {"compile_notices", "kernel_cache", "version"},
    "open3d_loading": {"errors"},
    "version": set[str](),
    "mounts": set[str](),
    "progress": set[str](),
    "large_tables": set[str](),
    "disk_budget": {"failpoints", "private_directory"},
    "private_directory": set[str](),
    "work_room": set[str](),
    "config_table": {"errors"},
    "lazy_imports": {"errors", "installed", "segment.process_limits"},
    "aio": {"client"},
    "live": {"chunks", "client", "lazy_imports", "protocol"},
    "events": {"client", "lazy_imports", "protocol"},
    "chunks": {"errors", "failpoints", "compiling", "lazy_imports"},
    "live_settings": {"errors", "chunks", "config_table"},
    "live_messages": {"live_settings", "protocol"},
    "live_worker": BASE | {"chunks", "dividing", "formats", "live_messages", "live_settings", "protocol"},
    "statistics": {"errors", "columns", "geometry", "logfmt", "protocol", "large_tables", "segment"},
    "layers": BASE | {"formats", "segment", "protocol", "statistics"},
    "origin": BASE | {"formats", "segment", "protocol", "statistics"},
    "dividing": BASE | {"formats", "layers", "origin"},
    "client": {
        "errors", "columns", "failpoints", "geometry", "installed", "lacking", "lazy_imports", "chunks",
        "mounts", "open3d_loading", "quantities", "segment", "protocol", "statistics.layout",
        "formats.png", "viewing.rendering",  # what notebooks show
    },
    "daemon": BASE | {
        "formats", "segment", "protocol", "statistics", "layers", "origin", "dividing", "live_messages",
        "live_settings",
    },
    "prepare": BASE | {"formats", "layers", "origin", "segment"},
    "publishing": BASE | {"dividing", "formats", "layers", "origin", "prepare", "segment"},
    "service": BASE | {"origin", "daemon.config"},
    "doctor": BASE | {
        "client", "formats", "live_settings", "origin", "protocol", "segment", "service", "statistics",
        "daemon.config", "daemon.prerequisites", "daemon.pins.probe", "daemon.service_manager",
        "daemon.host.memory",
    },
    "simulation": BASE | {"dividing", "formats", "origin"},
    "testing": BASE | {"formats", "layers", "origin", "segment", "protocol", "client", "statistics"},
    "demo": BASE | {
        "dividing", "formats", "origin", "layers", "segment", "protocol", "client", "statistics",
        "simulation", "testing", "viewing",
    },
    "viewing": BASE | {"chunks", "client", "dividing", "formats", "live_worker.disk", "origin", "protocol"},
    "cli": BASE | {
        "client", "demo", "dividing", "doctor", "formats", "layers", "live_settings", "live_worker.disk",
        "origin", "prepare", "protocol", "publishing", "segment", "service", "statistics", "viewing",
        "daemon.config", "daemon.main", "daemon.prerequisites", "daemon.pins.probe", "daemon.service_manager",
    },
}  # fmt: skip
"""What stands below what; a dotted name allows that module or package alone."""
ROOMS = [
    {"__main__"}, {"main"}, {"assembly"}, {"map_in_memory", "serving_loop"}, {"requests"},
    {"telemetry"}, {"loading", "live_relay"}, {"cache"}, {"events"}, {"transport"},
    {"travel", "prerequisites"}, {"map", "pins"}, {"host", "service_manager"}, {"config", "records", "turns"},
]  # fmt: skip
"""The daemon's floors, uppermost first; a room imports from the floors below its own."""

CLIENT_PACKAGES = {"numpy", "zmq", "posix_ipc", "msgspec"}
HEAVY = {
    "obstore",
    "open3d",
    "numba",
    "laspy",
    "scipy",
    "rich",
    "yaml",
    "xxhash",
    "lzf",
    "pandas",
    "matplotlib",
}
_PACKAGES = "import numpy, zmq, posix_ipc, msgspec"
_CLIENT = "import shmmap; shmmap.connect; shmmap.MapWindow"

EXPENSIVE = {
    "array", "asyncio", "ctypes.util", "dataclasses", "enum", "inspect", "json", "logging", "numpy.typing",
    "selectors", "signal", "socket", "subprocess", "typing_extensions", "zmq.utils.monitor",
}  # fmt: skip
"""A millisecond or more each where nothing else has loaded them."""

ALLOWED = {"_heapq", "_queue", "fcntl", "heapq", "queue", "select", "zlib"}
"""What the client itself uses of the standard library at import; `select` a connection loads in any case."""


def modules(package: Path = PACKAGE) -> list[str]:
    found = pkgutil.walk_packages([str(package)], f"{package.name}.")
    return sorted(module.name for module in found if not module.name.endswith("__main__"))


def source(module: str) -> Path:
    package = CLIENTS if module.startswith("shmmap_clients") else PACKAGE
    path = package.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@functools.cache
def parsed(path: Path) -> ast.Module:
    """Return what a file says; it is the same to the end of the tests."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(module: str, *, lazy: bool = True) -> Iterator[str]:
    """Every module of ours that a module imports; what only types need is left out.

    With ``lazy`` also what it imports in functions.
    """
    tree = parsed(source(module))
    for node in _run(tree.body, lazy=lazy):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name.split(".")[0] in {"shmmap", "shmmap_clients"}:
                while name not in ALL and "." in name:
                    name = name.rpartition(".")[0]
                yield name


def _run(body: Iterable[ast.AST], *, lazy: bool) -> Iterator[ast.AST]:
    """The nodes that run on import, or ever."""
    for node in body:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not lazy:
            continue
        yield node
        yield from _run(ast.iter_child_nodes(node), lazy=lazy)


ALL = frozenset([*modules(), *modules(CLIENTS), "shmmap", "shmmap_clients"])


@pytest.mark.parametrize("module", modules())
def test_imports_point_downward(module: str) -> None:
    part = module.split(".")[1]
    for name in imported(module):
        assert not name.startswith("shmmap_clients"), f"{module} may not import {name}: start the program"
        other = name.partition(".")[2]
        if other and other.split(".")[0] != part:
            allowed = PARTS[part]
            assert any(other == one or other.startswith(one + ".") for one in allowed), f"{module}: {name}"


@pytest.mark.parametrize("module", [m for m in modules() if m.startswith("shmmap.daemon.")])
def test_the_daemon_s_floors(module: str) -> None:
    floors = {room: number for number, floor in enumerate(ROOMS) for room in floor}
    room = module.split(".")[2]
    for name in imported(module):
        parts = name.split(".")
        if parts[:2] == ["shmmap", "daemon"] and len(parts) > 2 and parts[2] != room:
            assert floors[parts[2]] > floors[room], f"{module} imports {name}, which is not below it"


def test_no_imports_in_a_circle() -> None:
    graph = {module: set(imported(module)) - {module} for module in ALL}
    left = dict(graph)
    while free := [module for module, others in left.items() if not others & left.keys()]:
        for module in free:
            del left[module]
    assert not left, f"these import one another: {sorted(left)}"


@pytest.mark.parametrize("module", modules(CLIENTS))
def test_programs_use_public_names_alone(module: str) -> None:
    """But for kernels, archives, pictures, caches, lazy imports, and command lines."""
    for node in ast.walk(parsed(source(module))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "shmmap":
            if module == "shmmap_clients.command_line" and node.module == "shmmap.cli.programs":
                continue
            if node.module in (
                "shmmap.compiling",
                "shmmap.errors",
                "shmmap.events",
                "shmmap.formats.npz_writer",
                "shmmap.formats.png",
                "shmmap.formats.svg",
                "shmmap.layers",
                "shmmap.lazy_imports",
                "shmmap.live",
                "shmmap.private_directory",
            ):
                continue
            assert node.module == "shmmap", f"{module} imports {node.module}"
            assert {alias.name for alias in node.names} <= set(dir(shmmap))
        elif isinstance(node, ast.Import):
            assert not any(alias.name.startswith("shmmap.") for alias in node.names)


def test_no_test_file_imports_another() -> None:
    """What two of them need stands in tests/support, or in the fixtures of their directory.

    But for one that asks the same of another program.
    """
    for path in {*TESTS.rglob("test_*.py")} - {TESTS / "process/slow/test_ros_package.py"}:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests."):
                assert not (node.module or "").rsplit(".", 1)[-1].startswith("test_"), path


NEEDED_BY = {
    "shmmap_clients.ros_bridge": ("cyclonedds", "needs the package cyclonedds"),
    "shmmap_clients.ros_node": ("rclpy", "needs ROS 2"),
}


def modules_with_a_list() -> list[str]:
    """Modules whose names are public, or come from others."""
    return [
        module
        for module in (*modules(), *modules(CLIENTS))
        if re.search("^__all__ = ", source(module).read_text(encoding="utf-8"), re.MULTILINE)
    ]


def test_lists_are_of_public_modules_and_of_names_from_others() -> None:
    """Nothing else needs one, since nothing is imported with ``*``."""
    for module in set(modules_with_a_list()) - {page.module for page in site_contents.API}:
        names = set(importlib.import_module(module).__all__)
        nodes = ast.walk(parsed(source(module)))
        imported_names = {
            alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
        }
        assert names & imported_names, f"{module} needs no __all__"


@pytest.mark.parametrize("module", modules_with_a_list())
def test_all_is_true(module: str) -> None:
    package, reason = NEEDED_BY.get(module, ("shmmap", ""))
    pytest.importorskip(package, reason=reason)
    names = importlib.import_module(module).__all__
    assert len(set(names)) == len(names)
    for name in names:
        assert hasattr(sys.modules[module], name), f"{module}.__all__ names {name}, which does not exist"


def test_every_module_starts_with_its_licence() -> None:
    for path in [*PACKAGE.rglob("*.py"), *CLIENTS.rglob("*.py"), *TESTS.rglob("*.py")]:
        if path.stat().st_size:
            assert path.read_text(encoding="utf-8").startswith("# SPDX-License-Identifier: Apache-2.0\n"), (
                path
            )


def modules_after(code: str) -> set[str]:
    """Modules that are loaded after running ``code`` in a fresh interpreter."""
    program = f"import sys, json\n{code}\njson.dump(sorted(sys.modules), sys.stdout)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


def loaded_after(code: str) -> set[str]:
    """Top-level modules that are loaded after running ``code`` in a fresh interpreter."""
    return {name.split(".")[0] for name in modules_after(code)}


def test_the_client_loads_little_beyond_its_four_packages() -> None:
    ours = modules_after(_CLIENT) - modules_after(_PACKAGES)
    assert {"shmmap.client.window.map_window", "shmmap.segment.attach"} <= ours
    beyond = {name for name in ours if name.split(".")[0] != "shmmap"}
    assert not beyond & EXPENSIVE
    assert beyond <= ALLOWED, "is it worth its time in every client?"


def test_asking_alone_loads_no_windows() -> None:
    ours = modules_after("import shmmap; shmmap.connect")
    assert "shmmap.client.client" in ours
    assert not {name for name in ours if name.startswith("shmmap.client.window")}


def test_import_shmmap_alone_loads_no_package() -> None:
    before = loaded_after("")
    assert not (loaded_after("import shmmap") - before) & (HEAVY | CLIENT_PACKAGES)


@pytest.mark.parametrize("words", [["--help"], ["status", "--help"], ["ls", "--help"], ["query", "--help"]])
def test_command_line_starts_without_packages(words: list[str]) -> None:
    code = (
        "import contextlib, io\nfrom shmmap.cli import main\n"
        f"with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()): main({words!r})"
    )
    assert not loaded_after(code) & (HEAVY | CLIENT_PACKAGES)
