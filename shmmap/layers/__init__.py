# SPDX-License-Identifier: Apache-2.0
"""Layers: read-only tables computed once from a cell and shared by all clients (``LAYERS.md``).

====================  ==========================================================================
`build_layer`         compute a layer from plain arrays, without a daemon
`canonical_layer`     canonical form of a layer spec, as in replies
`LayerKind`           what a module that adds a kind of layer defines
`LayerTable`          what a builder returns
`voxel_covariances`   covariances of PCL, ndt_omp and Autoware from the rows of an ``ndt`` layer
`ground_height`       height of the ground at a point, from ``ground`` layers
`needed_packages`     turns the import error of a package that a kind needs into one clear line
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
