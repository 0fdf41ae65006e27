# SPDX-License-Identifier: Apache-2.0
"""What users test with.

`shmmap.testing.fixtures` has a daemon for pytest, `shmmap.testing.daemon_process` one for everything else;
`shmmap.testing.layer_conformance` checks a layer kind of one's own.
"""
