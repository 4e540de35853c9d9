"""A machine that sleeps, a process that is stopped: the journal says so, and the frame in between is taken again."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from acquisition.run.gaps import GAP_S, GapWatch
from acquisition.run.run import take_session
from drivers.presenter import Colour
from foundation import clock
from tests.acquisition.run.scripted import SETTINGS, Lab


class Time:
    """Stands still but where it jumps."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_jump_is_told_once() -> None:
    time = Time()
    watch = GapWatch(time)
    assert watch.taken() == 0
    time.now += GAP_S
    assert watch.taken() == 0, "a busy machine"
    time.now += 343
    assert watch.taken() == 343
    assert watch.taken() == 0


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    one = Time()
    monkeypatch.setattr(clock, "elapsed_s", one)
    return one


def events(lab: Lab) -> list[str]:
    return [event.detail for event in lab.session.journal.events() if event.what == "gap"]


def test_a_frame_that_was_exposed_across_a_gap_is_taken_again(tmp_path: Path, time: Time) -> None:
    lab = Lab(tmp_path / "session")
    expose = lab.camera.expose

    def stopped() -> datetime:
        released = expose()
        time.now += 343 * (lab.camera.captures == 3)
        return released

    lab.camera.expose = stopped  # type: ignore[method-assign]
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    refused = [frame.verdict for frame in lab.session.frames() if not frame.accepted]
    assert len(refused) == 1
    assert "5 min 43 s" in refused[0]
    assert len(events(lab)) == 1


def test_a_gap_between_frames_is_in_the_journal_and_costs_none(tmp_path: Path, time: Time) -> None:
    lab = Lab(tmp_path / "session")
    show = lab.screen.show

    def stopped(colour: Colour) -> None:
        show(colour)
        time.now += 60 * (len(lab.screen.shown) == 3)

    lab.screen.show = stopped  # type: ignore[method-assign]
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["accepted"] * 6
    assert len(events(lab)) == 1
