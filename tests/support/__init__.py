# SPDX-License-Identifier: Apache-2.0
"""What tests share.  Oracles here import nothing from shmmap: they judge it from outside."""
