# SPDX-License-Identifier: Apache-2.0
"""Verbs that get cells, and manage those in memory."""
