# SPDX-License-Identifier: Apache-2.0
"""The cells around a moving pose, kept current in a thread."""
