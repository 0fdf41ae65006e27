# SPDX-License-Identifier: Apache-2.0
"""Sockets, sessions and turns: from bytes to requests and back."""
