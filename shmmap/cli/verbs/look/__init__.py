# SPDX-License-Identifier: Apache-2.0
"""Verbs that show the state of a daemon and its clients."""
