"""`generate` says which colour matrix it takes, and for how many lights cells are found first."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from generator.cli import main
from generator.command.output import matrix_sentence
from generator.rendering.matrices import SOURCE, camera_matrix
from tests.generator.conftest import MakeLut

pytestmark = pytest.mark.slow


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


def test_lights_whose_cells_are_to_be_found_are_told_once(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ("--random-scenes", "2", "--size", "24x20", "--no-preview", "--rendering", "colorimetric")

    def told(*arguments: str, matrix: str = "none") -> str:
        assert main(["lut", *arguments, *wish, "--matrix", matrix]) == 0
        return capsys.readouterr().out

    assert "finding the cells of 2 lights on the way" in told("first", "--illuminations", "1,2")
    assert "finding the cells" not in told("again", "--illuminations", "1,2", "--seed", "3")
    # A mixture takes the cells of the light nearest to it, light 2 here, whose white is that of the mixture nearly.
    assert "finding the cells" not in told("mixed", "--light", "1:0.05+2:0.95")
    assert "finding the cells of 1 light on" in told("more", "--illuminations", "1-3")
    # Another matrix has other cells. The first share of two scenes under three lights, two images each, has two lights.
    share = ("--illuminations", "0,1,2", "--shard-images", "2", "--shard", "0/3")
    assert "finding the cells of 2 lights on" in told("share", *share, matrix="Canon EOS 600D")
