"""Frames in the order of the journal, with increasing times whatever the clock was set to."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline import measuring
from calibration.pipeline.frames import select_frames, stated_origin
from calibration.pipeline.measuring import background_counts, usable_means
from calibration.sampling import sites_at
from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.chart.layout import design_chart
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.journal import ReceivedFile
from experiment.session.records import Judgement, plan_steps

AT = datetime(2024, 3, 1, 23, 0, tzinfo=UTC)
LIGHTS = tuple(Illuminant(n, "uniform", None, Colour(255, 20 * n, 255 - n)) for n in range(5))
STEPS = plan_steps(LIGHTS, 2)


@pytest.fixture
def taken(tmp_path: Path) -> Callable[[Sequence[float]], Session]:
    """Return a maker of sessions whose frames were taken at seconds after `AT` by their clock."""

    def make(seconds: Sequence[float]) -> Session:
        with Session.create(tmp_path / "s", 'rig = "simulated"\n', design_chart(1), LIGHTS, STEPS) as session:
            for step, after in zip(STEPS, seconds, strict=True):
                at, data = AT + timedelta(seconds=after), step.stem.encode()
                attempt = session.journal.begin(step, f"frames/{step.stem}.cr2", at)
                path = session.frames_folder / f"{step.stem}.cr2"
                path.write_bytes(data)
                captured = CapturedFrame(path.name, len(data), at)
                received = ReceivedFile(path, len(data), hashlib.sha256(data).hexdigest(), captured)
                session.journal.commit(attempt, received, Judgement(()), exposure_s=0.5, ended_at=at)
        return Session.open_for_run(tmp_path / "s")

    return make


def test_keeps_times_of_steady_clock(taken: Callable[[Sequence[float]], Session]) -> None:
    seconds = [4.0 * number for number in range(len(STEPS))]
    with taken(seconds) as session:
        records = select_frames(session).records
    assert [(record.taken_at - AT).total_seconds() for record in records] == seconds
    assert [record.file for record in records] == [f"frames/{step.stem}.cr2" for step in STEPS]


def test_clock_set_back_continues_by_usual_interval(taken: Callable[[Sequence[float]], Session]) -> None:
    back = [4.0 * number - (3600 if number >= 5 else 0) - (90 if number >= 8 else 0) for number in range(len(STEPS))]
    with taken(back) as session:
        selected = select_frames(session)
        assert [record.file for record in selected.records] == [f"frames/{step.stem}.cr2" for step in STEPS]
        assert selected.newest.file == f"frames/{STEPS[-2].stem}.cr2", "the last one is dark"
        raw = [frame.taken_at for frame in session.frames()]
    gaps = [(after.taken_at - before.taken_at).total_seconds() for before, after in pairwise(selected.records)]
    assert gaps == [4.0] * (len(STEPS) - 1)
    assert raw == [AT + timedelta(seconds=one) for one in back], "the journal says what the clock said"


def test_imported_frames_keep_their_times(taken: Callable[[Sequence[float]], Session]) -> None:
    # A list may name the lights in the order of their numbers, whenever they were taken.
    listed = [float(7 * number % len(STEPS)) for number in range(len(STEPS))]
    with taken(listed) as session:
        session.journal.note(AT, "import", "13 frames from frames.csv")
        records = select_frames(session).records
    assert [(record.taken_at - AT).total_seconds() for record in records] == sorted(listed)


@pytest.mark.parametrize("text", ["", "rig = ["])
def test_warns_of_damaged_settings(
    taken: Callable[[Sequence[float]], Session], text: str, caplog: pytest.LogCaptureFixture
) -> None:
    with taken([float(number) for number in range(len(STEPS))]) as session:
        (session.folder / "session.toml").write_text(text)
        assert stated_origin(session).rig is None
    assert "session.toml" in caplog.text
    assert "will not contain origin" in caplog.text


@pytest.mark.parametrize(("rig", "iso"), [("lab", 200), ("simulated", 200), ("imported", None)])
def test_exposure_comes_from_settings_that_set_camera(
    taken: Callable[[Sequence[float]], Session], rig: str, iso: int | None
) -> None:
    with taken([float(number) for number in range(len(STEPS))]) as session:
        (session.folder / "session.toml").write_text(f'rig = "{rig}"\n[camera]\niso = 200\n')
        stated = stated_origin(session)
    assert stated.rig == rig
    assert (None if stated.camera is None else stated.camera.iso) == iso


def test_outside_or_clipped_patches_have_no_mean() -> None:
    samples = np.arange(4 * 25 * 3, dtype=np.float32).reshape(4, 25, 3)
    sites = sites_at(np.array([[10.0, 10], [1, 10], [20, 20], [20, 10]]), (40, 40))
    limit = round(CLIPPING_SHARE * 10_000)
    assert limit == CLIPPING_SHARE * 10_000
    means = usable_means(samples, np.array([limit - 1, 50, limit, 50], dtype=np.uint16), sites, 10_000)
    assert np.isnan(means).all(axis=1).tolist() == [False, True, True, False]
    np.testing.assert_allclose(means[[0, 3]], samples[[0, 3]].mean(axis=1))


def test_background_is_mean_beside_print(monkeypatch: pytest.MonkeyPatch) -> None:
    def gathered(mosaic: object, black: object, sites: Any) -> npt.NDArray[np.float64]:
        return np.arange(3.0 * len(sites.rows)).reshape(-1, 3)

    monkeypatch.setattr(measuring, "gather_means", gathered)
    decoded: Any = SimpleNamespace(mosaic=None, black=None)
    places = np.array([[10.0, 10], [20, 20]])
    assert background_counts(decoded, sites_at(places, (40, 40))).tolist() == [1.5, 2.5, 3.5]
    assert background_counts(decoded, sites_at(places[:0], (40, 40))).tolist() == [0, 0, 0]
