# SPDX-License-Identifier: Apache-2.0
"""Published maps: objects named by their content, in a bucket or a directory; see ``ORIGIN.md``."""
