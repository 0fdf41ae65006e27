# SPDX-License-Identifier: Apache-2.0
"""What the site has, in its order: sections of pages, the public names by what a user wants to do.

`tests/unit/test_site.py` holds that every page and every public name stands here.
"""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from typing import Final

HERE: Final = ".github/site"

SECTIONS: Final = {
    "Begin": [
        f"{HERE}/START.md",
        f"{HERE}/CONCEPTS.md",
        "shmmap/INSTALL.md",
        f"{HERE}/GLOSSARY.md",
    ],
    "Your map": [
        "shmmap/dividing/OWN_CLOUD.md",
        "shmmap/origin/AUTOWARE_MAP.md",
        "shmmap/layers/LAYERS.md",
        "shmmap/client/live/LIVE_MAPS.md",
        "shmmap/publishing/PUBLISHING.md",
        "shmmap/publishing/SERVING_FROM_A_BUCKET.md",
        "shmmap/publishing/GATEWAY.md",
        "shmmap/publishing/SLICES.md",
    ],
    "Your program": [
        "clients/IN_YOUR_PROGRAM.md",
        "shmmap/client/MULTIPROCESSING.md",
        "clients/README.md",
        "clients/cpp/README.md",
        "clients/cpp/AUTOWARE.md",
        "clients/ros/README.md",
        "clients/shmmap_clients/ros_node/ROS_NODE.md",
        "clients/shmmap_clients/ros_bridge/ROS_BRIDGE.md",
    ],
    "Run it": [
        "systemd/README.md",
        "shmmap/CONTAINERS.md",
        "shmmap/daemon/MEMORY.md",
        "tests/benchmarks/BENCHMARKS.md",
    ],
    "Reference": [
        "api",  # made by `site_reference`
        "command-line",
    ],
    "Formats and protocol": [
        "shmmap/protocol/PROTOCOL.md",
        "shmmap/segment/LAYOUT.md",
        "shmmap/statistics/STATISTICS.md",
        "shmmap/chunks/CHUNKS.md",
        "shmmap/origin/remote/ORIGIN.md",
    ],
    "The project": [
        "shmmap/ARCHITECTURE.md",
        ".github/CONTRIBUTING.md",
        ".github/SECURITY.md",
        "CHANGELOG.md",
    ],
}
"""Pages of each section, as they lie in the repository; README.md is the first page, above them."""


SEARCHES: Final = {
    "ndt units": "shmmap/layers/LAYERS",
    "covariance unit": "shmmap/layers/LAYERS",
    "intensity dtype": "shmmap/layers/LAYERS",
    "elevation no value": "shmmap/layers/LAYERS",
    "asyncio": "clients/IN_YOUR_PROGRAM",
    "notebook": "clients/IN_YOUR_PROGRAM",
    "matplotlib": "clients/IN_YOUR_PROGRAM",
    "prometheus": "systemd/README",
}
"""What users search for, and the page that the site's search has to find."""


@dataclass(frozen=True)
class ApiPage:
    """One page of the API.

    ``names`` of ``module`` are described; without names all of its ``__all__``.
    """

    path: str
    title: str
    module: str
    names: tuple[str, ...] = ()
    pages: tuple[str, ...] = ()
    """Pages of the repository to read first."""

    def described(self) -> tuple[str, ...]:
        """Return the names; none where the module is not there, or has no public ones."""
        if importlib.util.find_spec(self.module) is None:
            return ()
        return self.names or tuple(getattr(importlib.import_module(self.module), "__all__", ()))


