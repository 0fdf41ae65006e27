# SPDX-License-Identifier: Apache-2.0
"""Output of the verbs: tables, pictures, progress."""
