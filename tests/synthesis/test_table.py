"""A computed table is a table, says that it was computed, and equals a photographed one within its noise."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from calibration.table.verification import find_faults
from experiment.lights import plan_illuminations
from foundation.errors import InputError, QualityError, StorageError
from sim.world.sensors import BODIES
from sim.world.world import Room
from synthesis.settings import TableSettings, parse_settings, table_task
from synthesis.table import TableTask, compute_table
from tests.calibration.lab import LIGHTS, SETTINGS, designed, hang, take
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

ROOM = Room(waviness_mm=0.5, vignetting=0.08, projector_falloff=0.05)
"""A small page has large cells, across which light that falls off as in the default room has a slope of its own."""


def task_of(bits: int = 3, page: str = "A5", window: int = 5, **room: float) -> TableTask:
    chart = designed(bits, page, 1)[0]
    return TableTask(chart, BODIES["Test"], replace(ROOM, **room), SETTINGS, LIGHTS, None, window, {"by": "test"})  # pyrefly: ignore[bad-argument-type]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Cells of two tables, light by light: how far means and spreads differ, in units of what noise allows."""

    normal: npt.NDArray[np.float64]
    """(L, C, 3), difference of the means over its standard error."""
    spread: npt.NDArray[np.float64]
    """(L, 3), mean standard deviation of one table over that of the other."""
    white: npt.NDArray[np.float64]
    """(L, 3), relative difference of the ground truths."""


def compared(one: Lut, other: Lut) -> Comparison:
    a, b = np.asarray(one.samples, dtype=np.float64), np.asarray(other.samples, dtype=np.float64)
    spreads = [table.var(axis=2, ddof=1) for table in (a, b)]
    error = np.sqrt((spreads[0] + spreads[1]) / a.shape[2])
    normal = (a.mean(axis=2) - b.mean(axis=2)) / error
    return Comparison(normal, np.sqrt(spreads[0].mean(axis=1) / spreads[1].mean(axis=1)), one.white / other.white - 1)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Lut:
    """Return a table of frames, built as build-lut does; the lens is sharp, so that no light leaks between cells."""
    folder = tmp_path_factory.mktemp("photographed")
    with take(hang(room=replace(ROOM, blur_px=0.05)), folder / "session", LIGHTS) as session:
        build(session, folder / "lut")
    return open_lut(folder / "lut")


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory) -> Lut:
    out = tmp_path_factory.mktemp("computed") / "lut"
    compute_table(task_of(), out, threads=2)
    return open_lut(out)


def test_a_computed_table_equals_a_photographed_one_within_its_noise(computed: Lut, photographed: Lut) -> None:
    found = compared(computed, photographed)
    lit = np.asarray(photographed.samples).mean(axis=(1, 2)) > 20
    # Student's t of 48 degrees of freedom has a standard deviation of 1.02; 512 cells tell it to 3 %.
    spread = found.normal.std(axis=1)[lit]
    assert spread.min() > 0.93
    assert spread.max() < 1.15
    assert abs(float(spread.mean()) - 1.022) < 0.02
    # The mean over 512 cells has a standard error of .044, and both ground truths' errors move a whole light.
    assert float(np.abs(found.normal.mean(axis=1)[lit]).max()) < 0.35
    assert float(np.abs(found.normal).max()) < 6.5
    assert float(np.abs(found.spread - 1)[lit].max()) < 0.03
    assert abs(float(found.spread[lit].mean()) - 1) < 0.004


def test_the_ground_truths_differ_by_no_more_than_their_errors(computed: Lut, photographed: Lut) -> None:
    bright = photographed.white > 500
    assert float(np.abs(compared(computed, photographed).white)[bright].max()) < 2e-3


@pytest.mark.parametrize(
    "changes", [{"electrons_per_dn": 1.5}, {"read_noise_dn": 9.0}, {"sensitivities": "Canon_EOS_200D"}]
)
def test_the_comparison_sees_another_sensor(photographed: Lut, tmp_path: Path, changes: dict[str, float | str]) -> None:
    body = replace(BODIES["Test"], **changes)  # pyrefly: ignore[bad-argument-type]
    compute_table(replace(task_of(), body=body), tmp_path / "lut", threads=2)
    found = compared(open_lut(tmp_path / "lut"), photographed)
    assert abs(float(found.spread.mean()) - 1) > 0.01 or float(np.abs(found.normal.mean(axis=1)).max()) > 1


