"""What a run says of the last frame and of the time left."""

from __future__ import annotations

import errno
import io

import pytest

from acquisition.run import run
from acquisition.run.pipeline import Taken
from acquisition.run.run import PLAIN_S, Terminal, verdict_line
from drivers.presenter import Colour
from experiment.session.records import Check, Judgement, SessionStep

STEP = SessionStep(7, "light", 5, Colour(1, 2, 3))


def test_the_verdict_has_its_numbers() -> None:
    checks = (Check("file"), Check("movement", 0.031, None, 0.2, "px"), Check("off_codes_deg", 0.2134, None, 0.5, "°"))
    line = verdict_line(Taken(STEP, Judgement(checks), 3))
    assert line == "light 5 accepted, off_codes_deg 0.213°, movement 0.031 px"
    followed = Judgement((Check("off_brightness", -4.0, -1.0, 1.0, "%"), Check("off_codes_deg", 0.7, None, 0.5, "°")))
    assert verdict_line(Taken(STEP, followed, 3)) == "light 5 accepted, off_codes_deg 0.7° (beyond its limit)"
    dark = Judgement((Check("exposure", 0.4, None, None, "%", "too dark"),))
    assert verdict_line(Taken(STEP, dark, 3)) == "light 5 refused, exposure 0.4 %"


def test_the_time_left_is_that_of_the_last_frames_without_pauses(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "PLAIN_S", 0.0)
    now = [0.0]
    with Terminal(lambda: now[0]) as terminal:

        def left(*frames_s: float, reason: str = "") -> str:
            """Return what is said of ten frames left after others that took so long."""
            for seconds in frames_s:
                now[0] += seconds
                terminal.taken(Taken(STEP, Judgement((Check("file", reason=reason),)), 10))
            terminal.progress(0, 10)
            return capsys.readouterr().err

        assert "left" not in left(0)
        assert "left 20 s" in left(2, 2, 3)
        terminal.state("paused")
        assert "left 20 s" in left(600, 2)
        # Each frame costs two attempts of late, as the page has it.
        assert "left 40 s" in left(*[2] * 6, reason="too dark")


def test_lines_stay_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with Terminal() as terminal:
        terminal.progress(0, 2)
        terminal.taken(Taken(STEP, Judgement((Check("file"),)), 1))
        terminal.announce("refused: light 5: too dark")
        terminal.state("the lamp warms up, 3 min 00 s left")
    assert "refused: light 5: too dark\n" in capsys.readouterr().err


def test_a_run_into_a_file_has_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with Terminal(lambda: now[0]) as terminal:
        terminal.progress(0, 200)
        for done in range(1, 201):
            now[0] += 2.0
            terminal.taken(Taken(STEP, Judgement((Check("off_codes_deg", 0.2, None, 0.5, "°"),)), 200 - done))
            terminal.progress(done, 200)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 + int(400 // PLAIN_S) + 1
    assert "0 of 200 frames" in lines[0]
    assert "90 of 200 frames, left 3 min 40 s, light 5 accepted, off_codes_deg 0.2°" in lines[6]
    assert "200 of 200 frames, light 5 accepted" in lines[-1]
    assert "━" not in "".join(lines)


class FullOutput(io.StringIO):
    """An output whose disk is full."""

    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_log_on_a_full_disk_ends_no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    with Terminal() as terminal:
        monkeypatch.setattr("sys.stderr", FullOutput())
        terminal.announce("refused: light 5: too dark")
        terminal.progress(0, 2)
