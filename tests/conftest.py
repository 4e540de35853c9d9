"""Common settings of all tests: slow tests, threads, temporary folders, and checks of array comparisons."""

from __future__ import annotations

import atexit
import functools
import gc
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# Test processes share the machine. Library threads in each process spin while they wait for one another: OpenBLAS takes
# fifty times as long for a hundred equations, and a build twice. This must precede the import of NumPy; programs
# started by tests inherit it. Our own threads are not affected.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_threads, "1")

import numpy as np  # noqa: E402 - after the threads

from tests.pinned import TESTS, Pinned  # noqa: E402 - it needs NumPy

# Sessions and LUTs are flushed step by step: a run of twenty illuminants waits half a second for the disk. Tests need
# no protection against power cuts, and memory does not wait.
MEMORY = Path("/dev/shm")
# Minimum free memory for temporary folders. A whole run needs less than one gigabyte, because folders of passed tests
# are removed at once.
MEMORY_BYTES = 4 << 30

if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MEMORY_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# PyTorch loads the LLVM of Triton, if installed. This crashes a process in which Mesa has loaded its own LLVM for
# OpenGL. No program shows a full screen and trains, but a test process may do both. None prevents the import.
sys.modules.setdefault("triton", None)  # pyrefly: ignore[no-matching-overload]

# Ten thousand tests are never freed, but the garbage collector checks them repeatedly: a sixth of the time of
# collection.
gc.disable()
# C++ bindings check for leaked objects at exit.
atexit.register(gc.unfreeze)


def _of_nonempty(compare: Callable[..., None]) -> Callable[..., None]:
    """Wrap a comparison of NumPy so that it fails if an empty array is compared with a number."""

    @functools.wraps(compare)
    def compared(actual: Any, desired: Any, *arguments: Any, **options: Any) -> None:
        assert np.size(actual) or np.ndim(desired), (
            "an empty array equals any number, so nothing was tested; compare a non-empty array"
        )
        compare(actual, desired, *arguments, **options)

    return compared


np.testing.assert_allclose = _of_nonempty(np.testing.assert_allclose)
np.testing.assert_array_equal = _of_nonempty(np.testing.assert_array_equal)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start the tests that wait for programs first, while lint runs in parallel."""
    items.sort(key=lambda item: item.path.name != "test_rehearsal.py")


def pytest_collection_finish() -> None:
    """Collect garbage from now on, except existing objects; rarely, because what stays is checked each time."""
    gc.freeze()
    gc.set_threshold(5_000, 20, 100)
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Print arrays in the style of NumPy: the package colour changes it for the whole process."""
    np.set_printoptions(legacy=False)


# Mark of a file in which all tests are slow.
SLOW_FILE = re.compile(r"^pytestmark = (\[\s*)?pytest\.mark\.slow\b", re.MULTILINE)

# Hypothesis examples per property: in `make test` (others each time), and in `make quick`, where a hundred took 20 s.
WHOLE_EXAMPLES, QUICK_EXAMPLES = 30, 12

# No deadline: a busy machine may take ten times as long.
settings.register_profile("whole", max_examples=WHOLE_EXAMPLES, deadline=None)
settings.register_profile("quick", max_examples=QUICK_EXAMPLES, deadline=None)
settings.load_profile("whole")


def pytest_configure(config: pytest.Config) -> None:
    """Use fewer examples if slow tests are excluded."""
    if config.getoption("markexpr") == "not slow":
        settings.load_profile("quick")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes new pinned numbers."""
    parser.addoption("--renew-pinned", action="store_true", help="write the present numbers of known runs")


@pytest.fixture
def pinned(request: pytest.FixtureRequest) -> Pinned:
    """Return a function that compares numbers with the file of the test module."""
    return Pinned(request.path.relative_to(TESTS), renew=bool(request.config.getoption("--renew-pinned")))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not read slow files if slow tests are excluded: their imports take seconds."""
    if config.getoption("markexpr") != "not slow" or collection_path.suffix != ".py":
        return None
    return True if SLOW_FILE.search(collection_path.read_text(encoding="utf-8")) else None


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return 1.5 workers per processor, because tests wait for programs and servers.

    On two processors a third worker saves a quarter of the time: 6:51 instead of 9:16 minutes. Quick tests do not wait,
    and each worker reads all of them.
    """
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if config.getoption("markexpr") == "not slow":
        return processors
    return processors + (processors + 1) // 2


@pytest.fixture(scope="session", autouse=True)
def kept_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Use one cache folder for a whole run, not that of the user; each result costs a second."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        # The folders of the other processes are next to it.
        folder = folder.parent
    os.environ["XDG_CACHE_HOME"] = str(folder / "kept")
    return folder / "kept"


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """Skip drawing the pictures of build-lut reports in modules that do not test them."""
    from tests.calibration.lab import blank_pictures

    with blank_pictures():
        yield


@pytest.fixture
def hang_up() -> Iterator[None]:
    """Let SIGHUP end programs as on a terminal, also under nohup, which ignores it."""
    previous = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, previous)
