# SPDX-License-Identifier: Apache-2.0
"""From one request to one answer."""
