# SPDX-License-Identifier: Apache-2.0
"""The daemon's map in a browser, live (``shmmap view --browser``)."""
