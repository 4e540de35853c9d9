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


def test_a_change_in_a_file_that_was_compiled_into_a_function_is_seen(tmp_path: Path) -> None:
    # Beside a copy of the decorator's files: numba by itself would go on with the old code.
    _copied(tmp_path)
    squared = "import sys\nfrom kernels.square import square\nprint(square(5), 'numba' in sys.modules)"
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))
    assert _run(tmp_path, squared) == ("25 True\n", "")
    assert _run(tmp_path, squared) == ("25 False\n", ""), "the second start needs LLVM alone"
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=3))
    assert _run(tmp_path, squared) == ("125 True\n", "")


UNUSED = """
import foundation.compiled
from kernels.square import square
foundation.compiled.keep_code = lambda origin, code: None
found = []
look = foundation.compiled.load_code
foundation.compiled.load_code = lambda origin: found.append(look(origin)) or exit(print(found == [None]))
square(5)
"""


def test_code_that_is_damaged_or_of_another_processor_or_setting_is_made_anew(tmp_path: Path) -> None:
    _copied(tmp_path)
    (tmp_path / "kernels" / "power.py").write_text(POWER.format(exponent=2))
    squared = "import sys\nfrom kernels.square import square\nprint(square(5), 'numba' in sys.modules)"
    assert _run(tmp_path, squared) == ("25 True\n", "")
    (kept,) = (tmp_path / "cache").glob("*.code")
    whole = kept.read_bytes()
    for damaged in (b"", whole[:-1] + b"x", b"[1]\n", whole.replace(b'"triple": "', b'"triple": "x')):
        kept.write_bytes(damaged)
        assert _run(tmp_path, UNUSED) == ("True\n", "")
    assert _run(tmp_path, squared, NUMBA_OPT="1") == ("25 True\n", "")
    assert kept.read_bytes() != whole, "made anew, and kept in its place"


ALL_KINDS = """
import sys
import numpy as np
from foundation.compiled import compiled

@compiled
def first(numbers, whole, part, yes, wide, small, limit):
    total = small + limit
    for row in range(numbers.shape[0]):
        for column in range(numbers.shape[1]):
            total += (row + 1) * numbers[row, column]
    return total, whole + 1, part * 2, not yes, wide

@compiled
def scratch(numbers):
    made = np.zeros(len(numbers), np.int64)
    for place in range(len(numbers)):
        made[place] = numbers[len(numbers) - 1 - place]
    both = np.concatenate((made, numbers)).reshape(-1)
    first = numbers[0]
    for place in range(len(numbers)):
        numbers[place] = both[place]
    return first

@compiled
def nothing(target):
    target[0] = 7

@compiled
def made(length):
    return np.arange(length)

grid = np.arange(12, dtype=np.uint8).reshape(3, 4)
frozen = grid.copy()
frozen.flags.writeable = False
for numbers in (grid, np.asfortranarray(grid), grid[:, ::2], frozen):
    told = first(numbers, -3, 0.5, True, 2**63 + 5, np.int32(-2), np.uint16(2))
    weighted = sum((row + 1) * int(numbers[row].sum()) for row in range(3))
    assert told == (weighted, -2, 1.0, False, 2**63 + 5), told
    assert [type(part) for part in told] == [int, int, float, bool, int]
backwards = np.array([1, 2, 3])
assert scratch(backwards) == 1 and backwards.tolist() == [3, 2, 1]
target = np.zeros(1, np.float32)
assert nothing(target) is None and target[0] == 7
print("numba" in sys.modules)
if "last" in sys.argv:
    assert made(3).tolist() == [0, 1, 2]
try:
    first(1, 2)
except TypeError:
    print("refused")
"""


def test_every_kind_of_argument_gets_through_without_numba(tmp_path: Path) -> None:
    """Layouts, read-only arrays, signs, booleans, tuples, and arrays that the code makes for itself."""
    _copied(tmp_path)
    (tmp_path / "kernels" / "kinds.py").write_text(ALL_KINDS)
    assert _run(tmp_path, "import kernels.kinds") == ("True\nrefused\n", "")
    assert _run(tmp_path, "import kernels.kinds") == ("False\nrefused\n", "")
    # What returns an array is called by numba, in the first start and later.
    for _ in range(2):
        assert _run(tmp_path, "import sys; sys.argv.append('last'); import kernels.kinds")[1] == ""


FAULTS = """
import sys
import numpy as np
from foundation.compiled import compiled, inlined

@inlined
def checked(number):
    if number < 0:
        raise ValueError("below zero")
    return number

@compiled
def root(number):
    return checked(number) ** 0.5

@compiled
def turned(numbers, target):
    flat = numbers.T.copy().T.reshape(numbers.size) if numbers.ndim == 1 else numbers.T.reshape(numbers.size)
    for place in range(flat.size):
        target[place] = flat[place]

target = np.zeros(6)
grid = np.arange(6.0).reshape(2, 3)
if "turned" in sys.argv:
    try:
        turned(grid, target)
    except (MemoryError, NotImplementedError) as error:
        print("refused")
    turned(np.asfortranarray(grid), target)
    print(target.tolist(), "numba" in sys.modules)
else:
    print(root(4))
    try:
        root(-4)
    except ValueError as error:
        print(error)
"""


def test_what_code_raises_is_raised_and_no_order_is_taken_for_another(tmp_path: Path) -> None:
    _copied(tmp_path)
    (tmp_path / "kernels" / "faults.py").write_text(FAULTS)
    turned = "import sys; sys.argv.append('turned'); import kernels.faults"
    for numba in (True, False):
        assert _run(tmp_path, "import kernels.faults") == ("2.0\nbelow zero\n", "")
        told = f"refused\n[0.0, 3.0, 1.0, 4.0, 2.0, 5.0] {numba}\n"
        assert _run(tmp_path, turned) == (told, "")


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


def test_linear_algebra_is_loaded_by_whoever_compiles_a_product_of_matrices() -> None:
    """And not by the first function that is called: loading it takes longer than a small picture."""
    code = (
        "import sys, numpy as np\n"
        "from foundation.machine_code.translating import numba as prepared\n"
        "numba = prepared()\n"
        "double = numba.njit(lambda x: 2 * x)\n"
        "assert double(2) == 4\n"
        "print('scipy.linalg' in sys.modules)\n"
        "product = numba.njit(lambda a, b: a @ b)\n"
        "print(product(np.eye(2), np.full((2, 2), 3.0)).sum(), 'scipy.linalg' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "12.0", "True"]
