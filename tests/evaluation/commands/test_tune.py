"""`evaluate tune`, run as a command."""

from __future__ import annotations

import pytest

from evaluation.cli import main


def test_refuses_unknown_family_before_opening_data(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "pca", "no/such/data"]) == 2
    error = capsys.readouterr().err
    assert "'pca' is no family of methods to tune; the families are shades-of-gray, general-gray-world" in error
