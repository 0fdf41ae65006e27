# SPDX-License-Identifier: Apache-2.0
"""The machine the daemon runs on: names, locks, memory, signals, logs, scheduling."""
