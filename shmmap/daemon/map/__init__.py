# SPDX-License-Identifier: Apache-2.0
"""The catalogue of the served map, its files, and the switch from one catalogue to the next."""
