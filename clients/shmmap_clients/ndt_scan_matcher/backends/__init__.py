# SPDX-License-Identifier: Apache-2.0
"""Backends that evaluate scores and derivatives."""
