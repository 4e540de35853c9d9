"""Bits set to zero in tone-mapped codes, and what methods then make of the images.

Flash and its inverse in files: what methods make of the files is what the experiment makes of images in memory.

The picture with bits set to zero.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.cli import main
from evaluation.datasets import open_scenes
from evaluation.experiments.paper.colour_reduction import (
    bits_methods,
    bits_removed,
    clear_bits,
    read_table,
    reduce_colours,
    reduction_table,
)
from evaluation.experiments.running import evaluate
from evaluation.methods.standard import standard_methods
from evaluation.scene import SceneSet
from foundation.errors import InputError
from generator.files import Flash, fit_flash
from tests.evaluation.made_scenes import Made

pytestmark = pytest.mark.slow


def photo(seed: int, side: int = 40) -> npt.NDArray[np.float64]:
    """Return smooth colours under a light, with a range of brightness as photographs have."""
    rng = np.random.default_rng(seed)
    grid = np.linspace(0, 3, side)
    waves = [np.sin(np.add.outer(a * grid, b * grid)) for a, b in rng.uniform(-2, 2, (3, 2))]
    return np.exp(np.stack(waves, axis=-1) * rng.uniform(0.5, 2)) * [0.4, 1.0, 0.6]


@given(code=st.integers(0, 255), bits=st.integers(0, 8))
def test_cleared_codes_are_whole_steps_below(code: int, bits: int) -> None:
    (cleared,) = clear_bits(np.array([code], np.uint8), bits)
    assert cleared == code // 2**bits * 2**bits


@pytest.mark.parametrize("bits", [-1, 9])
def test_a_code_has_eight_bits(bits: int) -> None:
    with pytest.raises(InputError, match=f"{bits} bits"):
        clear_bits(np.zeros(1, np.uint8), bits)


@given(seed=st.integers(0, 2**32), scale=st.floats(1e-3, 1e5))
def test_the_operator_is_undone_to_rounding(seed: int, scale: float) -> None:
    image = photo(seed, 12)
    image /= image.max()
    operator = fit_flash(image)
    np.testing.assert_allclose(operator.invert(operator.apply(image)), image, rtol=1e-9)
    # The unit does not matter: images are taken relative to their largest value.
    for ours, other in zip(reduce_colours(image, (0, 3)), reduce_colours(image * scale, (0, 3)), strict=True):
        np.testing.assert_allclose(ours, other, atol=0.02)
        assert (np.abs(ours - other) > 1e-6).mean() < 0.01


@given(seed=st.integers(0, 2**32))
def test_no_bit_is_unchanged_within_quantisation(seed: int) -> None:
    image = photo(seed, 12)
    image /= image.max()
    operator = fit_flash(image)
    codes = operator.apply(image)
    (restored,) = reduce_colours(image, 0)
    # Half a code away in every channel at most: between what the codes just below and above stand for.
    again = operator.apply(restored.astype(np.float64))
    assert np.abs(again - codes).max() <= 0.51


def test_a_masked_pixel_has_no_say() -> None:
    image, mask = photo(2), np.zeros((40, 40), np.bool_)
    mask[:5] = True
    dark, bright = image.copy(), image.copy()
    dark[mask], bright[mask] = 0, 1e6
    for one, other in zip(reduce_colours(dark, (0, 4), mask), reduce_colours(bright, (0, 4), mask), strict=True):
        np.testing.assert_array_equal(one[~mask], other[~mask])
    (without,) = reduce_colours(dark, 4)
    (with_mask,) = reduce_colours(dark, 4, mask)
    assert np.abs(without[~mask] - with_mask[~mask]).max() > 1e-3


def test_a_black_image_stays_black() -> None:
    assert all(not reduced.any() for reduced in reduce_colours(np.zeros((4, 4, 3)), (0, 7)))


def test_images_as_they_are_give_what_evaluate_gives() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[:, :8] = True
    light = np.array([0.4, 1.0, 0.6])
    scenes = [Made("photo", light, photo(seed), 3.0, mask if seed % 2 else None) for seed in range(4)]
    assert any((scene.image >= 3.0).any() for scene in scenes)
    methods = bits_methods(sigma=2)
    found = bits_removed(scenes, methods, (0, 3), workers=2)
    for ours, usual in zip(found.raw, evaluate(scenes, methods), strict=True):
        np.testing.assert_array_equal(ours.estimates, usual.estimates)
        for kind in ("recovery", "reproduction"):
            np.testing.assert_array_equal(ours.errors[kind], usual.errors[kind])
    # Rounded to codes the images are nearly the same, with bits at zero they are not.
    for raw, exact, coarse in zip(found.raw, found.reduced[0], found.reduced[3], strict=True):
        near = np.abs(exact.errors["recovery"] - raw.errors["recovery"]).max()
        assert near < 0.15
        assert np.abs(coarse.errors["recovery"] - raw.errors["recovery"]).max() > near


def test_the_usual_scale_is_the_standard_method() -> None:
    assert bits_methods()[2] is not None
    assert bits_methods()[2].name == standard_methods()["gray-edge-1"].name


def test_nothing_to_do() -> None:
    with pytest.raises(InputError, match="0 images"):
        bits_removed([], bits_methods())


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


def test_codes_are_as_written_and_may_be_changed(
    data: SceneSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    assert "4/4 images" in capsys.readouterr().err.splitlines()[-1]
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


def test_numbers_of_the_operator_are_above_0_and_may_be_below_1(data: SceneSet, tmp_path: Path) -> None:
    codes = tmp_path / "codes"
    assert main(["paper", "flash", data.place, "--out", str(codes)]) == 0
    for column in ("k", "scale", "gamma", "largest"):
        _set(codes, column, "0.5")
    (first, *_) = read_table(codes)
    assert (first.operator, first.largest) == (Flash(0.5, 0.5, 0.5), 0.5)


def _set(folder: Path, column: str, value: str) -> None:
    with (folder / "flash.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    rows[0][column] = value
    with (folder / "flash.csv").open("w") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def test_what_is_left() -> None:
    wedge = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)
    table = reduction_table(wedge)
    assert [row[1] for row in table.rows] == [256**3 // 8**bits for bits in range(8)]
    assert [row[2] for row in table.rows] == [256 >> bits for bits in range(8)]
    assert table.rows[0][3] is None
    # The mean of 0, 1, 4 … 49.
    assert table.rows[3][3] == pytest.approx(10 * np.log10(255**2 / 17.5))
