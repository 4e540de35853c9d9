"""Comparison of two tables: same within noise if only noise differs, and every known deviation is reported."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from calibration.cli import main
from calibration.comparison import comparing
from calibration.comparison.comparing import (
    CELL_FLOOR,
    CellDifferences,
    LightDifferences,
    NoiseAnswer,
    TableComparison,
    compare,
    differing_cells,
    differing_lights,
    light_pairs,
    table_of,
)
from calibration.comparison.report import comparison_json, lines, write_comparison
from calibration.pipeline.build import build
from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter, references_csv
from drivers.presenter import Colour
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.errors import FormatError, QualityError
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, Lab, hang, take

CHART = "cd" * 32


COLOURS = 8**3


# Relative standard error of a white in the tables written here.
ERROR = 2e-4


_Array = npt.NDArray[np.float64]


def written(
    folder: Path,
    seed: int,
    gain: npt.ArrayLike = 1.0,
    cells: Callable[[_Array], _Array] = lambda means: means,
    samples: int = 25,
    lights: Sequence[Illuminant] = LIGHTS,
    errors: bool = True,
    chart: str = CHART,
    camera: str = "Test",
) -> Lut:
    """Return a table with the noise that it records; the same world for all seeds."""
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
    (result,) = [each for each in comparison.answers if each.name == name]
    return result


@pytest.fixture
def one(tmp_path: Path) -> Lut:
    return written(tmp_path / "one", 10)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [25, 9])
def test_other_noise_is_same_within_noise(one: Lut, tmp_path: Path, samples: int) -> None:
    result = compare(one, written(tmp_path / "other", 20, samples=samples))
    assert result.same_within_noise
    assert result.cells.score == pytest.approx(1, abs=0.02)
    assert result.cells.rms == pytest.approx(result.cells.rms_by_noise, rel=0.03)


@pytest.mark.slow
def test_probabilities_are_uniform_for_noise_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparing, "ERROR_FACTOR", 1.0)
    tables = [written(tmp_path / str(seed), seed, lights=LIGHTS) for seed in range(12)]
    pairs = [compare(first, second).lights for first, second in zip(tables[::2], tables[1::2], strict=True)]
    for chances in ([pair.angle_p for pair in pairs], [pair.brightness_p for pair in pairs]):
        assert stats.kstest(np.concatenate(chances), stats.uniform.cdf).pvalue > 0.01


@pytest.mark.slow
def test_dimmer_lamp_differs_only_in_brightness(one: Lut, tmp_path: Path) -> None:
    result = compare(one, written(tmp_path / "other", 20, gain=0.98))
    assert [each.same_within_noise for each in result.answers] == [True, False, True]
    assert float(np.median(result.lights.brightness)) == pytest.approx(-0.02, abs=3e-4)


def test_drift_of_two_percent_differs_in_brightness(one: Lut, tmp_path: Path) -> None:
    course = np.ones((100, 3))
    course[: len(LIGHTS)] = np.linspace(1, 0.98, len(LIGHTS))[:, None]
    result = compare(one, written(tmp_path / "other", 20, gain=course))
    assert [each.same_within_noise for each in result.answers] == [True, False, True]
    assert float(np.ptp(result.lights.brightness)) == pytest.approx(0.02, abs=1.5e-3)


def test_names_light_of_another_colour(one: Lut, tmp_path: Path) -> None:
    gain = np.ones((100, 3))
    gain[5] = (1.0015, 1, 0.9985)
    result = compare(one, written(tmp_path / "other", 20, gain=gain))
    assert [each.same_within_noise for each in result.answers] == [False, True, True]
    assert answer(result, "colour of illuminants").said.endswith("1 illuminant beyond noise: 5")
    assert result.lights.angle_deg[5] == pytest.approx(0.07, abs=0.04)


def test_names_stained_cells(one: Lut, tmp_path: Path) -> None:
    def stained(means: _Array) -> _Array:
        return means * np.where(np.isin(np.arange(COLOURS), (200, 201))[:, None], (1, 1, 0.95), 1)

    result = compare(one, written(tmp_path / "other", 20, cells=stained))
    assert [each.same_within_noise for each in result.answers] == [True, True, False]
    assert "2 patches with differences under all illuminants" in answer(result, "cells").said
    assert sorted(comparison_json(result)["differing_cells"]) == [200, 201]
    assert result.cells.mean[200, 2] == pytest.approx(-0.05, abs=0.01)


def test_detects_shadow_in_one_frame(one: Lut, tmp_path: Path) -> None:
    calls = iter(range(100))

    def shaded(means: _Array) -> _Array:
        return means * (np.where(np.arange(COLOURS)[:, None] < 60, 0.9, 1) if next(calls) == 7 else 1)

    result = compare(one, written(tmp_path / "other", 20, cells=shaded))
    assert not answer(result, "cells").same_within_noise
    assert "1 illuminant beyond 1.3 times the noise: 7" in answer(result, "cells").said


def test_detects_paler_cells(one: Lut, tmp_path: Path) -> None:
    result = compare(one, written(tmp_path / "other", 20, cells=lambda means: means + 60))
    assert not answer(result, "cells").same_within_noise
    assert result.cells.rms > result.cells.rms_by_noise + 0.01


def test_warns_of_same_frames(one: Lut) -> None:
    result = compare(one, one)
    assert result.lights.angle_deg.max() == 0
    assert result.cells.rms == 0
    assert "both LUTs were built from the same frames" in result.warnings[0]


def test_compares_common_lights_of_different_lists(one: Lut, tmp_path: Path) -> None:
    lights = tuple(replace(light, index=number) for number, light in enumerate(LIGHTS[4:]))
    assert light_pairs(LIGHTS, lights) == [(light, light - 4) for light in range(4, len(LIGHTS))]
    result = compare(one, written(tmp_path / "other", 20, lights=lights, camera="Another"))
    assert len(result.lights.one) == len(LIGHTS) - 4
    assert any("two cameras, Test and Another" in warning for warning in result.warnings)
    message = f"{len(LIGHTS) - 4} common illuminants are compared; 4 are only in A, 0 only in B"
    assert any(message in each for each in result.warnings)
    # Other lights under the same numbers: what is compared are light 4 of one and 0 of the other, which differ here.
    assert not result.same_within_noise


def test_refuses_other_charts_and_no_common_light(one: Lut, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cdcdcdcdcdcd… against efefefefefef…"):
        compare(one, written(tmp_path / "chart", 20, chart="ef" * 32))
    other = tuple(replace(light, colour=Colour(1, 2, 3), kind="uniform", cct_k=None) for light in LIGHTS)
    with pytest.raises(FormatError):
        compare(one, written(tmp_path / "lights", 20, lights=other))


def test_refuses_damaged_samples_and_references(one: Lut, tmp_path: Path) -> None:
    one_light = "light,name,r_error,g_error,b_error\n0,white,1,1,1\n"
    for number, text in enumerate((None, "light,name\n0,white\n", one_light)):
        other = written(tmp_path / f"other{number}", 20, errors=text is not None)
        if text is not None:
            (other.folder / "references.csv").write_text(text)
        with pytest.raises(FormatError, match=r"references\.csv .* build the LUT again"):
            compare(one, other)
    data = bytearray((one.folder / "samples.npy").read_bytes())
    data[-1] ^= 1
    (one.folder / "samples.npy").write_bytes(data)
    with pytest.raises(FormatError, match="samples"):
        compare(open_lut(one.folder), written(tmp_path / "whole", 20))


def test_refuses_tables_with_dark_cells_only(tmp_path: Path) -> None:
    dark, other = (written(tmp_path / str(seed), seed, cells=lambda means: means / 100) for seed in (1, 2))
    with pytest.raises(FormatError):
        compare(dark, other)


def test_excludes_unfit_cells_of_both(one: Lut, tmp_path: Path) -> None:
    other = written(tmp_path / "other", 20)
    path = other.folder / "lut.json"
    document = json.loads(path.read_text())
    document["unfit"] = [{"colour": 7, "cause": "stained: x"}]
    path.write_text(json.dumps(document))
    result = compare(one, open_lut(other.folder, check=False))
    assert np.isnan(result.cells.mean[7]).all()
    assert not result.cells.lights[7].any()


@pytest.mark.slow
def test_files_contain_all_lights_and_cells(one: Lut, tmp_path: Path) -> None:
    result = compare(one, written(tmp_path / "other", 20, gain=0.9))
    write_comparison(result, tmp_path / "report")
    lights = np.genfromtxt(tmp_path / "report" / "lights.csv", delimiter=",", names=True)
    cells = np.genfromtxt(tmp_path / "report" / "cells.csv", delimiter=",", names=True)
    np.testing.assert_allclose(lights["brightness"], result.lights.brightness, rtol=1e-5)
    np.testing.assert_allclose(cells["mean_g"], result.cells.mean[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(cells["colour"], np.arange(COLOURS))
    page = (tmp_path / "report" / "report.html").read_text()
    assert "The difference exceeds noise." in page
    assert "-10.0" in page
    stored = json.loads((tmp_path / "report" / "comparison.json").read_text())
    assert (stored["format"], stored["same_within_noise"]) == ("crop.comparison", False)
    assert stored["tables"][0] == str(one.folder)
    assert lines(result)[-1].endswith("no")


WHITE = np.array([[9000.0, 8000, 7000], [6000, 250, 4000], [50, 60, 40], [8000, 8000, 200]])


OTHER = np.array([[9090.0, 8000, 7070], [6060, 400, 4100], [55, 66, 44], [8200, 8100, 900]])


ERRORS = np.array([[90.0, 40, 70], [30, 10, 20], [5, 2, 1], [80, 60, 10]])


PAIRS = [(light, light) for light in range(4)]


def table(folder: Path, white: _Array, errors: _Array, samples: int, unfit: int) -> Any:
    """Return the compared parts of a table of eight colours, some of which are dark."""
    folder.mkdir()
    rows = [f"{light},white,{','.join(map(str, row))}" for light, row in enumerate(errors.tolist())]
    (folder / "references.csv").write_text("\n".join(["light,name,r_error,g_error,b_error", *rows, ""]))
    random = np.random.default_rng(samples)
    means = np.linspace(0.02, 0.9, 8)[:, None] * white[:, None]
    counts = random.normal(means[:, :, None], 3.0, (len(white), 8, samples, 3)).clip(0)
    # One cell without any scatter: integers have that of rounding.
    counts[0, 5] = 4000 + samples
    return SimpleNamespace(
        folder=folder,
        white=white,
        samples=np.rint(counts).astype(np.uint16),
        provenance=SimpleNamespace(unfit=[SimpleNamespace(colour=unfit)]),
        require_unchanged=lambda light: None,  # pyrefly: ignore[implicit-any-lambda]
    )


@pytest.fixture
def tables(tmp_path: Path) -> tuple[Any, Any]:
    return table(tmp_path / "one", WHITE, ERRORS, 4, 6), table(tmp_path / "other", OTHER, 2 * ERRORS, 9, 7)


def test_light_differences_match_least_squares(tables: tuple[Any, Any]) -> None:
    lights = comparing._compare_lights(*tables, PAIRS, np.zeros(4))
    for light in range(4):
        a, b = WHITE[light], OTHER[light]
        cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        assert lights.angle_deg[light] == pytest.approx(np.degrees(np.arccos(cosine)))
        # Least squares of a common ratio of three channels: its estimate, and χ² of what it leaves.
        variance = 1.3**2 * ((ERRORS[light] / a) ** 2 + (2 * ERRORS[light] / b) ** 2)
        ratio = np.log(b / a)
        mean, weight = np.average(ratio, weights=1 / variance, returned=True)
        assert lights.brightness[light] == pytest.approx(np.exp(mean) - 1)
        assert lights.angle_p[light] == pytest.approx(stats.chi2.sf(((ratio - mean) ** 2 / variance).sum(), 2))
        assert lights.brightness_p[light] == pytest.approx(2 * stats.norm.sf(abs(mean) * np.sqrt(weight)))


def test_cell_differences_are_relative_to_white_and_noise(
    tables: tuple[Any, Any],
) -> None:
    one, other = tables
    cells, scores = comparing._compare_cells(one, other, PAIRS, lambda done, total: None)
    # By Welch and Satterthwaite, 4 and 9 samples of one variance have so many freedoms.
    freedoms = (1 / 4 + 1 / 9) ** 2 / ((1 / 4) ** 2 / 3 + (1 / 9) ** 2 / 8)
    widening = float(stats.t(freedoms).std())
    share, variance = np.full((4, 8, 3), np.nan), np.full((4, 8, 3), np.nan)
    for light, colour, channel in np.ndindex(4, 6, 3):
        values_of_both = [each.samples[light, colour, :, channel].astype(float) for each in (one, other)]
        if min(values.mean() for values in values_of_both) > 300:
            a, b = (
                values.mean() / each.white[light, channel]
                for values, each in zip(values_of_both, (one, other), strict=True)
            )
            share[light, colour, channel] = b / a - 1
            variance[light, colour, channel] = sum(
                max(values.var(ddof=1), 1 / 12) / len(values) / values.mean() ** 2 for values in values_of_both
            )
    score = share / np.sqrt(variance) / widening
    is_compared = np.isfinite(share)
    assert 20 < is_compared.sum() < 60
    assert np.isnan(scores[2]), "nothing is bright enough under the third light"
    for light in (0, 1, 3):
        assert scores[light] ** 2 == pytest.approx((score**2)[light][is_compared[light]].mean())
    count = is_compared.sum(axis=0)
    np.testing.assert_array_equal(cells.lights, count)
    known = count > 0
    np.testing.assert_array_equal(np.isfinite(cells.mean), known)
    np.testing.assert_allclose(cells.mean[known], np.nansum(share, axis=0)[known] / count[known])
    np.testing.assert_allclose(cells.noise[known], np.sqrt(np.nansum(variance, axis=0)[known]) / count[known])
    overall = np.sqrt([np.nanmean(score**2), np.nanmean(share**2), np.nanmean(variance)])
    assert [cells.score, cells.rms, cells.rms_by_noise] == pytest.approx(overall)
    assert cells.offset == pytest.approx([np.nanmean(share[..., channel]) for channel in range(3)])


def lights_with(count: int = 4, **more: npt.ArrayLike) -> LightDifferences:
    """Return lights without differences, except the given ones."""
    plain = {name: np.zeros(count) for name in ("angle_deg", "brightness", "cell_score")}
    plain |= {name: np.ones(count) for name in ("angle_p", "brightness_p")}
    columns = plain | {name: np.asarray(value, dtype=np.float64) for name, value in more.items()}
    number = np.arange(count) + 10
    return LightDifferences(one=number, other=number, **columns)


def cells_with(mean: _Array, noise: float, score: float = 1.0) -> CellDifferences:
    """Return cells that differ by means (C, 3), with a noise."""
    count = np.ones(mean.shape, dtype=np.int64)
    return CellDifferences(count, mean, np.full(mean.shape, noise), np.array([0.1, 0, 0]), 0, 0, score)


def test_difference_exceeds_noise_and_floor() -> None:
    # A chance of one in a hundred in any of four lights.
    lights = lights_with(angle_deg=[0.0051, 0.0049, 0.02, 0.03], angle_p=[0.0024, 0.0024, 0.0026, 0.0024])
    assert differing_lights(lights).tolist() == [10, 13]
    # Six standard errors and the two per cent of a stain, less the offset of all.
    assert CELL_FLOOR == 0.02
    mean = np.array(
        [[0.1, 0, CELL_FLOOR * 1.01], [0.1 - 2 * CELL_FLOOR, 0, 0], [0.1, 0.99 * CELL_FLOOR, 0], [0.1, 0, 0]]
    )
    assert differing_cells(cells_with(mean, CELL_FLOOR / 6.1)).tolist() == [1, 0]
    assert differing_cells(cells_with(mean, 1.05 * CELL_FLOOR / 6)).tolist() == [1]
    assert differing_cells(cells_with(0 * mean + [0.1, 0, 0], 1e-9)).tolist() == []


@pytest.mark.parametrize(
    ("off", "chance", "same"), [(0.0019, 1e-9, True), (-0.0021, 0.0024, False), (0.0021, 0.0026, True)]
)
def test_brightness_is_same_within_noise_or_floor(off: float, chance: float, same: bool) -> None:
    lights = lights_with(brightness=[off, 0, 0, 0], brightness_p=[chance, 1, 1, 1])
    assert comparing._brightness_answer(lights).same_within_noise is same


def test_brightness_interval_contains_median() -> None:
    one = comparing._brightness_answer(lights_with(1, brightness=[0.015]))
    assert "+1.500 % median (95 % interval +1.500 to +1.500 %)" in one.said
    many = comparing._brightness_answer(lights_with(101, brightness=np.linspace(-0.01, 0.03, 101)))
    # Ranks 41 and 61 of the 101 lights, by the binomial distribution: +0.6 to +1.4 %.
    low, high = map(float, re.findall(r"interval (\S+) to (\S+) %", many.said)[0])
    assert (low, high) == pytest.approx((0.6, 1.4), abs=0.05)


@pytest.mark.parametrize(("score", "of_light", "same"), [(1.1, 1.3, True), (1.11, 1.3, False), (1.1, 1.31, False)])
def test_cells_are_same_up_to_score_limits(score: float, of_light: float, same: bool) -> None:
    calm = cells_with(np.tile([0.1, 0, 0], (4, 1)), 1e-9)
    lights = lights_with(cell_score=[0, of_light, 0, 0])
    assert comparing._cells_answer(lights, replace(calm, score=score)).same_within_noise is same


FEW = LIGHTS[:7]


@pytest.fixture(scope="module")
def small() -> Lab:
    """Return a lab with few colours, in which the lens and its error are not measured."""
    return hang(2, "A6")


@pytest.fixture(scope="module")
def folders(small: Lab, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return two sessions in the same room on different days: another sheet, other noise, a dimmer lamp."""
    place = tmp_path_factory.mktemp("compared")
    again = hang(2, "A6", room=Room(seed=7, waviness_mm=0.5, roll_deg=0.6, white_level_share=0.69))
    for name, room in (("monday", small), ("friday", again)):
        take(room, place / name, FEW, every=4).close()
    return place / "monday", place / "friday"


