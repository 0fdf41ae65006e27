# SPDX-License-Identifier: Apache-2.0
"""One copy of a vehicle's point-cloud map per machine, in shared memory."""

__version__ = "0.1.0"
