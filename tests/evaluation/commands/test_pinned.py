"""Pinned numbers that the commands print and write for small data sets."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from evaluation.cli import main
from tests.evaluation.datasets.made_up import COPIES
from tests.evaluation.experiments.transfer.conftest import Maker, save_pictures, write_table
from tests.evaluation.learning.made_up_world import save_world
from tests.evaluation.shown import contents, recorded_figures
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made_place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a generated set, its pictures and LUT, two sets of thumbnails, and copies of layouts."""
    folder = tmp_path_factory.mktemp("place")
    save_pictures(folder / "pictures", [f"{number}.png" for number in range(6)])
    Maker(folder, write_table(folder / "lut")).make()
    save_world(folder / "world.npz", 14, 0, size=24)
    save_world(folder / "other.npz", 9, 5, size=24)
    for layout in ("lsmi", "folder", "nus8"):
        COPIES[layout].make(folder / layout)
    return folder


SEQUENCES: dict[str, tuple[str, ...]] = {
    "run": (
        "run world.npz --method standard --out out --workers 1 --json",
        "run lsmi --method gray-world,gray-world-by-patches,grayness-index-local --read saturation=20000 --out mixed "
        "--workers 1",
        "run world.npz --method all --error recovery --workers 1",
        # Not all: pixels of its images are alike but for one, so that rounding chooses the gray pixels among them.
        "run folder --method standard --read saturation=20000 --workers 1",
        "run made --method gray-edge-2@12 --method shades-of-gray:p=3 --workers 1 --json",
        "run nus8 --read camera=SonyA57 --read black=100 --read saturation=5000 --method white-patch --json",
    ),
    "cv": (
        "cv kernel-ridge,smart-color-cat world.npz --out out --workers 1 --json",
        "cv constant-light made --folds 2 --seed 3 --error recovery --workers 1",
        "cv kernel-ridge world.npz --folds out/folds.csv --workers 1",
    ),
    "train": (
        "train kernel-ridge world.npz --out a.npz --workers 1",
        "train kernel-ridge other.npz --adapt a.npz --seed 2 --out b.npz --workers 1",
        "run other.npz --method a.npz --method b.npz --workers 1 --json",
        "run world.npz --method a.npz --workers 1",
    ),
    "tune": (
        "tune shades-of-gray world.npz --workers 1 --json",
        "tune gray-edge-1@24 made --errors recovery --workers 1",
    ),
    "compare": (
        "run world.npz --method standard --out one --workers 1",
        "run world.npz --method gray-world --method pca --read saturation=0.3 --out two --workers 1",
        "compare one --method pca --method gray-world --out cmp --json",
        "compare one two --error recovery",
        "compare one two --method gray-world=pca",
        "compare one --method white-patch --method pca --method gray-world --method gray-edge-1",
    ),
    "transfer": (
        "transfer world.npz made --method kernel-ridge,gray-world --naive pictures --real 3,all --seeds 2 --out one "
        "--error recovery --workers 1",
    ),
    "paper": (
        "paper table1 lut --pictures pictures --lights-like world.npz --side 16 --sizes 8,24 --out t1 --workers 1",
        "paper table1 lut --pictures other.npz --matrix Canon\\ EOS\\ 550D --lights-like other.npz --side 8 --seed 2 "
        "--error recovery --workers 1",
        "paper table2 world.npz --generated made --method smart-color-cat --out t2 --workers 1 --json",
        "paper bits other.npz --sigma 1.5 --out bits --workers 1 --json",
        "paper reduction pictures/0.png --out reduction --json",
        "paper chromaticities lut --truths world.npz --out lights --json",
        "paper chromaticities lut",
    ),
}
"""Commands that are run one after another."""


@pytest.mark.parametrize("name", SEQUENCES)
def test_commands(
    name: str, work_folder: Path, pinned: Pinned, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = recorded_figures(monkeypatch)
    before = set(work_folder.rglob("*"))
    told: dict[str, Any] = {}
    for command in SEQUENCES[name]:
        drawn = len(figures)
        assert main(shlex.split(command)) == 0, command
        out = capsys.readouterr().out
        if "--out two" in command:
            del figures[drawn:]
        if command.endswith("--json"):
            told[str(len(told) + 1)] = json.loads(out)
    new = [path for path in sorted(work_folder.rglob("*")) if path not in before and path.is_file()]
    # Tables are printed as well, pages are those of runs, and what is compared shows in what is made of it.
    new = [path for path in new if path.suffix != ".tex"]
    if name in ("cv", "transfer"):
        new = [path for path in new if path.parent.name != "two"]
    if name in ("compare", "transfer"):
        new = [path for path in new if path.parent.name not in ("one", "two") or path.suffix == ".json"]
    files = {path.relative_to(work_folder).as_posix(): contents(path) for path in new}
    pinned(f"commands, {name}", {"told": told, "files": files, "figures": figures}, nothing=1e-7)
