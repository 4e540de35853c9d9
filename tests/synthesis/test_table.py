"""A computed LUT is complete, records that it was computed, and equals a photographed one within noise."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from calibration.table.verification import find_faults
from evaluation.datasets.generated import open_generated
from experiment.lights import load_illuminants
from foundation.errors import FormatError, InputError, QualityError, StorageError
from generator.cli import main as generate
from sim.spectral import print_reflectance, printed_reflectance, sensitivities
from sim.world.sensors import BODIES
from sim.world.world import Room
from synthesis.lamps import LightSpectra, read_lights
from synthesis.settings import parse_settings, table_task
from synthesis.table import TableTask, compute_table
from tests.calibration.lab import LIGHTS, SETTINGS, designed, hang, take
from tests.generator.dataset.known import rows_of
from tests.pinned import Pinned

ROOM = Room(waviness_mm=0.5, vignetting=0.08, projector_falloff=0.05)
"""A small page has large cells, across which light that falls off as in the default room has a slope of its own."""


def task_of(bits: int = 3, page: str = "A5", window: int = 5, **room: float) -> TableTask:
    chart = designed(bits, page, 1)[0]
    return TableTask(chart, BODIES["Test"], replace(ROOM, **room), SETTINGS, LIGHTS, None, window, {"by": "test"})  # pyrefly: ignore[bad-argument-type]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences of two LUTs, in units of the noise."""

    normal: npt.NDArray[np.float64]
    """(L, C, 3), difference of the means over its standard error."""
    spread: npt.NDArray[np.float64]
    """(L, 3), mean standard deviation of the first LUT relative to the second."""
    white: npt.NDArray[np.float64]
    """(L, 3), relative difference of the ground truths."""


def compared(first: Lut, second: Lut) -> Comparison:
    a, b = np.asarray(first.samples, dtype=np.float64), np.asarray(second.samples, dtype=np.float64)
    spreads = [table.var(axis=2, ddof=1) for table in (a, b)]
    error = np.sqrt((spreads[0] + spreads[1]) / a.shape[2])
    normal = (a.mean(axis=2) - b.mean(axis=2)) / error
    return Comparison(
        normal, np.sqrt(spreads[0].mean(axis=1) / spreads[1].mean(axis=1)), first.white / second.white - 1
    )


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Lut:
    """Return a LUT of frames, built as build-lut does; with a sharp lens, so that no light leaks between patches."""
    folder = tmp_path_factory.mktemp("photographed")
    with take(hang(room=replace(ROOM, blur_px=0.05)), folder / "session", LIGHTS) as session:
        build(session, folder / "lut")
    return open_lut(folder / "lut")


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory) -> Lut:
    out = tmp_path_factory.mktemp("computed") / "lut"
    compute_table(task_of(), out, threads=2)
    return open_lut(out)


@pytest.mark.slow
def test_equals_a_photographed_lut_within_noise(computed: Lut, photographed: Lut) -> None:
    comparison = compared(computed, photographed)
    lit = np.asarray(photographed.samples).mean(axis=(1, 2)) > 20
    # Student's t of 48 degrees of freedom has a standard deviation of 1.02; 512 cells tell it to 3 %.
    spread = comparison.normal.std(axis=1)[lit]
    assert spread.min() > 0.93
    assert spread.max() < 1.15
    assert abs(float(spread.mean()) - 1.022) < 0.02
    # The mean over 512 cells has a standard error of .044, and both ground truths' errors move a whole light.
    assert float(np.abs(comparison.normal.mean(axis=1)[lit]).max()) < 0.35
    assert float(np.abs(comparison.normal).max()) < 6.5
    assert float(np.abs(comparison.spread - 1)[lit].max()) < 0.03
    assert abs(float(comparison.spread[lit].mean()) - 1) < 0.004


@pytest.mark.slow
def test_ground_truths_agree_within_their_errors(computed: Lut, photographed: Lut) -> None:
    bright = photographed.white > 500
    assert float(np.abs(compared(computed, photographed).white)[bright].max()) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [{"electrons_per_dn": 1.5}, {"read_noise_dn": 9.0}, {"sensitivities": "Canon_EOS_200D"}]
)
def test_comparison_detects_another_sensor(photographed: Lut, tmp_path: Path, changes: dict[str, float | str]) -> None:
    body = replace(BODIES["Test"], **changes)  # pyrefly: ignore[bad-argument-type]
    compute_table(replace(task_of(), body=body), tmp_path / "lut", threads=2)
    comparison = compared(open_lut(tmp_path / "lut"), photographed)
    assert abs(float(comparison.spread.mean()) - 1) > 0.01 or float(np.abs(comparison.normal.mean(axis=1)).max()) > 1


@pytest.mark.slow
def test_is_complete_and_recorded_as_computed(computed: Lut) -> None:
    assert find_faults(computed) == []
    assert computed.provenance.computed == {"by": "test"}
    assert computed.frames == ()
    assert not (computed.folder / "frames.csv").exists()
    assert computed.provenance.chart_sha256 == designed(3, "A5", 1)[0].sha256


