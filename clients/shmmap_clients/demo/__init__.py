# SPDX-License-Identifier: Apache-2.0
"""Parts of the programs for demonstrations and checks."""