API: Final = (
    ApiPage(
        "api/ask",
        "Ask for cells",
        "shmmap",
        (
            *("connect", "Client", "Circle", "Box", "AutowareSquare", "Area"),
            *("MapListing", "CellInfo", "PendingLayer"),
        ),
    ),
    ApiPage("api/read", "Read points and columns", "shmmap", ("Cell", "CellSet", "PointsAround")),
    ApiPage(
        "api/follow",
        "Follow a vehicle",
        "shmmap",
        ("MapWindow", "WindowUpdate", "Retention", "RetentionPolicy", "RetentionCandidate"),
    ),
    ApiPage("api/aio", "Use asyncio", "shmmap.aio"),
    ApiPage("api/files", "Read and write files", "shmmap", ("read_cloud", "write_pcd")),
    ApiPage("api/layers", "Build layers", "shmmap.layers", pages=("shmmap/layers/LAYERS.md",)),
    ApiPage(
        "api/live", "Write and read live maps", "shmmap.live", pages=("shmmap/client/live/LIVE_MAPS.md",)
    ),
    ApiPage("api/events", "Follow what the daemon does", "shmmap.events"),
    ApiPage("api/errors", "Handle errors", "shmmap.errors"),
    ApiPage("api/testing", "Test a program with a daemon", "shmmap.testing.daemon_process"),
    ApiPage("api/fixtures", "Test a program with pytest", "shmmap.testing.fixtures"),
    ApiPage("api/conformance", "Test a layer of your own", "shmmap.testing.layer_conformance"),
    ApiPage("api/scans", "Read and thin scans", "shmmap_clients.scans"),
    ApiPage("api/ndt", "Match scans", "shmmap_clients.ndt_scan_matcher", pages=("clients/README.md",)),
    ApiPage("api/initial", "Find a first pose", "shmmap_clients.pose_initializer"),
    ApiPage("api/compare", "Compare scans with the map", "shmmap_clients.compare_map_filter"),
    ApiPage("api/elevation", "Get heights of the ground", "shmmap_clients.elevation_map"),
    ApiPage("api/rolling", "Map scans", "shmmap_clients.rolling_map"),
    ApiPage("api/ros", "Make ROS 2 messages", "shmmap_clients.ros_node"),
    ApiPage("api/ros_cells", "Write a ROS 2 node", "shmmap_clients.ros_cells"),
    ApiPage("api/ros_bridge", "Run the bridge to ROS 2", "shmmap_clients.ros_bridge"),
    ApiPage("api/programs", "Write a command line like shmmap's", "shmmap.cli.programs"),
)

PROGRAMS: Final = {
    "shmmap-ndt": "shmmap_clients.ndt_scan_matcher.cli",
    "shmmap-pose-init": "shmmap_clients.pose_initializer.cli",
    "shmmap-compare": "shmmap_clients.compare_map_filter.cli",
    "shmmap-elevation": "shmmap_clients.elevation_map.cli",
    "shmmap-rolling": "shmmap_clients.rolling_map.cli",
    "shmmap-ros-bridge": "shmmap_clients.ros_bridge.cli",
    "shmmap-ros-node": "shmmap_clients.ros_node.cli",
}
"""Programs beside ``shmmap``, and the modules whose ``main`` they run."""

_OTHERS: Final = (
    *(
        "argparse",
        "asyncio",
        "collections",
        "concurrent",
        "math",
        "msgspec",
        "np",
        "numpy",
        "open3d",
        "os",
        "pathlib",
    ),
    *("signal", "subprocess", "threading", "time", "torch", "typing"),
)
_NAMES: Final = (
    *("Evidence", "Floats", "Held", "Hello", "Holder", "LiveChunkPage", "Mask", "StepRule", "Subparsers"),
    *("DeviceHung", "FILLED", "MEASURED", "NAMES", "NOTHING", "TABLE_COLUMNS", "Welcome", "shmmap.cli"),
    *("default_nvtl", "fill_holes", "newton_step", "parse_layer", "search", "upward_step"),
    *("ArrayLike", "NDArray", "PointCloud2", "array", "conftest.py", "cylinder_and_box_overlap_exists"),
)
NOT_PUBLIC: Final = (
    rf"({'|'.join(_OTHERS)})\b.*",
    "|".join(name.replace(".", r"\.") for name in _NAMES),
    r"dict\[str",  # a type that Sphinx divides
    r".*\._\w+",
    r"shmmap\.(chunks|cli|client|formats|layers|protocol|segment|statistics)\.(\w+\.)+\w+",
    r"shmmap\.layers\.ground",
    r"shmmap_clients\.\w+\.(\w+\.)*[a-z]\w+\.\w+",
)
"""Patterns of names in docstrings and signatures that the site does not describe: others', and inner ones."""
