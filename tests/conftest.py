# SPDX-License-Identifier: Apache-2.0
"""Fixtures every kind of test may use."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import hypothesis
import pytest

from shmmap.kernel_cache import compiled_mark
from tests.support.compiled_programs import built_once
from tests.support.cpp_client import compiled
from tests.support.kernels_once import watch
from tests.support.skips import (  # noqa: F401  hooks
    NEEDS_ROOT,
    programs_or_skip,
    pytest_collectreport,
    pytest_runtest_logreport,
    pytest_sessionfinish,
    pytest_terminal_summary,
)
from tests.support.survivors import no_survivors  # noqa: F401

_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


def pytest_configure(config: pytest.Config) -> None:
    """Compile kernels once for all tests and their processes, whatever their home is; heed Ctrl-C."""
    # a shell's background job ignores SIGINT, and below nohup SIGHUP, and so would the tests' programs
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
    # how long an example takes, to make and to run, is for the machine to say
    hypothesis.settings.register_profile(
        "shmmap", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
    )
    hypothesis.settings.load_profile("shmmap")
    if "NUMBA_CACHE_DIR" not in os.environ:
        cache = getattr(config, "cache", None)
        path = (
            cache.mkdir("kernels") if cache is not None else Path(tempfile.mkdtemp(prefix="shmmap-kernels-"))
        )
        path.chmod(0o700)  # whatever the umask is: a directory that others can write is not trusted
        os.environ["NUMBA_CACHE_DIR"] = str(path)
        if (mark := compiled_mark()) is not None:
            mark.touch()  # no daemon of a test compiles kernels unasked
        if cache is None:
            config.add_cleanup(lambda: shutil.rmtree(path, ignore_errors=True))
    watch(late=True)


def pytest_xdist_auto_num_workers() -> int:
    """Two tests at a time for each processor: most of them wait for processes, a third of their time."""
    return 2 * len(os.sched_getaffinity(0))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes minutes, lest one worker is left with it at the end; skip what needs root."""
    items.sort(key=lambda item: item.get_closest_marker("minutes") is None)
    if os.geteuid() != 0:
        for item in items:
            if item.get_closest_marker("root"):
                item.add_marker(pytest.mark.skip(reason=NEEDS_ROOT))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare the garbage collector what stays to the end: modules and tests by the thousand."""
    gc.disable()
    with _compiled_once():
        return (yield)


@contextlib.contextmanager
def _compiled_once() -> Iterator[None]:
    """Have one process import the tests, and the others wait until their modules are compiled on disk."""
    with open(__file__, encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not sys.dont_write_bytecode:
                fcntl.flock(file, fcntl.LOCK_SH)
        yield


def pytest_collection_finish() -> None:
    """Have it pass over them from now on."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """No test leaves a handler or a mask: what is forked after it could not be ended."""
    before = {number: signal.getsignal(number) for number in _ENDINGS}
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    yield
    after = {number: signal.getsignal(number) for number in _ENDINGS}
    for number, handler in before.items():
        signal.signal(number, handler)
    assert after == before
    assert signal.pthread_sigmask(signal.SIG_SETMASK, blocked) == blocked


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Directory of real maps and scans; the test is skipped where SHMMAP_TEST_DATA does not name it."""
    path = os.environ.get("SHMMAP_TEST_DATA", "")
    if not path:
        pytest.skip("SHMMAP_TEST_DATA is not set")
    return Path(path)


@pytest.fixture(scope="session")
def layer_kernels(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Have the kernels of layers compiled before a daemon needs them: there a load has a deadline."""

    def compile_them(_folder: Path) -> None:
        from shmmap.layers import kernels

        del kernels  # they are compiled as they are imported

    built_once(tmp_path_factory, "layer_kernels", compile_them)


@pytest.fixture(scope="session")
def cpp_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the client in C++, compiled once for all processes of the tests; needs g++."""
    programs_or_skip("g++")
    program = built_once(tmp_path_factory, "cpp_client", compiled)
    assert program is not None
    return program