@pytest.mark.slow
def test_bytes_depend_on_seed_not_on_threads(computed: Lut, tmp_path: Path) -> None:
    alone = compute_table(task_of(), tmp_path / "alone", threads=1)
    assert open_lut(alone.folder).sha256 == computed.sha256
    second = compute_table(replace(task_of(), room=replace(ROOM, seed=7)), tmp_path / "other", threads=2)
    assert open_lut(second.folder).provenance.samples_sha256 != computed.provenance.samples_sha256


@pytest.mark.slow
def test_lists_clipped_cells_and_refuses_clipped_paper(tmp_path: Path, pinned: Pinned) -> None:
    # The middle of the page is brighter than its corners, where enough references are still below the limit.
    result = compute_table(
        task_of(white_level_share=2.0, projector_falloff=0.7, vignetting=0.25), tmp_path / "bright", threads=2
    )
    lut = open_lut(result.folder)
    assert result.unfit == len(lut.provenance.unfit) > 0
    assert all(cell.cause.startswith("clipped: ") for cell in lut.provenance.unfit)
    assert {cell.colour for cell in lut.provenance.unfit} < set(range(512))
    pinned("overexposed cells of a computed table", [lut.provenance.unfit[::9], lut.white])
    with pytest.raises(QualityError, match=r"white frame: 0 of 144 references"):
        compute_table(task_of(white_level_share=1.6), tmp_path / "over", threads=2)
    assert not (tmp_path / "over").exists()


@pytest.mark.slow
def test_refuses_existing_folder_and_small_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    with pytest.raises(InputError):
        compute_table(task_of(), tmp_path / "taken", threads=1)
    monkeypatch.setattr("shutil.disk_usage", Mock(return_value=SimpleNamespace(free=1 << 20)))
    with pytest.raises(StorageError, match=r"0\.02 GB, the disk has 0\.00 GB"):
        compute_table(task_of(), tmp_path / "new", threads=1)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_does_not_record_the_path_of_sensitivities(tmp_path: Path) -> None:
    data = resources.files("sim").joinpath("data", "Canon_EOS_5DS_380_780_5.json").read_bytes()
    records: list[dict[str, Any]] = []
    for folder in ("here", "there"):
        path = tmp_path / folder / "mine.json"
        path.parent.mkdir()
        path.write_bytes(data)
        records.append(table_task(str(path), parse_settings({"chart": {"bits": 1}}, "here"), "here").record)
    assert records[0] == records[1]
    assert records[0]["body"]["sensitivities"] == records[0]["sensitivities"]["name"] == "mine"


@pytest.mark.slow
def test_samples_contain_hot_photosites(computed: Lut, tmp_path: Path) -> None:
    task = task_of(hot_per_million=100.0, hot_dn_per_s=4000.0)
    hot = open_lut(compute_table(task, tmp_path / "lut", threads=2).folder)
    apart = np.asarray(hot.samples, dtype=np.float64) - np.asarray(computed.samples, dtype=np.float64)
    raised = np.abs(apart) > 200
    # 512 cells of 100 photosites and 100 a million: some five, the same ones under every light.
    assert 2 <= raised.any(axis=0).sum() <= 12
    assert (apart[raised] > 0).all()
    steady = raised.all(axis=0)
    assert steady.sum() >= 2
    assert np.ptp(apart[:, steady], axis=0).max() < 0.25 * apart[:, steady].max()
    assert {cell.cause.split(":")[0] for cell in hot.provenance.unfit} <= {"clipped"}


CAMERA = "Canon_EOS_5D_Mark_II"


SMALL = parse_settings({"chart": {"bits": 2}}, "here")


@pytest.fixture(scope="module")
def lights() -> LightSpectra:
    return read_lights("D65,FL2,A,LED-RGB1,3000K,6000K")


@pytest.fixture(scope="module")
def lut(lights: LightSpectra, tmp_path_factory: pytest.TempPathFactory) -> Lut:
    out = tmp_path_factory.mktemp("spectral") / "lut"
    compute_table(table_task(CAMERA, SMALL, "here", lights), out, threads=2)
    return open_lut(out)


@pytest.mark.slow
def test_ground_truth_is_the_response_to_bare_paper(lut: Lut, lights: LightSpectra) -> None:
    powers = np.array([light.power for light in lights.lights])
    response = np.einsum("lw,w,wc->lc", powers, print_reflectance([(255, 255, 255)])[0], sensitivities(CAMERA))
    truth = response / response.sum(axis=1, keepdims=True)
    # Some sixty white patches of 25 samples, each noisy by a percent at most.
    assert lut.ground_truth == pytest.approx(truth, rel=2e-3)


