# SPDX-License-Identifier: Apache-2.0
"""What happened, numbered, and sent to subscribers."""
