# SPDX-License-Identifier: Apache-2.0
"""What evaluates scores and derivatives."""
