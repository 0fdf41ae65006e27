# SPDX-License-Identifier: Apache-2.0
"""The daemon: loads cells, keeps them in shared memory, and answers clients."""
