"""`evaluate tune` as a user meets it."""

from __future__ import annotations

import pytest

from evaluation.cli import main


def test_a_family_that_is_none_is_told_before_anything_is_opened(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "pca", "no/such/data"]) == 2
    told = capsys.readouterr().err
    assert "'pca' is no family of methods to tune; the families are shades-of-gray, general-gray-world" in told
