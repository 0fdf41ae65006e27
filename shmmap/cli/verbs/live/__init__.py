# SPDX-License-Identifier: Apache-2.0
"""``shmmap live``: one module an action."""
