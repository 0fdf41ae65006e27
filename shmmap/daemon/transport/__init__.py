# SPDX-License-Identifier: Apache-2.0
"""Sockets, sessions and turns: receiving requests and sending replies."""
