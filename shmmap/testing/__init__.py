# SPDX-License-Identifier: Apache-2.0
"""Tools for the tests of programs that use shmmap.

`shmmap.testing.fixtures` provides a daemon for pytest, `shmmap.testing.daemon_process` a daemon for other
uses; `shmmap.testing.layer_conformance` checks a user's own layer kind.
"""
