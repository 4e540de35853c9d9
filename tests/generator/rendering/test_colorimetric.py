"""From a table to the mixtures of cells for an image: lights, matrices, and what is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from foundation.colorimetry import angles_deg
from foundation.errors import InputError, QualityError
from generator.lights.lighting import Lighting, Mixture, plain
from generator.masks.making import parse_masks
from generator.rendering.cell_mixtures import CellMixtures, mix_cells
from generator.rendering.colorimetric import (
    BLACK_WITHIN_DEG,
    NODES,
    ColorimetricRendering,
    black_point,
    colorimetric_mixtures,
    wanted_colours,
)
from generator.rendering.matrices import ColourMatrix, fitted_matrix, matrix_for
from generator.rendering.print_profiles import PrintProfile, profile_of
from tests.generator.rendering.conftest import MakeTable
from tests.generator.rendering.prints import MATRIX

pytestmark = pytest.mark.slow

GREYS = np.arange(32) * 1057
"""Nodes of equal codes of red, green and blue."""


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "croplab"


def test_greys_of_a_source_are_of_the_light(make_table: MakeTable) -> None:
    lut = make_table(bits=4, tint=0.15)
    samples = lut.samples[1].astype(np.float64)
    own = samples[np.arange(16) * 273].mean(axis=1)
    assert angles_deg(own, lut.white[1]).max() > 4
    mixtures = colorimetric_mixtures(lut, 1)
    assert mixtures.cells.shape == (NODES, 16)
    shown = samples[mixtures.cells[GREYS]].mean(axis=(1, 2))
    assert angles_deg(shown, lut.white[1]).max() < 0.5


def test_a_warm_light_has_cells_of_its_own(make_table: MakeTable) -> None:
    lut = make_table(bits=4, blue_of_green=0.5)
    matrix = ColourMatrix("mine", MATRIX, "")
    own, daylight = (colorimetric_mixtures(lut, light, matrix) for light in (0, 1))
    seen = profile_of(lut, 0).colours
    # What all of these want is well within what the print can show in daylight.
    pale = np.flatnonzero((angles_deg(own.wanted, np.ones(3)) < 15) & (own.wanted.mean(axis=1) > 0.2))

    def kept(mixtures: CellMixtures) -> float:
        shown = seen[mixtures.cells[pale]].mean(axis=1)
        x, y = (np.log(colours[:, 2] / colours[:, 1]) for colours in (own.wanted[pale], shown))
        return float(np.polyfit(x, y, 1)[0])

    # Half of green in blue leaves half of the chroma, but for cells that are bluer.
    assert kept(daylight) < 0.65
    assert kept(own) > 0.8


def test_black_is_as_dark_as_it_can_be_grey(make_table: MakeTable) -> None:
    profile = profile_of(make_table(bits=4), 1)
    assert black_point(profile) == pytest.approx(profile.black, rel=0.1)
    tinted = PrintProfile(profile.colours * np.array([1.1, 1.0, 0.9]), profile.usable)
    darker = tinted.colours[tinted.colours.mean(axis=1) < tinted.black]
    assert angles_deg(darker, np.ones(3)).min() > BLACK_WITHIN_DEG
    lifted = wanted_colours(tinted, ColourMatrix("mine", MATRIX, ""))[0]
    assert mix_cells(tinted, lifted[None]).distance[0] <= BLACK_WITHIN_DEG


def test_a_second_run_takes_what_the_first_kept(
    make_table: MakeTable, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = ColourMatrix("mine", MATRIX, "")
    first = colorimetric_mixtures(make_table(bits=1), 0, matrix)
    (path,) = cache.iterdir()
    content = path.read_bytes()
    # The same table at another place is the same table; another light, matrix or table is not.
    again = colorimetric_mixtures(make_table(bits=1, name="copy"), 0, matrix)
    np.testing.assert_array_equal(first.cells, again.cells)
    assert [file.name for file in cache.iterdir()] == [path.name]
    assert path.read_bytes() == content
    colorimetric_mixtures(make_table(bits=1, name="other"), 1, matrix)
    colorimetric_mixtures(make_table(bits=1, name="third"), 0, ColourMatrix("none", np.eye(3), ""))
    colorimetric_mixtures(make_table(bits=1, tint=0.1, name="fourth"), 0, matrix)
    assert len(list(cache.iterdir())) == 4
    # Nor is what other libraries have computed.
    monkeypatch.setattr("generator.rendering.colorimetric.version", "{} 0".format)
    colorimetric_mixtures(make_table(bits=1, name="fifth"), 0, matrix)
    assert len(list(cache.iterdir())) == 5


def test_a_mixture_of_lights_is_kept_when_it_comes_again(
    make_table: MakeTable, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures go through a list of lights time and again; of lights drawn at random each comes once."""
    lut, matrix = make_table(bits=1), ColourMatrix("mine", MATRIX, "")
    # More than are in memory.
    mixtures = [Mixture((0, 2), (part / 32, 1 - part / 32)) for part in range(1, 20)]
    first = [colorimetric_mixtures(lut, mixture, matrix).cells for mixture in mixtures]
    once = len(list(cache.iterdir()))
    assert once <= 3, "lights of the table alone"
    for mixture in mixtures:
        colorimetric_mixtures(lut, mixture, matrix)
    assert len(list(cache.iterdir())) == once + len(mixtures)
    monkeypatch.setattr("generator.rendering.colorimetric.mix_cells", None)
    for mixture, cells in zip(mixtures, first, strict=True):
        np.testing.assert_array_equal(colorimetric_mixtures(lut, mixture, matrix).cells, cells)


