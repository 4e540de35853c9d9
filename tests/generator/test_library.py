"""The examples of the documentation do what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.mark.usefixtures("table_and_picture")
def test_the_lines_of_the_page_for_programmers() -> None:
    blocks = re.findall(r"(?:^    .*\n)+", (ROOT / "docs" / "library.md").read_text(), re.MULTILINE)
    assert len(blocks) == 3
    assert len(blocks[0].splitlines()) == 3
    names: dict[str, Any] = {}
    for block in blocks:
        exec(textwrap.dedent(block), names)
    raw, lut = names["raw"], names["lut"]
    assert (raw.dtype, raw.shape) == (np.uint16, (40, 50, 3))
    by_codes = names["render"](lut, names["read_picture"]("cat.png"), light=3, rendering="codes", seed=1)
    assert {tuple(one) for one in by_codes.reshape(-1, 3)} <= {tuple(row) for row in lut.samples[3].reshape(-1, 3)}
    assert sum(names["truth"]) == pytest.approx(1)
    assert names["balanced"].max() == 1
    assert names["image"].shape == (40, 50, 3)
    assert names["made"].description.images == 2
    assert names["entry"].truth == pytest.approx(tuple(lut.ground_truth[3]), abs=1e-9)


@pytest.mark.usefixtures("table_and_picture")
def test_the_array_of_jobs() -> None:
    script = ROOT / "examples" / "slurm" / "generate.sbatch"
    job = {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "1", "SLURM_CPUS_PER_TASK": "1"}
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", script, "lut", "out", "--sources", "cat.png"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **job, "PATH": path},
    )
    assert done.returncode == 0, done.stderr
    assert "1 of 1 shards of out are done; make a dataset of them with generate --finish out" in done.stdout
