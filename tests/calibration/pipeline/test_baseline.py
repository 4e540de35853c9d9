"""The field on a chart without tags, from its cells, against the room's light."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline.baseline import field_of_cells
from drivers.presenter import WHITE, Colour
from experiment.chart.layout import paper_chart
from experiment.chart.printing import drawing
from experiment.measures.least_squares import code_polynomial, code_powers, page_polynomial
from experiment.measures.paper import PaperReader
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import Room, World
from tests.calibration.lab import SETTINGS

pytestmark = pytest.mark.slow

CHART = paper_chart("A1", 4)
WHITES_MM = np.array([reference.centre_mm for reference in CHART.references])


@pytest.fixture(scope="module")
def world() -> World:
    picture = drawing(CHART)
    return World(Print(picture.page_mm, picture.rectangles_mm, picture.rgb), BODIES["Test"], Room(waviness_mm=0))


def seen(world: World, colour: Colour) -> tuple[npt.NDArray[np.float64], ...]:
    """Return cells with the noise of 25 samples, references, and the true field at the cells, mean 1."""
    cells = world.camera_rgb_at(CHART.rgb, CHART.centres_mm, colour, SETTINGS)
    cells += np.random.default_rng(1).normal(size=cells.shape) * np.sqrt(np.maximum(cells, 0) / 50 + 2)
    whites = world.camera_rgb_at(np.full((len(WHITES_MM), 3), 255), WHITES_MM, colour, SETTINGS)
    bare = world.camera_rgb_at(np.full((len(cells), 3), 255), CHART.centres_mm, colour, SETTINGS)
    return cells, whites, bare / bare.mean(axis=0)


def test_cells_show_light_in_centre(world: World) -> None:
    cells, whites, true = seen(world, WHITE)
    usable = np.ones(len(cells), dtype=np.bool_)
    field = field_of_cells(CHART.rgb, CHART.centres_mm, cells, usable, WHITES_MM, whites, CHART.page_mm)
    error = field.at(CHART.centres_mm) / true - 1
    assert np.sqrt((error**2).mean()) < 0.004
    # References in the margin alone leave more than twice that.
    alone = PaperReader(WHITES_MM, CHART.centres_mm, CHART.page_mm).read(whites)[0].field
    assert np.sqrt(((alone.at(CHART.centres_mm) / true - 1) ** 2).mean()) > 0.009


def test_excludes_covered_cells_and_stained_reference(world: World) -> None:
    cells, whites, true = seen(world, WHITE)
    usable = np.ones(len(cells), dtype=np.bool_)
    usable[1000:1100] = False
    cells[1000:1100] = 7000
    # A few that nobody has noticed.
    cells[2000:2020] *= 0.5
    whites[3] *= 0.8
    whites[5] = np.nan
    field = field_of_cells(CHART.rgb, CHART.centres_mm, cells, usable, WHITES_MM, whites, CHART.page_mm)
    assert np.sqrt(((field.at(CHART.centres_mm) / true - 1) ** 2).mean()) < 0.005


FEW = paper_chart("A6", 2)
FEW_WHITES_MM = np.array([reference.centre_mm for reference in FEW.references])


def planted(
    degree: int, order: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return levels of 64 cells and of paper with polynomial logarithms, and the true field."""
    random = np.random.default_rng(3)
    codes = code_polynomial(FEW.rgb, degree)
    at_cells, at_paper = (page_polynomial(at, FEW.page_mm, order) for at in (FEW.centres_mm, FEW_WHITES_MM))
    light = 0.2 * random.standard_normal((at_cells.shape[1] - 1, 3))
    colours = 0.3 * random.standard_normal((codes.shape[1], 3))
    levels = 1000 * np.exp(codes @ colours + at_cells[:, 1:] @ light)
    smooth = at_cells @ np.linalg.lstsq(at_cells, np.exp(at_cells[:, 1:] @ light), rcond=None)[0]
    return levels, 3000 * np.exp(at_paper[:, 1:] @ light), smooth / smooth.mean(axis=0)


def test_recovers_model_field_with_64_colours() -> None:
    """Second degree in codes and position: five cells for each of ten terms."""
    levels, paper, true = planted(2, 2)
    usable = np.ones(len(levels), dtype=np.bool_)
    usable[5], levels[5] = False, 50.0
    # Nothing is learned of what is too dark.
    levels[[7, 20]] = 9.9
    field = field_of_cells(FEW.rgb, FEW.centres_mm, levels, usable, FEW_WHITES_MM, paper, FEW.page_mm)
    np.testing.assert_allclose(field.at(FEW.centres_mm), true, rtol=1e-6)


def test_reference_weighs_ten_cells() -> None:
    levels, paper, true = planted(2, 2)
    usable = np.ones(len(levels), dtype=np.bool_)
    # A field that cells and paper do not agree on is more that of the paper.
    turned = paper * (1 + 0.02 * (FEW_WHITES_MM[:, :1] / FEW.page_mm[0] - 0.5))
    both = field_of_cells(FEW.rgb, FEW.centres_mm, levels, usable, FEW_WHITES_MM, turned, FEW.page_mm)
    change = np.log(both.at(FEW.centres_mm) / true)
    slope = np.polyfit(FEW.centres_mm[:, 0] / FEW.page_mm[0], change, 1)[0] / 0.02
    assert ((slope > 0.5) & (slope < 1.2)).all()
    terms = len(code_powers(2)) + page_polynomial(FEW.centres_mm, FEW.page_mm, 2).shape[1]
    # Two patches for each number of the model are enough, one fewer is not.
    for count, shaped in ((2 * terms, True), (2 * terms - 1, False)):
        usable[:] = np.arange(len(usable)) < count - len(FEW_WHITES_MM)
        result = field_of_cells(FEW.rgb, FEW.centres_mm, levels, usable, FEW_WHITES_MM, paper, FEW.page_mm)
        assert (result.at(FEW.centres_mm) == 1).all() != shaped


def test_channel_without_light_has_no_shape(world: World) -> None:
    cells, whites, _ = seen(world, Colour(0, 0, 255))
    usable = np.ones(len(cells), dtype=np.bool_)
    cells[:, 0] = np.random.default_rng(2).normal(0, 2, len(cells))
    whites[:, 0] = 0.5
    field = field_of_cells(CHART.rgb, CHART.centres_mm, cells, usable, WHITES_MM, whites, CHART.page_mm)
    assert (field.at(CHART.centres_mm)[:, 0] == 1).all()
