"""Progress as lines or a bar, and the message about the colour matrix."""

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
from generator.progress import show_progress
from generator.rendering.matrices import SOURCE, camera_matrix
from tests.generator.conftest import MakeLut


def test_sums_reused_images_before_first_image(capsys: pytest.CaptureFixture[str]) -> None:
    with show_progress(9) as callbacks:
        for count in (3, 2, -1):
            callbacks.on_done(count)
        callbacks.on_image()
        callbacks.on_done(2)
        callbacks.on_image()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["4 images exist from an earlier run", "6 images exist from an earlier run in total"]


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _report_four_images() -> None:
    with show_progress(4) as callbacks:
        callbacks.on_done(1)
        callbacks.on_image()
        callbacks.on_skip("bad\x1b[2J.png", "it is no picture", 1)
        callbacks.on_image()


def test_writes_lines_to_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    _report_four_images()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["1 image exists from an earlier run", "skipped bad\\x1b[2J.png: it is no picture"]
    assert lines[2].startswith("images 2/2 ")
    assert len(lines) == 3


def test_shows_bar_for_long_work_on_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for soon, bar in ((1e6, False), (-1.0, True)):
        terminal = _Terminal()
        monkeypatch.setattr(sys, "stderr", terminal)
        monkeypatch.setattr(progress, "SOON_S", soon)
        _report_four_images()
        assert ("━" in terminal.getvalue()) == bar
        assert "2/2" in terminal.getvalue()
        assert "\x1b[2J" not in terminal.getvalue()


def test_is_silent_if_only_errors_are_logged(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    with show_progress(1) as callbacks:
        assert callbacks is SILENT
    assert capsys.readouterr().err == ""


pytestmark = pytest.mark.slow


@pytest.fixture
def folder(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_lut()
    monkeypatch.chdir(tmp_path)
    assert cv2.imwrite("grey.png", np.full((8, 8, 3), 128, np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("options", "expected", "absent"),
    [
        ((), "there is no published matrix for Test camera", "dcraw"),
        (("--matrix", "table"), "colour matrix: table (least squares", "no published matrix"),
        (("--matrix", "Canon EOS 600D"), f"colour matrix: Canon EOS 600D ({SOURCE})", "faults"),
    ],
)
def test_reports_colour_matrix(
    folder: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], expected: str, absent: str
) -> None:
    arguments = ("--sources", "grey.png", "--light", "1", "--no-preview", "--rendering", "colorimetric")
    assert main(["lut", "out", *arguments, *options]) == 0
    printed = capsys.readouterr().out
    assert expected in printed
    assert absent not in printed


def test_published_matrix_needs_no_warning() -> None:
    matrix = camera_matrix("Canon EOS 550D")
    assert matrix is not None
    assert matrix_sentence(matrix, "Canon EOS 550D", is_chosen=False) == f"colour matrix: Canon EOS 550D ({SOURCE})"