def test_a_computed_table_is_whole_and_says_that_it_was_computed(computed: Lut) -> None:
    assert find_faults(computed) == []
    assert computed.provenance.computed == {"by": "test"}
    assert computed.frames == ()
    assert not (computed.folder / "frames.csv").exists()
    assert computed.provenance.chart_sha256 == designed(3, "A5", 1)[0].sha256


def test_a_photographed_table_does_not_say_so(photographed: Lut) -> None:
    assert "computed" not in json.loads((photographed.folder / "lut.json").read_text())


def test_threads_do_not_change_the_bytes_and_the_seed_does(computed: Lut, tmp_path: Path) -> None:
    alone = compute_table(task_of(), tmp_path / "alone", threads=1)
    assert open_lut(alone.folder).sha256 == computed.sha256
    other = compute_table(replace(task_of(), room=replace(ROOM, seed=7)), tmp_path / "other", threads=2)
    assert open_lut(other.folder).provenance.samples_sha256 != computed.provenance.samples_sha256


def test_overexposed_cells_are_unfit_and_overexposed_paper_is_refused(tmp_path: Path, pinned: Pinned) -> None:
    # The middle of the page is brighter than its corners, where enough references are still below the limit.
    done = compute_table(
        task_of(white_level_share=2.0, projector_falloff=0.7, vignetting=0.25), tmp_path / "bright", threads=2
    )
    lut = open_lut(done.folder)
    assert done.unfit == len(lut.provenance.unfit) > 0
    assert all(cell.cause.startswith("clipped: ") for cell in lut.provenance.unfit)
    assert {cell.colour for cell in lut.provenance.unfit} < set(range(512))
    pinned("overexposed cells of a computed table", [lut.provenance.unfit[::9], lut.white])
    with pytest.raises(QualityError, match=r"frame of white.*expose less"):
        compute_table(task_of(white_level_share=1.6), tmp_path / "over", threads=2)
    assert not (tmp_path / "over").exists()


def small_disk(path: Path) -> SimpleNamespace:
    return SimpleNamespace(free=1 << 20)


def test_a_taken_place_and_a_small_disk_are_refused_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    with pytest.raises(InputError, match="already exists"):
        compute_table(task_of(), tmp_path / "taken", threads=1)
    monkeypatch.setattr("shutil.disk_usage", small_disk)
    with pytest.raises(StorageError, match=r"0\.02 GB, the disk has 0\.00 GB"):
        compute_table(task_of(), tmp_path / "new", threads=1)
    assert not (tmp_path / "new").exists()


def test_the_usual_task_is_the_projectors_707_lights_under_which_a_session_is_taken() -> None:
    task = table_task("Canon_EOS_5DS", parse_settings({"chart": {"bits": 1}}, "here"), "here")
    assert task.illuminations == plan_illuminations()
    assert task.body.model == "Canon EOS 5DS"
    assert task.exposure == SETTINGS
    assert task.room == Room(seed=TableSettings().seed, lamp_drift_per_hour=0)


def test_where_a_file_of_sensitivities_lies_is_not_recorded(tmp_path: Path) -> None:
    data = resources.files("sim").joinpath("data", "Canon_EOS_5DS_380_780_5.json").read_bytes()
    records: list[dict[str, Any]] = []
    for place in ("here", "there"):
        path = tmp_path / place / "mine.json"
        path.parent.mkdir()
        path.write_bytes(data)
        records.append(table_task(str(path), parse_settings({"chart": {"bits": 1}}, "here"), "here").record)
    assert records[0] == records[1]
    assert records[0]["body"]["sensitivities"] == records[0]["sensitivities"]["name"] == "mine"


def test_hot_photosites_are_in_the_samples_of_every_light_and_in_no_list(computed: Lut, tmp_path: Path) -> None:
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
