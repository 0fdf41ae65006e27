# SPDX-License-Identifier: Apache-2.0
"""Localization along a drive."""
