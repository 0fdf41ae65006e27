# SPDX-License-Identifier: Apache-2.0
"""Find what on a machine hinders the daemon or its clients, and advise what to do."""
