# SPDX-License-Identifier: Apache-2.0
"""The version of this package: the build, the daemon, its loaders and ``shmmap version`` read it here."""

__all__ = ["__version__"]

__version__ = "0.2.0"