def test_lights_have_numbers_temperatures_and_mixtures(make_table: MakeTable) -> None:
    lut = make_table(bits=1)
    by_number, by_kelvin = colorimetric_mixtures(lut, 1), colorimetric_mixtures(lut, 5600.0)
    np.testing.assert_array_equal(by_number.cells, by_kelvin.cells)
    # This print is the same under all lights, but for noise.
    mixed = colorimetric_mixtures(lut, Mixture((0, 2), (0.5, 0.5)))
    assert np.median(np.abs(mixed.colours - by_number.colours)) < 0.005
    with pytest.raises(InputError, match="there is no light 9"):
        colorimetric_mixtures(lut, 9)
    with pytest.raises(InputError, match="1000 K is outside"):
        colorimetric_mixtures(lut, 1000.0)


def test_greys_are_grey_under_mixtures_of_lights_and_several_lights(make_table: MakeTable) -> None:
    lut = make_table(bits=4, tint=0.15)
    rendering = ColorimetricRendering(lut, ColourMatrix("mine", MATRIX, ""))
    mixture = Mixture((0, 2), (0.3, 0.7))
    mixtures = rendering.mixtures_for(Lighting((mixture,)))
    shown = mixture.samples(lut).astype(np.float64)[mixtures.cells[GREYS]].mean(axis=(1, 2))
    assert angles_deg(shown, mixture.white(lut)).max() < 0.5
    assert mixtures.distance[GREYS].max() < 0.5
    # Two lights that are the same are one.
    lighting = Lighting((mixture, mixture), parse_masks("half-plane", 2, 1).maker(0))
    assert rendering.light_of(lighting).weights == pytest.approx(mixture.weights)
    np.testing.assert_array_equal(rendering.mixtures_for(lighting).cells, mixtures.cells)


def test_greys_are_mixed_anew_for_a_mixture_of_unlike_lights(make_table: MakeTable) -> None:
    lut = make_table(bits=4, tint=0.15, blue_of_green=0.8)
    matrix = ColourMatrix("mine", MATRIX, "")
    mixture = Mixture((0, 2), (0.8, 0.2))
    seen = mixture.samples(lut).mean(axis=1) / mixture.white(lut)
    by_one = [colorimetric_mixtures(lut, light, matrix).cells[GREYS] for light in range(3)]
    assert min(angles_deg(seen[cells].mean(axis=1), np.ones(3)).max() for cells in by_one) > 0.5
    own = colorimetric_mixtures(lut, mixture, matrix).cells[GREYS]
    assert angles_deg(seen[own].mean(axis=1), np.ones(3)).max() < 0.5


def test_several_lights_count_alike_however_bright(make_table: MakeTable) -> None:
    lut = make_table(bits=1)
    rendering = ColorimetricRendering(lut, ColourMatrix("mine", MATRIX, ""))
    light = rendering.light_of(Lighting((plain(0), plain(1)), parse_masks("half-plane", 2, 1).maker(0)))
    parts = np.array(light.weights) * lut.white[list(light.lights)].sum(axis=1)
    assert parts[0] == pytest.approx(parts[1])


def test_a_table_of_one_light(make_table: MakeTable) -> None:
    rendering = ColorimetricRendering(make_table(bits=1, lights=1), ColourMatrix("mine", MATRIX, ""))
    assert rendering.mixtures_for(Lighting((plain(0),))).cells.max() < 8


def test_the_matrix_is_that_of_the_camera_or_of_the_table(make_table: MakeTable) -> None:
    lut = make_table()
    assert matrix_for(lut).name == "Canon EOS 550D"
    unknown = matrix_for(make_table(camera="Pinhole", name="pinhole"))
    assert unknown.name == "table"
    np.testing.assert_allclose(unknown.rows, MATRIX, atol=0.01)
    assert matrix_for(lut, "table").name == "table"
    assert matrix_for(lut, "eos 5ds r").name == "Canon EOS 5DS R"
    assert matrix_for(make_table(camera="Canon EOS 5DS", name="5ds")).name == "Canon EOS 5DS"
    np.testing.assert_array_equal(matrix_for(lut, "none").rows, np.eye(3))
    with pytest.raises(InputError, match="neither a file nor a camera"):
        matrix_for(lut, "pinhole")


def test_a_print_that_is_off_makes_a_fitted_matrix_say_so(make_table: MakeTable) -> None:
    fitted = fitted_matrix(make_table(bits=4, tint=0.3))
    assert "degrees off in the median" in fitted.source
    assert float(fitted.source.split("; ")[1].split()[0]) > 1


def test_cells_that_clip_and_cells_with_hot_samples_are_not_used(make_table: MakeTable) -> None:
    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        samples[100, 3, 0] = 9000
        samples[511] = np.minimum(samples[511], 5000)

    lut = make_table(change=spoil, white_level=11000)
    assert np.flatnonzero(~profile_of(lut, 1).usable).tolist() == [100]
    # The paper clips when saturation is below it, and the white point follows what does not.
    clipped = make_table(white_level=5000, name="clipped")
    profile = profile_of(clipped, 1)
    assert not profile.usable[511]
    assert profile.usable.sum() > 300
    whole = profile_of(make_table(name="whole"), 1)
    assert profile.white < whole.white
    shown = clipped.samples[1].astype(np.float64)[colorimetric_mixtures(clipped, 1).cells[GREYS]].mean(axis=(1, 2))
    assert angles_deg(shown, clipped.white[1]).max() < 0.7


def test_a_black_that_is_spoilt_is_named_and_makes_no_flat_image(make_table: MakeTable) -> None:
    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        samples[0] = (samples[511] * 0.7).astype(np.uint16)

    with pytest.raises(QualityError, match=r"under light 1 the table .* has a black as bright as 0\.6\d* of white"):
        colorimetric_mixtures(make_table(change=spoil), 1)
