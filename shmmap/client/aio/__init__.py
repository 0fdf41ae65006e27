# SPDX-License-Identifier: Apache-2.0
"""The client for asyncio; its public names are in `shmmap.aio`."""
