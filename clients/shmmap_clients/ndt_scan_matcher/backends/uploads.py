# SPDX-License-Identifier: Apache-2.0
"""What a backend wrote to its device so that maps could be matched against."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["UploadStatistics"]


@dataclass(slots=True)
class UploadStatistics:
    """What was written to a device for maps; all zero where maps are read where they lie.

    Attributes
    ----------
    written_bytes
        With what lies between the parts of one write.
    writes
        Each of neighbouring parts, some megabytes at most.
    laid_out_anew
        Maps for which there was no room beside the one in use, or in one piece: everything was written again.
    """

    written_bytes: int = 0
    writes: int = 0
    laid_out_anew: int = 0
