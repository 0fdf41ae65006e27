# SPDX-License-Identifier: Apache-2.0
"""What the OpenCL backend is made of: devices, the program's source, maps in memory, waiting for a device."""
