# SPDX-License-Identifier: Apache-2.0
"""The kernel's word on which segments are in use."""