@pytest.mark.slow
def test_patches_are_the_response_to_their_ink(lut: Lut, lights: LightSpectra) -> None:
    codes = np.stack(np.meshgrid(*[np.arange(4) * 64] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for number, light in enumerate(lights.lights):
        curves = light.power[:, None] * sensitivities(CAMERA)
        cells = print_reflectance(codes) @ curves / (print_reflectance([(255, 255, 255)]) @ curves)
        samples = lut.samples[number].astype(np.float64)
        error = samples.std(axis=1, ddof=1) / 5 + 2e-3 * samples.mean(axis=1)
        assert float(np.abs((samples.mean(axis=1) - cells * lut.white[number]) / error).max()) < 5


@pytest.mark.slow
def test_all_lights_have_equal_exposure(lut: Lut) -> None:
    brightest = lut.white.max(axis=1)
    assert float(brightest.max() / brightest.min()) == pytest.approx(1, abs=3e-3)


@pytest.mark.slow
def test_refuses_spectra_in_a_session_plan(lut: Lut) -> None:
    with pytest.raises(FormatError, match=r"'spectrum'.* blackbody"):
        load_illuminants(lut.folder / "illuminations.csv")


@pytest.mark.slow
def test_lut_depends_on_the_print(lights: LightSpectra, tmp_path: Path) -> None:
    task = table_task(CAMERA, SMALL, "here", lights)
    managed = replace(task, room=replace(task.room, profile="managed", paper="glossy"))
    compute_table(managed, tmp_path / "lut", threads=2)
    lut = open_lut(tmp_path / "lut")
    curves = lights.lights[0].power[:, None] * sensitivities(CAMERA)
    black, white = printed_reflectance([(0, 0, 0), (255, 255, 255)], "managed", "glossy") @ curves
    assert lut.samples[0, 0].mean(axis=0) / lut.white[0] == pytest.approx(black / white, rel=0.15)


@pytest.mark.slow
def test_datasets_record_that_the_lut_was_computed(lut: Lut, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)).save(pictures / "a.png")
    out = tmp_path / "dataset"
    assert generate([str(lut.folder), str(out), "--sources", str(pictures), "--light", "LED-RGB1"]) == 0
    description = json.loads((out / "dataset.json").read_text())
    assert description["table"]["computed"] == lut.provenance.computed
    assert [light["name"] for light in description["lights"]] == ["LED-RGB1"]
    assert open_generated(out).treatment["table"] == "computed from spectra and a model of the sensor"


SMALLEST: dict[str, Any] = {"chart": {"bits": 1, "seed": 3}, "seed": 8}


CASES: dict[str, tuple[str, dict[str, Any], str | None]] = {
    "spectra": ("Canon_EOS_5D_Mark_II", SMALLEST, "D65,FL2,3000K,daylight:6500"),
    "spectra with a large window": (
        "EOS 6D Mark II",
        {**SMALLEST, "window": 7, "room": {"paper": "matt", "response_spread": 0.02}},
        "A,LED-B3",
    ),
    "hot photosites": (
        "Test",
        {**SMALLEST, "room": {"hot_per_million": 3000.0, "hot_dn_per_s": 900.0}, "exposure": {"iso": 800}},
        "D50",
    ),
    "a managed print": (
        "EOS 550D",
        {**SMALLEST, "room": {"profile": "managed", "white_level_share": 0.5}},
        "E,cie-hp",
    ),
}


def content_of(folder: Path) -> dict[str, Any]:
    """Return the content of a LUT, without software versions and hashes that depend on them."""
    described = json.loads((folder / "lut.json").read_text())
    keys = (
        "camera",
        "bits",
        "white_level",
        "corrections",
        "chart_sha256",
        "unfit",
        "samples_sha256",
        "computed",
        "origin",
    )
    lists = {path.name: rows_of(path.read_text()) for path in sorted(folder.glob("*.csv"))}
    lut = open_lut(folder)
    return {
        "described": {name: described.get(name) for name in keys},
        "lists": {name: rows[:30] for name, rows in lists.items()},
        "white": lut.white,
        "means": np.asarray(lut.samples).mean(axis=2),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_pinned_luts_of_spectra(name: str, tmp_path: Path, pinned: Pinned) -> None:
    camera, document, lights = CASES[name]
    citation = {"note": "a note", "licence": "CC0-1.0", "authors": ["One"]}
    settings = parse_settings({**document, "citation": citation}, "here")
    task = table_task(camera, settings, "here", None if lights is None else read_lights(lights))
    result = compute_table(task, tmp_path / "lut", 1)
    pinned(f"computed table, {name}", [result.unfit, result.cells, content_of(result.folder)])


@pytest.mark.slow
def test_pinned_lut_of_the_projector(tmp_path: Path, pinned: Pinned) -> None:
    task = task_of(bits=1, page="A6", hot_per_million=200.0)
    result = compute_table(replace(task, illuminations=task.illuminations[:3]), tmp_path / "lut", 1)
    pinned("computed table, the projector", content_of(result.folder))
