"""Two tables compared: the same within noise where only noise differs, and each known deviation found, and named."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from calibration.comparison import comparing
from calibration.comparison.comparing import NoiseAnswer, TableComparison, compare, light_pairs
from calibration.comparison.report import comparison_json, lines, write_comparison
from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter, references_csv
from drivers.presenter import Colour
from experiment.lights import Illumination
from foundation.errors import FormatError
from tests.calibration.lab import LIGHTS

CHART = "cd" * 32
COLOURS = 8**3
ERROR = 2e-4
"""Relative standard error of a white in the tables written here."""

_Array = npt.NDArray[np.float64]


def written(
    folder: Path,
    seed: int,
    gain: npt.ArrayLike = 1.0,
    cells: Callable[[_Array], _Array] = lambda means: means,
    samples: int = 25,
    lights: Sequence[Illumination] = LIGHTS,
    errors: bool = True,
    chart: str = CHART,
    camera: str = "Test",
) -> Lut:
    """Return a table whose cells and whites have the noise that it states; one world for all seeds."""
    world, random = np.random.default_rng(1), np.random.default_rng(seed)
    folder.mkdir()
    writer = LutWriter(folder, len(lights), COLOURS, samples)
    reflected = world.uniform(0.05, 0.9, (COLOURS, 3))
    white = world.uniform(3000.0, 9000.0, (100, 3))[: len(lights)] * np.broadcast_to(gain, (100, 3))[: len(lights)]
    for light in range(len(lights)):
        means = cells(reflected * white[light])
        counts = means[:, None] + random.standard_normal((COLOURS, samples, 3)) * np.sqrt(means[:, None] / 1.8 + 36)
        writer.put(light, np.rint(np.maximum(counts, 0)).astype(np.uint16))
    truth = white * (1 + ERROR * random.standard_normal(white.shape))
    text = references_csv((), truth, ERROR * white, np.zeros((len(lights), 0, 3)), np.zeros((len(lights), 0, 3)))
    writer.finish(
        lights,
        truth,
        Provenance(
            camera=camera, bits=3, white_level=13000, session_sha256=f"{seed:064d}", chart_sha256=chart,
            software="croplab test",
        ),
        files={"references.csv": text} if errors else {},
    )  # fmt: skip
    return open_lut(folder)


def answer(comparison: TableComparison, name: str) -> NoiseAnswer:
    (found,) = [each for each in comparison.answers if each.name == name]
    return found


@pytest.fixture
def one(tmp_path: Path) -> Lut:
    return written(tmp_path / "one", 10)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [25, 9])
def test_other_noise_is_within_noise(one: Lut, tmp_path: Path, samples: int) -> None:
    found = compare(one, written(tmp_path / "other", 20, samples=samples))
    assert found.same_within_noise
    assert found.cells.score == pytest.approx(1, abs=0.02)
    assert found.cells.rms == pytest.approx(found.cells.rms_by_noise, rel=0.03)


@pytest.mark.slow
def test_chances_are_those_of_many_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of tables that differ by noise alone, chances are spread evenly from 0 to 1."""
    monkeypatch.setattr(comparing, "ERROR_OF_ERRORS", 1.0)
    tables = [written(tmp_path / str(seed), seed, lights=LIGHTS) for seed in range(12)]
    pairs = [compare(first, second).lights for first, second in zip(tables[::2], tables[1::2], strict=True)]
    for chances in ([pair.angle_p for pair in pairs], [pair.brightness_p for pair in pairs]):
        assert stats.kstest(np.concatenate(chances), stats.uniform.cdf).pvalue > 0.01


@pytest.mark.slow
def test_a_dimmer_lamp_is_a_difference_of_brightness_and_of_nothing_else(one: Lut, tmp_path: Path) -> None:
    found = compare(one, written(tmp_path / "other", 20, gain=0.98))
    assert [each.same_within_noise for each in found.answers] == [True, False, True]
    assert float(np.median(found.lights.brightness)) == pytest.approx(-0.02, abs=3e-4)


def test_a_drift_of_2_per_cent_in_one_session_is_a_difference_of_brightness(one: Lut, tmp_path: Path) -> None:
    course = np.ones((100, 3))
    course[: len(LIGHTS)] = np.linspace(1, 0.98, len(LIGHTS))[:, None]
    found = compare(one, written(tmp_path / "other", 20, gain=course))
    assert [each.same_within_noise for each in found.answers] == [True, False, True]
    assert float(np.ptp(found.lights.brightness)) == pytest.approx(0.02, abs=1.5e-3)


def test_a_light_of_another_colour_is_named(one: Lut, tmp_path: Path) -> None:
    gain = np.ones((100, 3))
    gain[5] = (1.0015, 1, 0.9985)
    found = compare(one, written(tmp_path / "other", 20, gain=gain))
    assert [each.same_within_noise for each in found.answers] == [False, True, True]
    assert answer(found, "colour of lights").said.endswith("1 lights are beyond noise: 5")
    assert found.lights.angle_deg[5] == pytest.approx(0.07, abs=0.04)


def test_a_stain_is_named_cell_by_cell(one: Lut, tmp_path: Path) -> None:
    def stained(means: _Array) -> _Array:
        return means * np.where(np.isin(np.arange(COLOURS), (200, 201))[:, None], (1, 1, 0.95), 1)

    found = compare(one, written(tmp_path / "other", 20, cells=stained))
    assert [each.same_within_noise for each in found.answers] == [True, True, False]
    assert "2 cells differ under all lights" in answer(found, "cells").said
    assert sorted(comparison_json(found)["differing_cells"]) == [200, 201]
    assert found.cells.mean[200, 2] == pytest.approx(-0.05, abs=0.01)


