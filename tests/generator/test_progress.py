"""What is told of the work on images: lines where nobody watches, a bar where somebody waits."""

from __future__ import annotations

import io
import logging
import sys

import pytest

from generator.command import output as progress
from generator.command.output import shown_progress
from generator.dataset.shards import SILENT


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
    assert lines[:2] == ["1 images were made by an earlier run", "left out bad\\x1b[2J.png: it is no picture"]
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
