# SPDX-License-Identifier: Apache-2.0
"""Draw points as pictures, without a display: where points come from, rendering, lettering."""
