# SPDX-License-Identifier: Apache-2.0
"""Does a device compute what the processor computes?  Scenes, comparisons, and how long it takes.

Needs numpy and pyopencl only, where the scenes come from a file.
"""
