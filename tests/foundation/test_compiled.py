"""Machine code on disk is used again for the code it was made from only."""

from __future__ import annotations

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
