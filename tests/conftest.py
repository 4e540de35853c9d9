"""Which tests are slow, what all have in common, and that comparisons of arrays compare something."""

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

# Test processes share the machine. Threads that libraries start in each of them spin while they wait for one another:
# without this a system of a hundred equations takes OpenBLAS fifty times as long, and a build twice. Must stand before
# NumPy is imported; what tests start inherits it. Threads of our own are as many as ever.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_threads, "1")

import numpy as np  # noqa: E402 - after the threads

from tests.pinned import TESTS, Pinned  # noqa: E402 - it needs NumPy

# Sessions and tables are written to the disk for good, step by step: a run of twenty lights waits for it half a second.
# What is lost with the power is of no interest here, and in memory nobody waits.
MEMORY = Path("/dev/shm")
# Free space from which temporary folders lie in memory: what is there at a time of a whole run is below a gigabyte,
# since the folders of tests that pass are removed at once.
MEMORY_BYTES = 4 << 30

if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MEMORY_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# PyTorch loads Triton's LLVM where that is installed, which crashes a process in which Mesa has loaded its own for
# OpenGL. No program shows a full screen and trains; a test process may do both. None keeps a module from
# being imported.
sys.modules.setdefault("triton", None)  # pyrefly: ignore[no-matching-overload]

# Ten thousand tests stay to the end, and are looked through by the garbage collector again and again as they become
# more: a sixth of the time that reading them takes.
gc.disable()
# At the end bindings of C++ look whether anything of theirs is left.
atexit.register(gc.unfreeze)


def _of_something(compare: Callable[..., None]) -> Callable[..., None]:
    """Return a comparison of NumPy's that fails where an array without numbers is held against a number."""

    @functools.wraps(compare)
    def compared(actual: Any, desired: Any, *given: Any, **named: Any) -> None:
        assert np.size(actual) or np.ndim(desired), "an array without numbers equals any number: nothing was tested"
        compare(actual, desired, *given, **named)

    return compared


np.testing.assert_allclose = _of_something(np.testing.assert_allclose)
np.testing.assert_array_equal = _of_something(np.testing.assert_array_equal)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put first the tests that wait for programs: lint runs beside them, and nobody waits for them at the end."""
    items.sort(key=lambda item: item.path.name != "test_rehearsal.py")


def pytest_collection_finish() -> None:
    """Collect garbage from here on, but for what has come by now; seldom, as what stays is looked through each time."""
    gc.freeze()
    gc.set_threshold(5_000, 20, 100)
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Print arrays as NumPy does by itself: the package colour sets its own way for all of a process."""
    np.set_printoptions(legacy=False)


# What marks all tests of a file.
SLOW_FILE = re.compile(r"^pytestmark = (\[\s*)?pytest\.mark\.slow\b", re.MULTILINE)

# Examples of each property in `make test`, others each time, and in `make quick`, whose properties took a third of a
# minute at a hundred; tests that need more say so.
WHOLE_EXAMPLES, QUICK_EXAMPLES = 30, 12

# No test says how long an example may take: a machine that does other things as well takes ten times as long.
settings.register_profile("whole", max_examples=WHOLE_EXAMPLES, deadline=None)
settings.register_profile("quick", max_examples=QUICK_EXAMPLES, deadline=None)
settings.load_profile("whole")


def pytest_configure(config: pytest.Config) -> None:
    """Try fewer examples where slow tests are not wanted."""
    if config.getoption("markexpr") == "not slow":
        settings.load_profile("quick")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the numbers of known runs be written anew."""
    parser.addoption("--renew-pinned", action="store_true", help="keep the numbers of known runs as they are now")


@pytest.fixture
def pinned(request: pytest.FixtureRequest) -> Pinned:
    """Return what compares numbers with those in the file of the test's module."""
    return Pinned(request.path.relative_to(TESTS), renew=bool(request.config.getoption("--renew-pinned")))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave slow files unread where they are not wanted: what they import takes seconds, too."""
    if config.getoption("markexpr") != "not slow" or collection_path.suffix != ".py":
        return None
    return True if SLOW_FILE.search(collection_path.read_text(encoding="utf-8")) else None


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return half as many workers again as there are processors: tests wait for programs and servers that they start.

    On two processors a third worker takes a quarter of the time away, 6:51 in place of 9:16. Quick tests wait for
    nothing, and each worker reads all of them.
    """
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if config.getoption("markexpr") == "not slow":
        return processors
    return processors + (processors + 1) // 2


@pytest.fixture(scope="session", autouse=True)
def kept_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keep what is computed once for a table, and costs a second, in one folder for a whole run, not in the user's."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        # Those of the other processes lie beside it.
        folder = folder.parent
    os.environ["XDG_CACHE_HOME"] = str(folder / "kept")
    return folder / "kept"


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """Leave the pictures of build-lut's reports blank, where a module's tests look at none."""
    from tests.calibration.lab import blank_pictures

    with blank_pictures():
        yield


@pytest.fixture
def hang_up() -> Iterator[None]:
    """Let SIGHUP end programs as it does on a terminal, also where the tests run under nohup, which ignores it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
