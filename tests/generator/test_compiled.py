"""Machine code on disk is used again for the code it was made from only."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SQUARE = """
from numba import uint32
from generator.kernels.compiled import compiled
from {module} import (
    power,
)

@compiled
def square(number: int) -> int:
    return power(number)
"""
POWER = "import numba\n\n@numba.njit(inline='always')\ndef power(number):\n    return number ** {exponent}\n"


def test_a_change_in_a_file_that_was_compiled_into_a_function_is_seen(tmp_path: Path) -> None:
    # A package of the generator's own kind, in a copy of its files: numba by itself would go on with the old code.
    root = Path(__file__).parents[2]
    kernels = tmp_path / "generator" / "kernels"
    kernels.mkdir(parents=True)
    for name in ("__init__.py", "kernels/__init__.py", "kernels/compiled.py"):
        (tmp_path / "generator" / name).write_bytes((root / "generator" / name).read_bytes())
    (tmp_path / "generator" / "square.py").write_text(SQUARE.format(module="generator.kernels.power"))

    def squared() -> str:
        done = subprocess.run(
            [sys.executable, "-c", "from generator.square import square; print(square(5), square.stats.cache_hits)"],
            cwd=tmp_path,
            env={"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout or done.stderr

    (kernels / "power.py").write_text(POWER.format(exponent=2))
    assert squared() == "25 Counter()\n"
    assert "25 Counter({" in squared()
    (kernels / "power.py").write_text(POWER.format(exponent=3))
    assert squared() == "125 Counter()\n"
