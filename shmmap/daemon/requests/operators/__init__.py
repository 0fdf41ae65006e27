# SPDX-License-Identifier: Apache-2.0
"""Requests that only operators may send."""
