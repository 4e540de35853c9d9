"""Tables as values and as CSV, and tables of results under one and several illuminants."""

from __future__ import annotations

import csv
from typing import Any

import numpy as np
import pytest

from evaluation.experiments.running import evaluate
from evaluation.metrics import recovery_error, summarise
from evaluation.results.result import Subject
from evaluation.results.tables import Table, lights_tables, statistics_rows, summary_table, table_to_csv
from evaluation.scene import MixedScene, Scene
from tests.evaluation.made_up import MixedWall, walls

LIGHTS = np.array([[2.0, 1, 1], [1, 1, 1]])


class White:
    """Estimates white, and nothing on images with given names."""

    name = "White"

    def __init__(self, *values: object) -> None:
        self.values = iter(values)

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> Any:
        return next(self.values, (1, 1, 1))


def subject_of(scenes: tuple[Scene, ...]) -> Subject:
    mixed = tuple(isinstance(scene, MixedScene) for scene in scenes)
    return Subject("Walls", tuple(scene.name for scene in scenes), mixed)


def test_separates_images_under_several_illuminants() -> None:
    scenes: tuple[Scene, ...] = (*walls(3), MixedWall("mixed", LIGHTS), MixedWall("other", LIGHTS))
    results = evaluate(scenes, [White()])
    subject = subject_of(scenes)
    title = summary_table(subject, results, "recovery").title
    assert "2 under several illuminants" in title
    several, single = lights_tables(subject, results, "recovery")
    angle = float(recovery_error(*LIGHTS))
    row = dict(zip(several.columns[1::2], several.rows[0][1::2], strict=True))
    assert row["MAE_illum"] == pytest.approx(angle / 4, abs=1e-4)
    assert row["By region"] == pytest.approx(angle / 2, abs=1e-4)
    assert row["Mean light"] == pytest.approx(float(recovery_error((1, 1, 1), scenes[3].truth)), abs=1e-4)
    alone = recovery_error((1, 1, 1), np.stack([scene.truth for scene in scenes[:3]]))
    assert single.rows[0][1:] == pytest.approx(summarise(alone).as_tuple())
    title = summary_table(subject_of(scenes[3:]), evaluate(scenes[3:], [White()]), "recovery").title
    assert "2 images under several illuminants" in title


def test_excludes_image_without_judged_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = (MixedWall("seen", LIGHTS), MixedWall("unseen", LIGHTS))
    read = MixedWall.read

    def covered(scene: MixedWall) -> Any:
        image, _ = read(scene)
        return image, np.full(image.shape[:2], scene.name == "unseen")

    monkeypatch.setattr(MixedWall, "read", covered)
    results = evaluate(scenes, [White()])
    (several,) = lights_tables(subject_of(scenes), results, "recovery")
    assert several.rows[0][1] == pytest.approx(float(recovery_error(*LIGHTS)) / 4, abs=1e-4)
    assert any(note.startswith("1 images are excluded") for note in several.notes)
    row = next(row for row in statistics_rows(subject_of(scenes), results).rows if row[1] == "pixel_rgb")
    assert row[3] == 1


TABLE = Table(
    'Cube+, "all"',
    ("Algorithm", "Mean", "Images", "95 %"),
    (('White, "Patch"\nof two lines', 2 / 3, 1707, "1.2 to 3.4"), ("None known", None, 0, "–")),
    notes=("A note.",),
)


def test_rounds_text_but_not_csv() -> None:
    assert TABLE.texts()[0][1:] == ("0.67", "1707", "1.2 to 3.4")
    assert TABLE.texts()[1][1] == "–"
    head, *rows = csv.reader(table_to_csv(TABLE).splitlines(keepends=True))
    assert tuple(head) == TABLE.columns
    assert rows[0][0] == 'White, "Patch"\nof two lines'
    assert float(rows[0][1]) == pytest.approx(2 / 3, abs=1e-9)
    assert rows[1] == ["None known", "", "0", "–"]
