# SPDX-License-Identifier: Apache-2.0
"""What the verbs show: tables, pictures, progress."""
