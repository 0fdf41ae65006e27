# SPDX-License-Identifier: Apache-2.0
"""Verbs that run a daemon, and describe the installation."""
