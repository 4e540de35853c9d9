"""The notebooks run from the first to the last cell, and their results are right."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parents[2] / "examples"


def executed(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, **changed: str) -> dict[str, Any]:
    """Return the variables of a notebook after all its cells ran in a folder; `changed` texts make it shorter."""
    import matplotlib as mpl

    monkeypatch.chdir(folder)
    mpl.use("agg")
    notebook = json.loads((EXAMPLES / name).read_text())
    assert notebook["nbformat"] == 4
    variables: dict[str, Any] = {"__name__": "__main__"}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [], "notebooks are stored without results"
            code = "".join(cell["source"])
            for old, new in changed.items():
                code = code.replace(f"{old} = ", f"{old} = {new}  # ")
            exec(compile(code, f"{name}, {cell['id']}", "exec"), variables)
    return variables


@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_picture_under_lights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib.pyplot as plt

    made = executed("picture_under_lights.ipynb", tmp_path, monkeypatch)
    assert len(plt.get_fignums()) == 3
    plt.close("all")
    # The mixture of two lights is their weighted sum of whites, as light adds.
    white = made["lut"].white
    np.testing.assert_allclose(made["whites"][2], (white[0] + white[6]) / 2)
    assert made["weights"].sum(axis=2) == pytest.approx(1, abs=1e-6)
    # The ground truths of the pixels are between those of both illuminants, so their mean is the truth of the image.
    assert made["truth_map"].mean(axis=(0, 1)) == pytest.approx(np.array(made["entry"].truth), abs=0.02)


def test_own_learner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    made = executed("own_learner.ipynb", tmp_path, monkeypatch)
    assert made["last"] < 0.5 * made["first"]
    with (tmp_path / "results" / "results.csv").open(newline="") as stream:
        rows = list(csv.reader(stream))
    assert any("My network" in row for row in rows)
    scenes = made["open_scenes"](tmp_path / "SimpleCube++").scenes
    truths = sorted(tuple(np.round(scene.truth / scene.truth.sum(), 6)) for scene in scenes)
    assert truths == sorted(tuple(np.round(made["lut"].ground_truth[light], 6)) for light in (1, 5) for _ in range(2))
