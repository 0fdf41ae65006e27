# SPDX-License-Identifier: Apache-2.0
"""The demonstration: a daemon and consumers in a generated town."""
