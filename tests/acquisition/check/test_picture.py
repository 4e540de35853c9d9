"""Picture of a check: flat field, blur of every tag, deviating patches, and verdicts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from acquisition.check.exposure import Saturation
from acquisition.check.findings import CheckReport, Finding
from acquisition.check.picture import check_png
from acquisition.check.trial import Trial, measure_trial, trial_lights, trial_steps
from benchmarks.sessions import record_session
from calibration.verdict import Verdict
from sim.world.world import Room
from tests.calibration.lab import Lab, hang

FINDINGS = (Finding("turn", "good", "level"), Finding("disk", "fault", "full", remedy="free space"))


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the list of figures saved during the test."""
    figures = list[Any]()
    save = Figure.savefig

    def saved(figure: Figure, *args: Any, **options: Any) -> None:
        figures.append(figure)
        save(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", saved)
    return figures


def trial_of(lab: Lab, folder: Path) -> Trial:
    lights = trial_lights((), np.eye(3))
    steps = trial_steps(lights)
    with record_session(
        folder, lab.chart, lights, lambda step: lab.dng(step.colour, step.number), steps=steps
    ) as session:
        return measure_trial(session, Saturation(13584, True, 15831), None, None)


@pytest.mark.slow
def test_draws_light_blur_print_and_verdicts(tmp_path: Path, drawn: list[Any]) -> None:
    lab = hang(3, room=Room(waviness_mm=0.5, stain_mm=20.0, stain_depth=0.3))
    trial = trial_of(lab, tmp_path / "session")
    assert trial.table is not None
    png = check_png(trial, lab.chart, CheckReport((), FINDINGS))
    assert png[:4] == b"\x89PNG"
    (figure,) = drawn
    _, light, blur, print_, verdicts = (axes for axes in figure.axes if axes.get_label() != "<colorbar>")
    width, height = lab.chart.page_mm
    for axes in (light, blur, print_):
        assert (axes.get_xlim(), axes.get_ylim()) == ((0, width), (height, 0))
    (tags,) = blur.collections
    assert isinstance(tags, PathCollection)
    tags_mm = np.asarray(tags.get_offsets())
    assert len(tags_mm) == len(blur.texts) == len(lab.chart.tags)
    for tag in lab.chart.tags:
        # Lens and waves move a tag by a millimetre.
        assert np.linalg.norm(tags_mm - tag.corners_mm.mean(axis=0), axis=1).min() < 3
    cells, stained = print_.collections
    stains = trial.table.cells.stains
    np.testing.assert_allclose(np.asarray(cells.get_offsets()), stains.places_mm)
    np.testing.assert_allclose(np.asarray(stained.get_offsets()), stains.places_mm[stains.stained])
    assert len(np.asarray(stained.get_offsets())) > 3
    lines = [text.get_text() for text in verdicts.texts]
    assert [line.split()[0] for line in lines] == ["fault", "good"]


@pytest.mark.slow
def test_draws_only_frame_without_chart(tmp_path: Path, drawn: list[Any]) -> None:
    lab = hang()
    trial = Trial(lab.mosaic(tmp_path), None, Verdict(()), trouble="not found")
    assert check_png(trial, lab.chart, CheckReport((), FINDINGS))[:4] == b"\x89PNG"
    assert sum("not measured" in text.get_text() for axes in drawn[0].axes for text in axes.texts) == 3
