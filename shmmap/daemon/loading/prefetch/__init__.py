# SPDX-License-Identifier: Apache-2.0
"""What clients will need next: it is loaded before they ask."""
