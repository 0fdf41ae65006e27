# SPDX-License-Identifier: Apache-2.0
"""Voxels of the rolling map: their indices, their update by scans, and their storage as bytes.

Independent of daemon, sockets and directories.  ``CHUNKS.md`` is the byte-exact specification.

- `voxels`: the voxel, chunk and brick that contain a point
- `occupancy`: which points of a scan are used, and the log-odds of a hit and a miss
- `marking`: turns a scan into lists of voxels that it hits and passes through
- `marks`: these lists as bytes, from the mapper to the daemon's worker
- `layout`: a chunk in shared memory
- `applying`: applies marks to a chunk, completely or not at all
- `chunk_file`: a chunk on disk
"""
