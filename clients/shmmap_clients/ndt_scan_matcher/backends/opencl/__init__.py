# SPDX-License-Identifier: Apache-2.0
"""What the OpenCL backend is made of: devices, programs, the map's memory on a device, waiting for it."""
