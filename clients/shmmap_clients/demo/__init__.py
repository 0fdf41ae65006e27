# SPDX-License-Identifier: Apache-2.0
"""Several programs side by side on one daemon."""
