# SPDX-License-Identifier: Apache-2.0
"""What systemd is told, and what it hands over."""
