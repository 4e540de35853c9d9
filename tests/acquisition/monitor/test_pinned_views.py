"""Views and states of a night in numbers."""

from __future__ import annotations

import random
from dataclasses import asdict, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, get_args

import pytest

from acquisition.monitor import view
from acquisition.monitor.view import SessionView, head_of, read_session, with_seconds
from acquisition.status import status_json
from experiment.session.heartbeat import Heartbeat, RunState
from experiment.session.records import Check
from tests.acquisition.monitor.made_up import closed, whole_night
from tests.acquisition.monitor.test_view import ELSEWHERE, HERE, NOW, STEPS, attempts
from tests.pinned import Pinned

HEAD = ("total", "done", "lights_total", "lights_done", "refused", "failed", "seconds_per_frame")
CHECKS = (
    *(
        Check("off_brightness", 1.234, -0.2, 1.5, "%"),
        Check("off_brightness", 1.5, None, None, "%"),
        Check("off_codes_deg", 1.2346, None, 1.2, "°"),
    ),
    *(Check("blur", 12345.6, 0.5, None, "px"), Check("movement", 1.51, -0.2, 1.5, "px")),
)


def test_states_of_a_session(pinned: Pinned) -> None:
    chance, heads = random.Random(3), list[Any]()
    for number in range(40):
        count = chance.choice((0, 1, 2, 3, 5, 8, 8))
        verdict = chance.choice(("accepted", "accepted", "refused", "failed", None))
        rows = attempts(count, verdict, chance.choice((5, 40)))
        if count > 3:
            changed_row = replace(rows[2], verdict=chance.choice(("voided", "refused")), reason="off")
            rows = (*rows[:2], changed_row, *rows[3:])
        state = chance.choice(get_args(RunState))
        beat_at = NOW - timedelta(seconds=chance.choice((0, 44, 45, 46, 49, 51, 170, 331, 4000)))
        sentence = chance.choice(
            ("as it should", "the camera: no answer (the run waits)", "the disk: full; free space")
        )
        within = timedelta(seconds=chance.choice((10, 300)))
        beat = (
            Heartbeat(beat_at, chance.choice((HERE, ELSEWHERE)), state, sentence, beat_at + within)
            if number % 8
            else None
        )
        session = SessionView("night", "night", STEPS, (), {}, rows, (), beat, None, 25_000_000)
        if number % 11 == 0:
            session = replace(session, lost={0: "frames/0.cr2"}, unreadable="chart.json: gone")
        alive, stopped = chance.choice((True, True, False, None)), chance.random() < 0.1
        state_head = head_of(session, NOW, alive, is_stopped=stopped, free_bytes=chance.choice((None, 10**7, 10**12)))
        heads.append(asdict(state_head))
    pinned("how sessions stand", {"heads": heads})


@pytest.mark.slow
def test_view_of_a_night(tmp_path: Path, pinned: Pinned) -> None:
    run = whole_night(tmp_path / "night", 0.3, grid=3, previews=False)
    with closed(run):
        night = read_session(tmp_path / "night")
        now = run.clock
    whites = night.whites()
    frames = [view._attempt_json(item, whites[item.id], None) for item in night.attempts]
    session_json = view._session_json(night)
    status = status_json(night, now)
    pinned(
        "a night as it is shown",
        {
            "session": {name: session_json[name][::5] for name in ("steps", "lights", "records")},
            "frames": [*frames[:3], *frames[::6]],
            "events": len(night.events),
            "json": {name: status[name] for name in ("white_drift", "checks", "without_accepted_frame", "doubts")},
            "head": {name: status[name] for name in HEAD},
            "spread": [view._spread(count) for count in (0, 1, 5, 17)],
            "places": [view.rb_of(*item) for item in ((0, 0, 0), (1, 2, 3), (-1, 0, 0.5), (float("nan"), 1, 1))],
            "seconds": [item.seconds for item in with_seconds(night.attempts[:9], [night.attempts[4].started_at])],
            "rounded": [view._rounded(item) for item in (1.23456789, 1e-9, float("inf"), 123456789.0)],
        },
    )
