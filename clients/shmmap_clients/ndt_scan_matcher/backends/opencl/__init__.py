# SPDX-License-Identifier: Apache-2.0
"""Parts of the OpenCL backend: devices, the program's source, maps in memory, waiting for a device."""
