"""Machine code on disk is used again for the code it was made from only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SQUARE = """
from numba import uint32
from foundation.compiled import compiled
from {module} import (
    power,
)

@compiled
def square(number: int) -> int:
    return power(number)
"""
POWER = "import numba\n\n@numba.njit(inline='always')\ndef power(number):\n    return number ** {exponent}\n"


def test_a_change_in_a_file_that_was_compiled_into_a_function_is_seen(tmp_path: Path) -> None:
    # Beside a copy of the decorator's file: numba by itself would go on with the old code.
    root = Path(__file__).parents[2]
    for folder in (tmp_path / "foundation", tmp_path / "kernels"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    (tmp_path / "foundation" / "compiled.py").write_bytes((root / "foundation" / "compiled.py").read_bytes())
    (tmp_path / "kernels" / "square.py").write_text(SQUARE.format(module="kernels.power"))

    def squared() -> str:
        done = subprocess.run(
            [sys.executable, "-c", "from kernels.square import square; print(square(5), square.stats.cache_hits)"],
            cwd=tmp_path,
            env={"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout or done.stderr

    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))
    assert squared() == "25 Counter()\n"
    assert "25 Counter({" in squared()
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=3))
    assert squared() == "125 Counter()\n"


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
ROOT = Path(__file__).parents[2]


def test_every_compiled_function_is_there_where_nothing_can_be_kept(tmp_path: Path) -> None:
    """Numba refuses to make a cached function where neither the package's folder nor the home folder is writable."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("sim", "calibration", "generator")
        for path in sorted((ROOT / package).rglob("*.py"))
        if "njit" in path.read_text() or "foundation.compiled" in path.read_text()
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
    root = Path(__file__).parents[2]
    for folder in (tmp_path / "foundation", tmp_path / "kernels"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    (tmp_path / "foundation" / "compiled.py").write_bytes((root / "foundation" / "compiled.py").read_bytes())
    (tmp_path / "kernels" / "square.py").write_text(SQUARE.format(module="kernels.power"))
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))

    def said(program: str) -> tuple[str, str]:
        done = subprocess.run(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            env={"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout, done.stderr

    assert said(ANNOUNCED) == ("1\n", "")
    assert said(ANNOUNCED) == ("0\n", ""), "nothing is compiled the second time"
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=3))
    # Compiled anew, but into a file that nobody watches.
    assert said("from kernels.square import square; print(square(5))") == ("125\n", "")


def test_linear_algebra_is_loaded_by_whoever_compiles_a_product_of_matrices() -> None:
    """And not by the first function that is called: loading it takes longer than a small picture."""
    code = (
        "import sys, numba, numpy as np, foundation.compiled\n"
        "double = numba.njit(lambda x: 2 * x)\n"
        "assert double(2) == 4\n"
        "print('scipy.linalg' in sys.modules)\n"
        "product = numba.njit(lambda a, b: a @ b)\n"
        "print(product(np.eye(2), np.full((2, 2), 3.0)).sum(), 'scipy.linalg' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "12.0", "True"]
