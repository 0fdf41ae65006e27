# SPDX-License-Identifier: Apache-2.0
"""Publishes a map into a bucket or a directory, manages its versions there, and fetches it back."""
