"""`evaluate paper`: each command from end to end on small look-up tables and data sets."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evaluation.cli import main
from generator import DatasetOptions, find_pictures, generate_dataset
from generator.lights.lighting import RandomLights
from generator.pictures.random_scenes import random_scenes
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker, make_table

pytestmark = pytest.mark.slow

__all__ = ["make_table"]


@pytest.fixture
def thumbnails(tmp_path: Path) -> Path:
    """Return an archive of 9 thumbnails of smooth colours under different illuminants."""
    rng = np.random.default_rng(0)
    lights = np.array([0.5, 1.0, 0.6]) * rng.uniform(0.8, 1.25, (9, 3))
    ramps = np.exp(rng.uniform(-2, 2, (9, 3, 3, 3))).repeat(10, axis=1).repeat(10, axis=2)
    path = tmp_path / "photos.npz"
    images = (ramps * lights[:, None, None]).astype(np.float32)
    np.savez(path, images=images, gt=lights, names=np.array([f"p{number}" for number in range(9)]))
    return path


@pytest.fixture
def truths(tmp_path: Path) -> Path:
    """Return a file with the ground truths of two cameras."""
    path = tmp_path / "truths.csv"
    rows = [f"{name},{r},{g},{b}" for name, (r, g, b) in zip(("A/1", "A/2", "B/1", "B/2"), LIGHTS, strict=True)]
    path.write_text("\n".join(["File,GT_R,GT_G,GT_B", *rows]))
    return path


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


def test_refuses_matrix_for_photographs(
    make_table: TableMaker, truths: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pictures").mkdir()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "pictures" / "black.png")
    lut = str(make_table("Test").folder)
    options = ("--pictures", str(tmp_path / "pictures"), "--lights-like", str(truths), "--side", "16")
    assert main(["paper", "table1", lut, *options, "--matrix", "Canon EOS 550D"]) == 2
    assert "needs a data set of raw images" in capsys.readouterr().err


def test_table2(make_table: TableMaker, thumbnails: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generated_set, out = tmp_path / "made", tmp_path / "out"
    scenes = random_scenes(12, 30, 30)
    options = DatasetOptions(previews=False)
    generate_dataset(make_table("Test"), generated_set, scenes, RandomLights(1, len(LIGHTS), 0), options=options)
    arguments = ("--generated", str(generated_set), "--method", "smart-color-cat", "--out", str(out))
    assert main(["paper", "table2", str(thumbnails), *arguments]) == 0
    printed = capsys.readouterr().out
    assert "The published errors are for Cube+" in printed
    real, generated = (rows_of(out / f"trained_on_{name}.csv") for name in ("real", "generated"))
    (ratio,) = rows_of(out / "ratios.csv")
    assert float(ratio["Ratio"]) == pytest.approx(float(generated[0]["Med."]) / float(real[0]["Med."]))
    assert float(ratio["In the paper, on Cube+"]) == pytest.approx(1.43 / 1.35)
    assert main(["paper", "table2", str(thumbnails), "--generated", str(generated_set), "--method", "magic"]) == 2
    assert "'magic' is not a learned method" in capsys.readouterr().err
    copy = thumbnails.with_name("copy.npz")
    copy.write_bytes(thumbnails.read_bytes())
    assert main(["paper", "table2", str(thumbnails), "--generated", str(copy)]) == 2
    assert "9 of 9 images of copy are also in photos" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("unseen", "message"),
    [((), "They were kept, because generated images of the paper"), (("--unseen",), "Generated: made, 4 images")],
)
def test_table2_excludes_test_pictures_only_with_unseen(
    make_table: TableMaker,
    thumbnails: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    unseen: tuple[str, ...],
    message: str,
) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    rng = np.random.default_rng(1)
    for name in ("p0", "p3", "q1", "q2"):
        Image.fromarray(rng.integers(0, 256, (30, 30, 3), np.uint8)).save(pictures / f"{name}.png")
    options = DatasetOptions(previews=False)
    lights = RandomLights(2, len(LIGHTS), 0)
    generate_dataset(make_table("Test"), tmp_path / "made", find_pictures(str(pictures)), lights, options=options)
    arguments = ("--generated", str(tmp_path / "made"), "--method", "constant-light", *unseen)
    assert main(["paper", "table2", str(thumbnails), *arguments]) == 0
    printed = capsys.readouterr()
    assert message in printed.out
    assert "4 of 8 images of made are also in photos, by name: p0.png" in printed.out + printed.err


def test_keeps_results_if_output_is_closed(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((20, 30, 3), dtype=np.uint8)).save(tmp_path / "noise.png")
    reader, writer = os.pipe()
    os.close(reader)
    call = [sys.executable, "-m", "evaluation.cli", "paper", "reduction", "noise.png", "--out", "out"]
    process = subprocess.run(call, cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (process.returncode, (tmp_path / "out" / "report.html").is_file()) == (0, True), process.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("chromaticities", "nowhere"), "nowhere is not a LUT"),
        *(
            (("table1", "nowhere", "--pictures", ".", "--lights-like", "x.csv", option, given), message)
            for option, given, message in (
                ("--sizes", "12,big", "side 'big' of an image"),
                ("--sizes", "1,65535", "nowhere is not a LUT"),
            )
        ),
        (("bits", "nowhere.npz", "--out", "taken"), "taken already exists"),
    ],
)
def test_refuses_with_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").mkdir()
    Path("taken", "file").touch()
    assert main(["paper", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
