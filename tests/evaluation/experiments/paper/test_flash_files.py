"""Flash and its inverse in files: what methods make of the files is what the experiment makes of images in memory."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from evaluation.cli import main
from evaluation.datasets import open_scenes
from evaluation.experiments.paper.colour_reduction import bits_methods, bits_removed, reduce_colours
from evaluation.experiments.running import evaluate
from evaluation.scene import SceneSet

WHITE = 1000


@pytest.fixture
def data(tmp_path: Path) -> SceneSet:
    """Return four linear images of 16 bits, one of them with a mask and one with clipped pixels, in a folder."""
    folder = tmp_path / "photos"
    (folder / "b").mkdir(parents=True)
    rng = np.random.default_rng(1)
    rows = ["image,r,g,b,saturation"]
    for number, name in enumerate(("one", "two", "b/three", "four")):
        ramps = np.exp(rng.uniform(-2, 1, (4, 5, 3))).repeat(8, axis=0).repeat(8, axis=1)
        image = np.minimum(ramps * [120, 300, 180] * rng.uniform(0.6, 1.4), WHITE if number == 1 else WHITE - 1)
        cv2.imwrite(str(folder / f"{name}.png"), image.astype(np.uint16)[..., ::-1])
        rows.append(f"{name}.png,{0.2 + number / 20},0.5,0.3,{WHITE}")
    mask = np.zeros((32, 40), np.uint8)
    mask[:16, :20] = 255
    cv2.imwrite(str(folder / "four_mask.png"), mask)
    (folder / "gt.csv").write_text("\n".join(rows))
    return open_scenes(str(folder))


@pytest.mark.parametrize("cleared", [0, 3, 5])
def test_files_say_what_the_experiment_says(data: SceneSet, tmp_path: Path, cleared: int) -> None:
    codes, linear = tmp_path / "codes", tmp_path / "linear"
    assert main(["paper", "flash", data.place, "--out", str(codes), "--clear", str(cleared)]) == 0
    assert main(["paper", "flash-inverse", str(codes), "--out", str(linear)]) == 0
    again = open_scenes(str(linear))
    for scene, made in zip(data.scenes, again.scenes, strict=True):
        image, mask = scene.read()
        seen = image.reshape(-1, 3) if mask is None else image[~mask]
        (expected,) = reduce_colours(image, [cleared], mask)
        np.testing.assert_allclose(made.read()[0], expected * float(seen.max()), rtol=1e-5)
        np.testing.assert_allclose(made.truth, scene.truth / scene.truth.sum(), rtol=1e-12)
    methods = bits_methods(1.0)
    whole = bits_removed(data.scenes, methods, (cleared,)).reduced[cleared]
    for method, expected_result in zip(evaluate(again.scenes, methods), whole, strict=True):
        np.testing.assert_allclose(
            method.summary("recovery").as_tuple(), expected_result.summary("recovery").as_tuple(), atol=1e-3
        )


def test_codes_are_as_written_and_may_be_changed(data: SceneSet, tmp_path: Path) -> None:
    codes = tmp_path / "codes"
    assert main(["paper", "flash", data.place, "--out", str(codes), "--clear", "4"]) == 0
    written = cv2.imread(str(codes / "codes/b/three.png"), cv2.IMREAD_UNCHANGED)
    assert written is not None
    assert written.dtype == np.uint8
    assert set(np.unique(written).tolist()) <= set(range(0, 256, 16))
    # A flat picture in its place, as JPEG: a grey wall, whose light every method names.
    (codes / "codes/one.png").unlink()
    cv2.imwrite(str(codes / "codes/one.jpg"), np.full((32, 40, 3), 128, np.uint8))
    assert main(["paper", "flash-inverse", str(codes), "--out", str(tmp_path / "linear")]) == 0
    image, _ = open_scenes(str(tmp_path / "linear")).scenes[0].read()
    assert np.ptp(image) < 1e-4 * image.max()


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no table": (lambda folder: (folder / "flash.csv").unlink(), "cannot read"),
    "no codes": (lambda folder: (folder / "codes/one.png").unlink(), "one.png is missing; restore it"),
    "no picture": (lambda folder: (folder / "codes/one.png").write_bytes(b"?"), "holds nothing that can be read"),
    "elsewhere": (lambda folder: _set(folder, "codes", "../one.png"), "is no name below codes/"),
    "k": (lambda folder: _set(folder, "k", "0"), "line 2: k, scale and gamma are to be above 0"),
    "scale": (lambda folder: _set(folder, "scale", "nan"), "line 2: k, scale and gamma are to be above 0"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_told(data: SceneSet, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str) -> None:
    codes, (change, told) = tmp_path / "codes", DAMAGES[damage]
    assert main(["paper", "flash", data.place, "--out", str(codes)]) == 0
    change(codes)
    assert main(["paper", "flash-inverse", str(codes), "--out", str(tmp_path / "linear")]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "linear").exists()


def _set(folder: Path, column: str, value: str) -> None:
    with (folder / "flash.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    rows[0][column] = value
    with (folder / "flash.csv").open("w") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
