# SPDX-License-Identifier: Apache-2.0
"""Layers: read-only tables computed from a cell once for all (``LAYERS.md``).

====================  ==========================================================================
`build_layer`         compute a layer of plain arrays, without a daemon
`canonical_layer`     the name that a layer has in replies, of a spec in any form
`LayerKind`           what a module that adds a kind of layer defines
`LayerTable`          what a builder returns
`voxel_covariances`   covariances of PCL, ndt_omp and Autoware from the rows of an ``ndt`` layer
`ground_height`       height of the ground at a place, from ``ground`` layers
`needed_packages`     one clear line where a package that a kind needs is missing
====================  ==========================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_public_names

if TYPE_CHECKING:
    from shmmap.layers.build import build_layer
    from shmmap.layers.contract import LayerKind, LayerTable
    from shmmap.layers.ground import ground_height
    from shmmap.layers.spec import canonical_layer
    from shmmap.layers.voxels import voxel_covariances
    from shmmap.lazy_imports import needed_packages

__all__ = [
    "LayerKind",
    "LayerTable",
    "build_layer",
    "canonical_layer",
    "ground_height",
    "needed_packages",
    "voxel_covariances",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_public_names(__name__)
