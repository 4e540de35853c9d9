"""`generate` says which colour matrix it takes, and what to mind where the table gave it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from generator.cli import main
from generator.command.matrices_told import matrix_sentence
from generator.rendering.matrices import SOURCE, camera_matrix
from tests.generator.conftest import MakeLut


@pytest.fixture
def place(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_lut()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cv2.imwrite("grey.png", np.full((8, 8, 3), 128, np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("more", "told", "not_told"),
    [
        ((), "that of Test camera is not known, so this one was fitted; if the print's colours were", "dcraw"),
        (("--matrix", "table"), "colour matrix: table (least squares", "is not known"),
        (("--matrix", "Canon EOS 600D"), f"colour matrix: Canon EOS 600D ({SOURCE})", "faults"),
        (("--matrix", "none"), "colour matrix: none (none asked for", "faults"),
    ],
)
def test_the_matrix_is_told(
    place: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], told: str, not_told: str
) -> None:
    wish = ("--sources", "grey.png", "--illuminations", "1", "--no-preview", "--rendering", "colorimetric")
    assert main(["lut", "out", *wish, *more]) == 0
    printed = capsys.readouterr().out
    assert told in printed
    assert not_told not in printed


def test_by_codes_no_matrix_is_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lut", "out", "--sources", "grey.png", "--illuminations", "1", "--no-preview"]) == 0
    assert "colour matrix" not in capsys.readouterr().out


def test_the_tables_own_camera_needs_no_advice() -> None:
    known = camera_matrix("Canon EOS 550D")
    assert known is not None
    assert matrix_sentence(known, "Canon EOS 550D", chosen=False) == f"colour matrix: Canon EOS 550D ({SOURCE})"
