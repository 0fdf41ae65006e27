# SPDX-License-Identifier: Apache-2.0
"""What on a machine would hinder the daemon or its clients: facts, judged, each with what to do."""
