"""Cached machine code is used only for the sources and settings that it was compiled from."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import IO, Any

import pytest

from foundation.compiled import ordered_map, processor_count

SQUARE = """
from foundation.compiled import compiled
from {module} import (
    power,
)

@compiled
def square(number: int) -> int:
    return power(number)
"""
POWER = """
from foundation.compiled import inlined

@inlined
def power(number):
    return number ** {exponent}
"""
SQUARED = """
from kernels.square import square
from numba.core import event
with event.install_recorder("numba:compile") as compilations:
    print(square(5), bool(compilations.buffer))
"""
FORKS = """
import json, os, sys
import numba.core.event
numba.njit(lambda number: number**2)(5)
for line in sys.stdin:
    program, settings = json.loads(line)
    if not (pid := os.fork()):
        os.environ.update(settings)
        numba.config.reload_config()
        exec(program, {})
        sys.stdout.flush()
        os._exit(0)
    print("ended with", os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""
"""Runs each program that it is given in a process in which numba has compiled something: to get ready for the first
time takes it a second."""

ROOT = Path(__file__).parents[2]


class Kernels:
    """A copy of the decorator next to a kernel, and programs that call it; `cache` is the folder of compiled code."""

    def __init__(self, folder: Path, forks: IO[str], errors: IO[str]) -> None:
        self.folder, self._forks, self._errors = folder, forks, errors
        self.cache = folder / "cache"

    def write_power(self, exponent: int) -> None:
        """Write the imported file on which the compiled code depends."""
        (self.folder / "kernels" / "power.py").write_text(POWER.format(exponent=exponent))

    def run(self, program: str, **settings: str) -> list[str]:
        """Run a program without a terminal; return the lines of its stdout and stderr."""
        self._forks.write(json.dumps([program, settings]) + "\n")
        self._forks.flush()
        lines = list(iter(lambda: self._errors.readline().rstrip("\n"), "ended with 0"))
        assert not any(line.startswith("ended with") for line in lines), "the program failed"
        return lines

    def code(self) -> list[Path]:
        """Return the files with cached code."""
        return list(self.cache.rglob("*.code"))


def environment(folder: Path) -> dict[str, str]:
    return {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a copy of the decorator and a kernel."""
    folder = tmp_path_factory.mktemp("compiled")
    shutil.copytree(ROOT / "foundation", folder / "foundation", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "kernels").mkdir()
    (folder / "kernels" / "__init__.py").touch()
    (folder / "kernels" / "square.py").write_text(SQUARE.format(module="kernels.power"))
    return folder


@pytest.fixture(scope="module")
def process(folder: Path) -> Iterator[Kernels]:
    command = [sys.executable, "-c", FORKS]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, cwd=folder, env=environment(folder), text=True, **pipes) as process:
        assert process.stdin
        assert process.stdout
        yield Kernels(folder, process.stdin, process.stdout)
        process.stdin.close()


@pytest.fixture
def kernels(process: Kernels) -> Kernels:
    """Return the kernel before anything was compiled."""
    shutil.rmtree(process.cache, ignore_errors=True)
    process.write_power(2)
    return process


@pytest.mark.slow
def test_cached_code_depends_on_sources_settings_and_hash(kernels: Kernels) -> None:
    # Beside a copy of the decorator's files: numba by itself would go on with the old code.
    assert kernels.run(SQUARED) == ["25 True"]
    (cached,) = kernels.code()
    cached.write_bytes(cached.read_bytes()[:-1])
    assert kernels.run(SQUARED) == ["25 True"]
    assert kernels.run(SQUARED) == ["25 False"], "the next start compiles nothing"
    assert kernels.run(SQUARED, NUMBA_OPT="1") == ["25 True"]
    assert kernels.code() == [cached], "the new code replaces the old"
    assert kernels.run(SQUARED, NUMBA_CPU_NAME="generic") == ["25 True"]
    assert len(kernels.code()) == 2, "code of another processor is cached too"
    kernels.write_power(3)
    assert kernels.run(SQUARED) == ["125 True"], "a file that was compiled into it has changed"


IMPORTED = """
import copy, pickle, sys
from kernels.square import square
assert pickle.loads(pickle.dumps(square)) is square and copy.deepcopy([square]) == [square]
print("numba" in sys.modules)
"""


@pytest.mark.slow
def test_pickles_by_name_without_importing_numba(folder: Path) -> None:
    program = [sys.executable, "-c", IMPORTED]
    assert subprocess.check_output(program, cwd=folder, env=environment(folder), text=True) == "False\n"


NO_FOLDER = """
import numba
from numba.core import caching

class Nowhere:
    @classmethod
    def from_function(cls, function, file):
        return None

caching.CacheImpl._locator_classes = [Nowhere]
from kernels.square import square
try:
    numba.njit(cache=True)(square.py_func)
except RuntimeError as error:
    assert "cannot cache" in str(error)
    print(square(5))
"""


@pytest.mark.slow
def test_compiles_without_a_writable_folder(kernels: Kernels) -> None:
    """Numba cannot cache if neither the package's folder nor the home folder is writable."""
    assert kernels.run(NO_FOLDER) == ["25"]
    assert kernels.code() == []


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system binds no process to processors")
def test_a_process_bound_to_one_processor_counts_one() -> None:
    previous = os.sched_getaffinity(0)
    assert processor_count() == len(previous)
    try:
        os.sched_setaffinity(0, {min(previous)})
        assert processor_count() == 1
    finally:
        os.sched_setaffinity(0, previous)


def test_counts_all_processors_without_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert processor_count() == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert processor_count() == 1


def test_map_keeps_order_and_limits_its_queue() -> None:
    consumed: list[int] = []

    def items() -> Iterator[int]:
        for number in range(100):
            consumed.append(number)
            yield number

    for number, value in enumerate(ordered_map(lambda item: item**2, items(), 3)):
        assert value == number**2
        assert len(consumed) <= number + 7


def test_map_cancels_waiting_calls_after_an_error() -> None:
    started: list[int] = []
    release = Event()

    def work(item: int) -> int:
        started.append(item)
        if item == 0:
            raise KeyError(item)
        release.wait()
        return item

    pulling = ordered_map(work, range(1000), 2)
    release.set()
    with pytest.raises(KeyError):
        list(pulling)
    assert len(started) <= 5
