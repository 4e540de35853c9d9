"""User files with the name of one of our packages."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run code as a program in a folder that precedes all others in the search path."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    program = [sys.executable, "-c", code]
    return subprocess.run(program, capture_output=True, text=True, check=False, env=environment, cwd=folder)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", ["generator", "evaluation", "foundation"])
def test_names_a_file_that_hides_a_package(tmp_path: Path, hidden: str) -> None:
    (tmp_path / f"{hidden}.py").write_text("x = 1\n")
    result = run("import croplab; croplab.open_lut", tmp_path)
    assert f"{tmp_path / hidden}.py hides the package {hidden} of CroP" in result.stderr.splitlines()[-1]
    result = run("import croplab, sys; sys.argv = ['generate', '--help']; sys.exit(croplab.generate())", tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith(f"error: {tmp_path / hidden}.py hides the package {hidden}")


@pytest.mark.slow
def test_croplab_exports_the_public_names_lazily(tmp_path: Path) -> None:
    code = """
import sys, croplab
assert not {"numpy", "typer", "generator"} & sys.modules.keys()
assert croplab.open_lut is __import__("generator").open_lut
for name in croplab.__all__:
    assert callable(getattr(croplab, name)), name
assert dir(croplab) == sorted(croplab.__all__)
try:
    croplab.nothing
except AttributeError:
    print("done")
"""
    result = run(code, tmp_path)
    assert result.stdout == "done\n", result.stderr


@pytest.mark.slow
def test_loads_a_method_next_to_such_a_file(tmp_path: Path) -> None:
    (tmp_path / "generator.py").write_text("raise SystemExit('hidden')\n")
    method = tmp_path / "mine.py"
    lines = (
        "class Mine:",
        "    name = 'mine'",
        "    def estimate(self, image, saturation, mask=None):",
        "        return (1, 1, 1)",
    )
    method.write_text("\n".join(lines))
    code = f"""
from evaluation.methods.naming import find_method
print(find_method({str(method)!r} + ":Mine").name)
import generator
print(generator.open_lut.__module__)
"""
    (tmp_path / "elsewhere").mkdir()
    result = run(code, tmp_path / "elsewhere")
    assert result.stdout.splitlines() == ["mine", "generator"], result.stderr
