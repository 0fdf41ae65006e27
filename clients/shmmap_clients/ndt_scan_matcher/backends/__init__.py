# SPDX-License-Identifier: Apache-2.0
"""Who evaluates scores and derivatives."""
