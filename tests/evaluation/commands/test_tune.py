"""`evaluate tune`, run as a command."""

from __future__ import annotations

import pytest

from evaluation.cli import main


def test_refuses_unknown_family_before_opening_data(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "pca", "no/such/data"]) == 2
    error = capsys.readouterr().err
    assert "'pca' cannot be tuned, expected shades-of-gray, general-gray-world" in error
