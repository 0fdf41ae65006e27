# SPDX-License-Identifier: Apache-2.0
"""Counters and rows of the daemon in shared memory: readable without a request."""
