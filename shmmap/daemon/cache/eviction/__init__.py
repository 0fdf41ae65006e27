# SPDX-License-Identifier: Apache-2.0
"""Making room: which segments give way, in which order."""
