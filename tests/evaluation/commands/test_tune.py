"""`evaluate tune` as a user meets it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from evaluation.cli import main


@pytest.mark.slow
def test_a_file_that_is_there_is_kept(
    make_dataset: Callable[[int, int], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = make_dataset(48, 32)
    assert main(["tune", "shades-of-gray", str(dataset), "--out", str(dataset / "dataset.json")]) == 2
    assert "dataset.json already exists" in capsys.readouterr().err


def test_a_family_that_is_none_is_told_before_anything_is_opened(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "pca", "no/such/data"]) == 2
    told = capsys.readouterr().err
    assert "'pca' is no family of methods to tune; the families are shades-of-gray, general-gray-world" in told
