"""Primaries with different fields: synthetic patches with known light, and a session compared with its room."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline.build import build
from calibration.radiometry.primaries import Additivity, Primaries, additivity, drift_gains, pure_lights
from calibration.radiometry.superposition import NODES, Superposition
from calibration.table.lut import open_lut
from drivers.presenter import Colour
from experiment.lights import Illuminant, plan_illuminants
from experiment.measures.paper import FlatField, Paper, PaperReader
from sim.world.world import Room
from tests.calibration.lab import SETTINGS, hang, renumbered, take

FULL = 12000.0
USUAL = Superposition.usual(FULL)
PRIMARIES = ((255, 0, 0), (0, 255, 0), (0, 0, 255))

_Array = npt.NDArray[np.float64]


def lights(codes: tuple[tuple[int, int, int], ...]) -> list[Illuminant]:
    return [Illuminant(number, "uniform", None, Colour(*code)) for number, code in enumerate(codes)]


def test_light_adds_after_black_subtraction() -> None:
    black, primaries = np.array([3.0, 5.0, 4.0]), np.array([[3000.0, 700, 90], [400, 6000, 500], [80, 900, 4000]])
    white = black + primaries.sum(axis=0)
    ones = np.ones((3, 3))

    def measure(whites: _Array, full_white: _Array, gains: _Array = ones) -> Additivity:
        result = additivity(lights(PRIMARIES), whites, full_white, black, gains, USUAL)
        assert result is not None
        return result

    adds = measure(primaries + black, white)
    assert adds.off == pytest.approx(np.zeros(3), abs=1e-9)
    assert adds.amounts == pytest.approx(np.ones(3))
    assert measure(primaries + black, 1.25 * white).off == pytest.approx(np.full(3, -0.2), abs=1e-3)
    assert measure(0.9 * (primaries + black), white, 0.9 * ones).off == pytest.approx(np.zeros(3), abs=1e-9)
    # A shadow in the frame of green alone: white has more of green than that frame.
    shadowed = primaries * np.array([[1.0], [0.9], [1.0]]) + black
    assert measure(shadowed, white).amounts == pytest.approx([1, 1 / 0.9, 1])


def test_corrects_white_for_measured_linearity() -> None:
    primaries, nodes = np.array([[3000.0, 700, 90], [400, 6000, 500], [80, 900, 4000]]), np.array(NODES)
    whites, white = (light * (1 - 0.04 * light / FULL) for light in (primaries, primaries.sum(axis=0)))
    measured = replace(USUAL, deviation=-0.04 * nodes**2 * FULL, covariance=USUAL.covariance / 100, unmeasured=None)

    def measure(sensor: Superposition) -> Additivity:
        result = additivity(lights(PRIMARIES), whites, white, np.zeros(3), np.ones((3, 3)), sensor)
        assert result is not None
        return result

    assert measure(USUAL).off.max() > 0.008
    assert np.abs(measure(measured).off).max() < 0.002
    # The uncertainty of the sensor is part of the result.
    assert measure(measured).error == pytest.approx(measure(USUAL).error / 10, rel=0.1)
    assert measure(USUAL).error.max() > 0.001


def test_returns_none_without_primary_or_white() -> None:
    assert additivity(lights(PRIMARIES[:2]), np.ones((2, 3)), np.ones(3), np.zeros(3), np.ones((2, 3)), USUAL) is None
    assert additivity(lights(PRIMARIES), np.ones((3, 3)), None, np.zeros(3), np.ones((3, 3)), USUAL) is None


def test_drift_is_linear_between_white_frames() -> None:
    gains = drift_gains(
        np.array([0.0, 5, 10, 15, 30]), np.array([0.0, 10, 20]), np.array([[8.0, 4, 2], [4, 4, 2], [4, 4, 1]])
    )
    assert gains[:, 0].tolist() == [1, 0.75, 0.5, 0.5, 0.5]
    assert gains[:, 2].tolist() == [1, 1, 1, 0.75, 0.5]
    assert (drift_gains(np.arange(3.0), np.array([1.0]), np.ones((1, 3))) == 1).all()


PAGE = (400.0, 300.0)
RANDOM = np.random.default_rng(5)
PLACES, CENTRES = RANDOM.random((400, 2)) * PAGE, RANDOM.random((1000, 2)) * PAGE

_Array = npt.NDArray[np.float64]


def shapes(points: _Array) -> _Array:
    """Return the fields (N, 3) of three primaries, polynomials of order 2."""
    x, y = (2 * points / PAGE - 1).T
    return np.stack([1 - 0.1 * x * x, 1 - 0.06 * y * y + 0.03 * x, 1 - 0.12 * x * y], axis=-1)


def test_field_of_patch_depends_on_reflected_light() -> None:
    fields = shapes(CENTRES) / shapes(CENTRES).mean(axis=0)
    at_paper = shapes(PLACES) / shapes(CENTRES).mean(axis=0)
    # counts of paper and of each patch, by primary and channel
    paper = np.array([[3000.0, 600, 100], [500, 5000, 700], [80, 900, 4000]])
    cells: _Array = paper[:, None] * (0.02 + RANDOM.random((3, 1000, 1)) ** 2)
    reader = PaperReader(PLACES, CENTRES, PAGE)
    alone = [reader.read(at_paper[:, [p]] * paper[p])[0] for p in range(3)]
    primaries = Primaries.of((0, 1, 2), alone, [*cells], CENTRES)
    assert primaries is not None
    assert primaries.difference == pytest.approx((fields.max(axis=1) / fields.min(axis=1)).max() - 1, abs=0.01)
    amounts = np.array([0.7, 0.3, 0.9])
    white = amounts @ paper
    assert primaries.amounts(white) == pytest.approx(amounts, rel=1e-3)
    true = np.einsum("p,ip,pic->ic", amounts, fields, cells) / np.einsum("p,pic->ic", amounts, cells)
    paper_field = np.einsum("p,ip,pc->ic", amounts, fields, paper) / white
    assert np.abs(true / paper_field - 1).max() > 0.01
    assert primaries.field_ratio(white) == pytest.approx(true / paper_field, abs=3e-3)
    # `lut.json` has all values to undo it.
    record = primaries.correction(white[None])
    assert record["lights"] == [0, 1, 2]
    assert record["per_light"][0] == pytest.approx(amounts, rel=1e-3)


def test_single_primary_has_field_of_paper() -> None:
    reader = PaperReader(PLACES, CENTRES, PAGE)
    alone = [reader.read(shapes(PLACES)[:, [p]] * np.full(3, 1000.0))[0] for p in range(3)]
    primaries = Primaries.of((0, 1, 2), alone, [RANDOM.random((1000, 3)) * 900 for _ in range(3)], CENTRES)
    assert primaries is not None
    pure = Primaries.of(
        (0, 1, 2), [replace(p, white=np.eye(3)[n] * 1000) for n, p in enumerate(alone)], [*primaries.cells], CENTRES
    )
    assert pure is not None
    assert pure.field_ratio(np.array([0, 800.0, 0])) == pytest.approx(1, abs=1e-12)


def test_returns_none_for_dim_primary() -> None:
    even = FlatField(PAGE, ((), (), ()))
    dim = [Paper(even, np.array([1000.0, 10, 10]), np.ones(3), 9, np.zeros(3)) for _ in range(2)]
    dim.append(Paper(even, np.array([1.0, 10, 200]), np.ones(3), 9, np.zeros(3)))
    assert Primaries.of((0, 1, 2), dim, [np.ones((10, 3)) for _ in range(3)], RANDOM.random((10, 2))) is None


def test_clips_counts_below_black() -> None:
    even = FlatField(PAGE, ((), (), ()))
    papers = [Paper(even, white, np.ones(3), 9, np.zeros(3)) for white in 900 * np.eye(3) - 0.4 * (1 - np.eye(3)) + 0.2]
    cells = [np.array([[-3.0, 0.5, 70.0]])] * 3
    primaries = Primaries.of((0, 1, 2), papers, cells, np.array([[1.0, 1.0]]))
    assert primaries is not None
    np.testing.assert_allclose(primaries.paper, 900.2 * np.eye(3))
    np.testing.assert_allclose(primaries.cells, [[[0, 0.5, 70]]] * 3)


def test_selects_brightest_pure_illuminants() -> None:
    lights = plan_illuminants(3, (3000,))
    indices = pure_lights(lights)
    assert indices is not None
    assert [lights[n].colour for n in indices] == [
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
    ]
    assert pure_lights([light for light in lights if light.kind == "cct"]) is None

    def selected(*codes: tuple[int, int, int]) -> tuple[int, int, int] | None:
        return pure_lights([Illuminant(n, "uniform", None, Colour(*code)) for n, code in enumerate(codes)])

    # The first of equal ones; black does not count.
    assert selected((200, 0, 0), (255, 0, 0), (255, 0, 0), (0, 9, 0), (0, 0, 9), (255, 9, 0)) == (1, 3, 4)
    assert selected((0, 0, 0), (0, 255, 0), (0, 0, 255)) is None


@pytest.mark.slow
@pytest.mark.usefixtures("lens_unmeasured")
def test_corrects_session_with_different_primaries(tmp_path: Path) -> None:
    room = Room(waviness_mm=0.5, projector_falloff=0.3, primary_difference=0.4, response_spread=0.0)
    lab = hang(room=room)
    lights = renumbered(plan_illuminants(2, (4500, 6500)))
    with take(lab, tmp_path / "session", lights) as session:
        result = build(session, tmp_path / "lut")
    lut = open_lut(tmp_path / "lut")
    codes = lab.chart.rgb[lab.chart.cell_of_colour]
    is_fit = np.ones(len(codes), dtype=bool)
    is_fit[[cell.colour for cell in lut.provenance.unfit]] = False
    assert result.figures.primaries is not None
    # The reference patches have the field of their colour, too: the same frame has no differences.
    consistency = result.figures.registered_frame.consistency
    assert consistency.scatter < 0.001
    assert consistency.block < 0.001
    assert not consistency.disturbed
    corrected: list[_Array] = []
    plain: list[_Array] = []
    for light in lights:
        white = lab.world.white(light.colour, SETTINGS)
        true = lab.world.reflected(codes, light.colour, SETTINGS) / white * lut.white[light.index]
        error = lut.samples[light.index].mean(axis=1) / true - 1
        is_bright = is_fit[:, None] & (true > 1500)
        undone = (1 + error) * result.figures.primaries.field_ratio(lut.white[light.index]) - 1
        corrected.append(error[is_bright])
        plain.append(undone[is_bright])
    rms, plain_rms = (float(np.sqrt((np.concatenate(values) ** 2).mean())) for values in (corrected, plain))
    assert rms < 0.9 * plain_rms
