# SPDX-License-Identifier: Apache-2.0
"""LiDAR scans and their poses, from files, bags or a socket.

::

    from shmmap_clients.scans import ScanSequence, read_scan, read_trajectory, thinned

    points = thinned(read_scan("scan.pcd"), 1.0)  # the mean point of each cube of 1 m, as --thin 1
    for scan in ScanSequence("scans", read_trajectory("poses.txt")):
        print(scan.name, scan.stamp_s, len(scan.xyz), scan.pose)

A scan is a file: PCD and what else `shmmap.read_cloud` reads; bare rows of floats (``.bin``, as of KITTI); or
NPZ (`numpy.savez`) with an array ``xyz``, (N, 3), metres, or ``xyz_4mm``, (N, 3) integers in units of 4 mm,
which take less space.  Other arrays of N rows are columns of the same name.

=====================  ===================================================================================
`read_scan`            the finite points of one file
`ScanReader`           reads files with all columns, leaves out near points, and counts them
`ScanSequence`         the scans of a directory in order, with poses if known: an iterable of `Scan`
`thinned`              one point for each cube: the mean of the points in it
`read_trajectory`      poses by time in the TUM format, as a `Trajectory`
=====================  ===================================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.scans.scan_file import ScanReader, read_scan, thinned
    from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
    from shmmap_clients.scans.trajectory import Trajectory, read_trajectory

__all__ = ["Scan", "ScanReader", "ScanSequence", "Trajectory", "read_scan", "read_trajectory", "thinned"]

__getattr__ = lazy_names(__name__)
