# SPDX-License-Identifier: Apache-2.0
"""Handling of client requests, from decoding to the answer."""
