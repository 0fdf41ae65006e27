# SPDX-License-Identifier: Apache-2.0
"""The catalogue of the map served, its files, and changing from one to the next."""
