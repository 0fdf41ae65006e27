# SPDX-License-Identifier: Apache-2.0
"""Windows: the cells around a moving pose, kept current in a thread."""
