"""What is said of two descriptions before they are compared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from evaluation.experiments.describing import describe
from evaluation.experiments.describing.description import read_statistics, statistics_to_json
from evaluation.experiments.describing.report import seen_notes
from tests.evaluation.experiments.describing.scenes import random_set


def test_only_images_that_share_a_picture_make_intervals_too_narrow(tmp_path: Path) -> None:
    alone = replace(describe(random_set("alone", 4)), layout="generated")
    assert alone.groups == len(alone.images)
    shared = replace(alone, name="shared", groups=2)
    (tmp_path / "shared.json").write_text(statistics_to_json(shared))
    read = read_statistics(str(tmp_path / "shared.json"))
    assert read.groups == 2
    (told,) = [note for note in seen_notes(alone, read) if "too narrow" in note]
    assert told.startswith(f"The {len(alone.images)} images of shared are of 2 pictures or places")
