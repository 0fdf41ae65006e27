# SPDX-License-Identifier: Apache-2.0
"""Verbs that look at a daemon and its clients."""
