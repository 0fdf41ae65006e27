# SPDX-License-Identifier: Apache-2.0
"""What is done with the directory of a live map while nobody maps."""
