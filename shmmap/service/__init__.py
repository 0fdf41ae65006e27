# SPDX-License-Identifier: Apache-2.0
"""The systemd units, and installing them."""
