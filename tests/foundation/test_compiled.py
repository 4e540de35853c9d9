"""Machine code on disk is used again for the code it was made from only."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

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
import sys
from kernels.square import square
print("numba" in sys.modules)
from numba.core import event
with event.install_recorder("numba:compile") as compilations:
    print(square(5), bool(compilations.buffer))
"""
ROOT = Path(__file__).parents[2]


def _copied(folder: Path) -> None:
    """Put a copy of the decorator, and a room for a kernel, in a folder."""
    shutil.copytree(ROOT / "foundation", folder / "foundation", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "kernels").mkdir()
    (folder / "kernels" / "__init__.py").touch()
    (folder / "kernels" / "square.py").write_text(SQUARE.format(module="kernels.power"))


def _run(folder: Path, program: str, **more: str) -> tuple[str, str]:
    """Run a program in such a folder; return what it says."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env={"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "cache"), **more},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout, done.stderr


def test_code_is_kept_for_its_very_sources_and_setting_while_it_is_whole(tmp_path: Path) -> None:
    # Beside a copy of the decorator's files: numba by itself would go on with the old code.
    _copied(tmp_path)
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))
    assert _run(tmp_path, SQUARED) == ("False\n25 True\n", "")
    (kept,) = (tmp_path / "cache").rglob("*.code")
    whole = kept.read_bytes()
    for damaged in (whole[:-1], b"x" + whole[1:]):
        kept.write_bytes(damaged)
        assert _run(tmp_path, SQUARED) == ("False\n25 True\n", "")
    assert _run(tmp_path, SQUARED) == ("False\n25 False\n", ""), "the next start compiles nothing"
    assert _run(tmp_path, SQUARED, NUMBA_OPT="1") == ("False\n25 True\n", "")
    assert len(list((tmp_path / "cache").rglob("*.code"))) == 1, "made anew, and kept in its place"
    assert _run(tmp_path, SQUARED, NUMBA_CPU_NAME="generic") == ("False\n25 True\n", "")
    assert len(list((tmp_path / "cache").rglob("*.code"))) == 2, "another processor's is kept beside it"
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=3))
    assert _run(tmp_path, SQUARED) == ("False\n125 True\n", ""), "a file that was compiled into it has changed"


PICKLED = """
import copy, pickle
from kernels.square import square
assert pickle.loads(pickle.dumps(square)) is square and copy.deepcopy([square]) == [square]
"""


def test_a_compiled_function_is_pickled_by_its_name(tmp_path: Path) -> None:
    _copied(tmp_path)
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))
    assert _run(tmp_path, PICKLED) == ("", "")


NO_FOLDER = """
import importlib, sys
import numba
from numba.core import caching

class Nowhere:
    @classmethod
    def from_function(cls, function, file):
        return None

caching.CacheImpl._locator_classes = [Nowhere]
try:
    numba.njit(cache=True)(lambda number: number)
except RuntimeError as error:
    assert "cannot cache" in str(error)
else:
    sys.exit("numba still finds a folder for its cache")
for module in sys.argv[1:]:
    importlib.import_module(module)
from foundation.compiled import compiled
assert compiled(double)(21) == 42
"""


def test_every_compiled_function_is_there_where_nothing_can_be_kept(tmp_path: Path) -> None:
    """Numba refuses to make a cached function where neither the package's folder nor the home folder is writable."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("sim", "calibration", "generator")
        for path in sorted((ROOT / package).rglob("*.py"))
        if "foundation.compiled" in path.read_text()
    ]
    assert "sim.world.rendering" in modules
    script = tmp_path / "script.py"
    script.write_text("def double(number):\n    return 2 * number\n" + NO_FOLDER)
    done = subprocess.run(
        [sys.executable, script, *modules],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_only_the_decorator_keeps_machine_code() -> None:
    """`cache=True` anywhere else would fail where there is no folder for it."""
    caching = [
        str(path.relative_to(ROOT))
        for package in ("drivers", "sim", "acquisition", "calibration", "synthesis", "generator", "evaluation")
        for path in (ROOT / package).rglob("*.py")
        if "cache=True" in path.read_text()
    ]
    assert caching == []


ANNOUNCED = """
import pty, os, sys
pid, terminal = pty.fork()
if pid == 0:
    from kernels.square import square
    square(5), square(2.5)
    os._exit(0)
said = b""
while True:
    try:
        said += os.read(terminal, 1000)
    except OSError:
        break
os.waitpid(pid, 0)
print(said.count(b"compiling for this processor"))
"""


def test_the_first_start_says_on_a_terminal_why_it_takes_long(tmp_path: Path) -> None:
    _copied(tmp_path)
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))
    assert _run(tmp_path, ANNOUNCED) == ("1\n", "")
    assert _run(tmp_path, ANNOUNCED) == ("0\n", ""), "nothing is compiled the second time"
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=3))
    # Compiled anew, but into a file that nobody watches.
    assert _run(tmp_path, "from kernels.square import square; print(square(5))") == ("125\n", "")