def test_a_shadow_in_one_frame_is_found_though_the_table_is_the_same_otherwise(one: Lut, tmp_path: Path) -> None:
    calls = iter(range(100))

    def shaded(means: _Array) -> _Array:
        return means * (np.where(np.arange(COLOURS)[:, None] < 60, 0.9, 1) if next(calls) == 7 else 1)

    found = compare(one, written(tmp_path / "other", 20, cells=shaded))
    assert not answer(found, "cells").same_within_noise
    assert "1 lights are beyond 1.3 times their noise: 7" in answer(found, "cells").said


def test_paler_cells_are_beyond_noise(one: Lut, tmp_path: Path) -> None:
    found = compare(one, written(tmp_path / "other", 20, cells=lambda means: means + 60))
    assert not answer(found, "cells").same_within_noise
    assert found.cells.rms > found.cells.rms_by_noise + 0.01


def test_a_table_with_itself_shows_nothing_and_says_so(one: Lut) -> None:
    found = compare(one, one)
    assert found.lights.angle_deg.max() == 0
    assert found.cells.rms == 0
    assert "both tables are of the same frames" in found.warnings[0]


def test_common_lights_of_other_lists_are_compared(one: Lut, tmp_path: Path) -> None:
    lights = tuple(replace(light, index=number) for number, light in enumerate(LIGHTS[4:]))
    assert light_pairs(LIGHTS, lights) == [(light, light - 4) for light in range(4, len(LIGHTS))]
    found = compare(one, written(tmp_path / "other", 20, lights=lights, camera="Another"))
    assert len(found.lights.one) == len(LIGHTS) - 4
    assert any("two cameras, Test and Another" in warning for warning in found.warnings)
    said = f"{len(LIGHTS) - 4} common lights are compared; 4 are in A only, 0 in B only"
    assert any(said in each for each in found.warnings)
    # Other lights under the same numbers: what is compared are light 4 of one and 0 of the other, which differ here.
    assert not found.same_within_noise


def test_other_charts_and_no_common_light_are_refused(one: Lut, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cdcdcdcdcdcd… against efefefefefef…"):
        compare(one, written(tmp_path / "chart", 20, chart="ef" * 32))
    other = tuple(replace(light, colour=Colour(1, 2, 3), kind="uniform", cct_k=None) for light in LIGHTS)
    with pytest.raises(FormatError, match="no light in common"):
        compare(one, written(tmp_path / "lights", 20, lights=other))


def test_damaged_samples_and_references_are_refused(one: Lut, tmp_path: Path) -> None:
    one_light = "light,name,r_error,g_error,b_error\n0,white,1,1,1\n"
    for number, text in enumerate((None, "light,name\n0,white\n", one_light)):
        other = written(tmp_path / f"other{number}", 20, errors=text is not None)
        if text is not None:
            (other.folder / "references.csv").write_text(text)
        with pytest.raises(FormatError, match=r"references\.csv .* build the table again"):
            compare(one, other)
    data = bytearray((one.folder / "samples.npy").read_bytes())
    data[-1] ^= 1
    (one.folder / "samples.npy").write_bytes(data)
    with pytest.raises(FormatError, match="samples"):
        compare(open_lut(one.folder), written(tmp_path / "whole", 20))


def test_tables_in_which_every_cell_is_dark_are_refused(tmp_path: Path) -> None:
    dark, other = (written(tmp_path / str(seed), seed, cells=lambda means: means / 100) for seed in (1, 2))
    with pytest.raises(FormatError, match="300 counts"):
        compare(dark, other)


def test_unfit_cells_of_either_are_left_out(one: Lut, tmp_path: Path) -> None:
    other = written(tmp_path / "other", 20)
    path = other.folder / "lut.json"
    document = json.loads(path.read_text())
    document["unfit"] = [{"colour": 7, "cause": "stained: x"}]
    path.write_text(json.dumps(document))
    found = compare(one, open_lut(other.folder, check=False))
    assert np.isnan(found.cells.mean[7]).all()
    assert not found.cells.lights[7].any()


@pytest.mark.slow
def test_the_files_hold_every_light_and_every_cell(one: Lut, tmp_path: Path) -> None:
    found = compare(one, written(tmp_path / "other", 20, gain=0.9))
    write_comparison(found, tmp_path / "report")
    lights = np.genfromtxt(tmp_path / "report" / "lights.csv", delimiter=",", names=True)
    cells = np.genfromtxt(tmp_path / "report" / "cells.csv", delimiter=",", names=True)
    np.testing.assert_allclose(lights["brightness"], found.lights.brightness, rtol=1e-5)
    np.testing.assert_allclose(cells["mean_g"], found.cells.mean[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(cells["colour"], np.arange(COLOURS))
    page = (tmp_path / "report" / "report.html").read_text()
    assert "They differ by more than noise." in page
    assert "-10.0" in page
    stored = json.loads((tmp_path / "report" / "comparison.json").read_text())
    assert (stored["format"], stored["same_within_noise"]) == ("crop.comparison", False)
    assert stored["tables"][0] == str(one.folder)
    assert lines(found)[-1].endswith("no")
