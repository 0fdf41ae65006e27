# SPDX-License-Identifier: Apache-2.0
"""Verbs that read cells, and manage those in memory."""
