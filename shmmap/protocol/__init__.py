# SPDX-License-Identifier: Apache-2.0
"""Messages between client and daemon, and their codec (``PROTOCOL.md``)."""
