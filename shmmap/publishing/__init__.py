# SPDX-License-Identifier: Apache-2.0
"""Publishing a map into a bucket or a directory, its versions there, and fetching it back."""