@pytest.mark.slow
def test_two_days_differ_only_in_brightness(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report"
    assert main(["compare", *map(str, folders), "--json", "--out", str(out)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [each["same_within_noise"] for each in document["answers"]] == [True, False, True]
    assert document["brightness"]["median"] == pytest.approx(0.69 / 0.7 - 1, abs=2.5e-3)
    assert {path.name for path in out.iterdir()} == {"report.html", "comparison.json", "cells.csv", "lights.csv"}
    page = (out / "report.html").read_text()
    assert "Differences of patches on the print." in page, "a session has its chart"
    # Nothing stays beside the sessions.
    assert {path.name for path in folders[0].parent.iterdir()} == {"monday", "friday"}


@pytest.mark.slow
def test_same_room_with_other_noise_is_same(folders: tuple[Path, Path], small: Lab, tmp_path: Path) -> None:
    with take(small, tmp_path / "again", FEW, every=4, frame=lambda step: small.dng(step.colour, 900 + step.number)):
        pass
    with table_of(folders[0]) as one, table_of(tmp_path / "again") as other:
        result = compare(one, other)
    assert result.same_within_noise
    assert float(result.lights.angle_deg.max()) < 0.05


@pytest.mark.slow
def test_reports_frame_that_ends_build_for_retake(small: Lab, tmp_path: Path) -> None:
    def nothing(counts: npt.NDArray[np.uint16]) -> None:
        counts[...] = counts.min()

    def frame(step: SessionStep) -> bytes:
        return small.dng(step.colour, step.number, paint=nothing if step.illumination == 1 else None)

    take(small, tmp_path / "dim", FEW, every=4, frame=frame).close()
    with pytest.raises(QualityError, match="--retake bad"), table_of(tmp_path / "dim"):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"dim", "dim.refused"}
    with Session.open(tmp_path / "dim") as session:
        assert [frame.illumination for frame in session.plan_retake("bad").frames] == [1]


@pytest.mark.slow
def test_compares_table_with_session(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Session.open(folders[0]) as session:
        build(session, tmp_path / "lut")
    assert main(["compare", str(tmp_path / "lut"), str(folders[0])]) == 0
    assert "warning: both LUTs" in capsys.readouterr().out
