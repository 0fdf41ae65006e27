# SPDX-License-Identifier: Apache-2.0
"""The rolling map's voxels: where they lie, what a scan does to them, and the bytes that hold them.

Pure: nothing here knows a daemon, a socket or a directory.  ``CHUNKS.md`` is the byte-exact document.

- `voxels`: which voxel, chunk and brick a point lies in
- `occupancy`: which points of a scan count, and what a hit and a miss are worth
- `marking`: a scan becomes the lists of voxels that it hits and passes through
- `marks`: these lists as bytes, from the mapper to the daemon's worker
- `layout`: a chunk in shared memory
- `applying`: marks change a chunk, whole or not at all
- `chunk_file`: a chunk on disk
"""
