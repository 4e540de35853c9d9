"""`evaluate tune` as a user meets it."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest

from evaluation.cli import main


@pytest.mark.slow
def test_a_family_is_tuned_and_its_setting_evaluated(
    make_dataset: Callable[[int, int], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = make_dataset(48, 32)
    out = dataset.parent / "settings.csv"
    assert main(["tune", "shades-of-gray", str(dataset), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "shades-of-gray by the spread of green chromaticity on 16 images" in printed
    assert "ground truths: not used for the choice; on other images" in printed
    assert "degrees" not in printed
    with out.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 15
    assert [row["rank"] for row in rows] == [str(rank) for rank in range(1, 16)]
    assert "recovery_mean" not in rows[0]
    best = rows[0]["setting"]
    assert f"chosen: {best}, whose" in printed
    assert main(["run", str(dataset), "--method", best]) == 0
    assert rows[0]["method"] in capsys.readouterr().out
    assert main(["tune", "shades-of-gray", str(dataset), "--out", str(out)]) == 2
    assert str(out) in capsys.readouterr().err


def test_a_family_that_is_none_is_told_before_anything_is_opened(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "pca", "no/such/data"]) == 2
    told = capsys.readouterr().err
    assert "'pca' is no family of methods to tune; the families are shades-of-gray, general-gray-world" in told
