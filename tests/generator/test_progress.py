"""What is shown of the work on images: lines or a bar, the colour matrix, and lights whose cells are found first."""

from __future__ import annotations

import io
import logging
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from generator import progress
from generator.cli import main, matrix_sentence
from generator.dataset.shards import SILENT
from generator.progress import shown_progress
from generator.rendering.matrices import SOURCE, camera_matrix
from tests.generator.conftest import MakeLut


def test_what_was_found_before_the_first_image_is_one_sum(capsys: pytest.CaptureFixture[str]) -> None:
    with shown_progress(9) as callbacks:
        for found in (3, 2, -1):
            callbacks.on_done(found)
        callbacks.on_image()
        callbacks.on_done(2)
        callbacks.on_image()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["4 images were found finished", "6 images were found finished in all"]


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _told() -> None:
    with shown_progress(4) as callbacks:
        callbacks.on_done(1)
        callbacks.on_image()
        callbacks.on_skip("bad\x1b[2J.png", "it is no picture", 1)
        callbacks.on_image()


def test_a_file_gets_lines(capsys: pytest.CaptureFixture[str]) -> None:
    _told()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["1 images were found finished", "left out bad\\x1b[2J.png: it is no picture"]
    assert lines[2].startswith("images 2/2 ")
    assert len(lines) == 3


def test_a_terminal_gets_a_bar_when_it_takes_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    for soon, bar in ((1e6, False), (-1.0, True)):
        terminal = _Terminal()
        monkeypatch.setattr(sys, "stderr", terminal)
        monkeypatch.setattr(progress, "SOON_S", soon)
        _told()
        assert ("━" in terminal.getvalue()) == bar
        assert "2/2" in terminal.getvalue()
        assert "\x1b[2J" not in terminal.getvalue()


def test_who_wants_errors_alone_gets_nothing(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    with shown_progress(1) as callbacks:
        assert callbacks is SILENT
    assert capsys.readouterr().err == ""


pytestmark = pytest.mark.slow


@pytest.fixture
def place(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_lut()
    monkeypatch.chdir(tmp_path)
    assert cv2.imwrite("grey.png", np.full((8, 8, 3), 128, np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("more", "told", "not_told"),
    [
        ((), "that of Test camera is not known, so this one was fitted; if the print's colours were", "dcraw"),
        (("--matrix", "table"), "colour matrix: table (least squares", "is not known"),
        (("--matrix", "Canon EOS 600D"), f"colour matrix: Canon EOS 600D ({SOURCE})", "faults"),
    ],
)
def test_the_matrix_is_told(
    place: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], told: str, not_told: str
) -> None:
    wish = ("--sources", "grey.png", "--light", "1", "--no-preview", "--rendering", "colorimetric")
    assert main(["lut", "out", *wish, *more]) == 0
    printed = capsys.readouterr().out
    assert told in printed
    assert not_told not in printed


def test_the_tables_own_camera_needs_no_advice() -> None:
    known = camera_matrix("Canon EOS 550D")
    assert known is not None
    assert matrix_sentence(known, "Canon EOS 550D", chosen=False) == f"colour matrix: Canon EOS 550D ({SOURCE})"
