# SPDX-License-Identifier: Apache-2.0
"""One alignment: score, derivatives, steps, limits."""
