# SPDX-License-Identifier: Apache-2.0
"""The daemon's machine: names, locks, memory, signals, logs, scheduling."""
