"""Faults in a first frame, and lasting changes: the session is completed without the wrong frame."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from acquisition.run.run import run_session
from drivers.presenter import BLACK
from experiment.chart.layout import design_chart
from experiment.config import load_lab
from experiment.lights import Illuminant, plan_illuminants, save_illuminants
from experiment.session.folder import Session
from experiment.session.records import ACCEPTED, VOIDED, Attempt
from foundation.errors import InputError, QualityError

pytestmark = pytest.mark.slow

LAB = """
rig = "simulated"
chart = "chart.json"
illuminations = "illuminations.csv"
[sequence]
reference_every = 6
patience_s = 60
warm_up_s = 0
[simulated]
body = "Test"
seed = 3
events = [{events}]
[simulated.room]
wheel_hz = 60
transfer = 2.2
"""

LIGHTS = 6


@dataclass(frozen=True)
class Run:
    """A session: messages of its run, its end, its attempts."""

    messages: tuple[str, ...]
    end: str
    attempts: tuple[Attempt, ...]

    @property
    def exposed(self) -> list[Attempt]:
        return [attempt for attempt in self.attempts if attempt.has_frame]

    @property
    def verdicts(self) -> Counter[str | None]:
        return Counter(attempt.verdict for attempt in self.attempts)


def run(folder: Path, *events: Mapping[str, object]) -> Run:
    """Take a session of some illuminants in a room with events."""
    make_lab(folder, *events)
    return run_again(folder)


def make_lab(folder: Path, *events: Mapping[str, object]) -> None:
    """Write LAB.toml, chart and illuminants."""
    design_chart(3, "A7").save(folder / "chart.json")
    plan = plan_illuminants()
    order: list[int] = np.random.default_rng(3).permutation(len(plan)).tolist()
    lights = [replace(plan[k], index=n) for n, k in enumerate(order[:LIGHTS])]
    save_illuminants(lights, folder / "illuminations.csv")
    event_list = ", ".join(
        "{" + ", ".join(f"{key} = {json.dumps(value)}" for key, value in event.items()) + "}" for event in events
    )
    (folder / "LAB.toml").write_text(LAB.format(events=event_list))


def run_again(folder: Path) -> Run:
    """Run the same command again."""
    lines: list[str] = []
    end = ""
    try:
        outcome = run_session(
            load_lab(folder / "LAB.toml"), folder / "session", lambda count, total: None, lines.append
        )
        end = "complete" if outcome.complete else "; ".join(outcome.refused)
    except QualityError as error:
        end = str(error)
    with Session.open(folder / "session") as session:
        return Run(tuple(lines), end, tuple(session.journal.attempts()))


def lines_of(messages: Sequence[str], word: str) -> list[str]:
    return [sentence for sentence in messages if sentence.startswith(f"{word}: ")]


def test_repeats_wrong_first_frame(tmp_path: Path) -> None:
    outcome = run(tmp_path, {"what": "lamp step", "percent": -3, "from_frame": 0, "to_frame": 0})
    assert outcome.end == "complete", outcome.messages
    assert outcome.exposed[0].verdict == "voided"
    assert "first frames" in lines_of(outcome.messages, "voided")[0]
    # It happens once, and no frame of the LUT is lost by it.
    assert outcome.verdicts["voided"] < 35


def test_pauses_with_remedy_if_first_frames_never_agree(tmp_path: Path) -> None:
    flicker = [{"what": "lamp step", "percent": -10, "from_frame": n, "to_frame": n} for n in range(0, 400, 2)]
    outcome = run(tmp_path, *flicker)
    assert outcome.end != "complete"
    remedies = [
        line for line in lines_of(outcome.messages, "refused") if "or when the same command is run again" in line
    ]
    assert remedies
    assert "one of the first frames (white, dark or a primary) may be wrong" in remedies[0]
    assert not any(attempt.kind == "light" and attempt.verdict == ACCEPTED for attempt in outcome.attempts)


def test_follows_and_reports_lasting_change(tmp_path: Path) -> None:
    outcome = run(tmp_path, {"what": "lamp step", "percent": -10, "from_frame": 27})
    assert outcome.end == "complete", outcome.messages
    assert lines_of(outcome.messages, "retry")
    (message,) = lines_of(outcome.messages, "level")
    assert "10.1 % weaker" in message or "10.0 % weaker" in message or "9.9 % weaker" in message
    kinds = [attempt.kind for attempt in outcome.attempts if attempt.verdict == ACCEPTED]
    last = max(n for n, kind in enumerate(kinds) if kind == "response")
    assert kinds[last + 1 : last + 3] == ["white", "dark"], "references at the new level, before any light"


def test_refuses_failing_lamp_in_each_run_and_follows_recovery(tmp_path: Path) -> None:
    first = run(tmp_path, {"what": "lamp step", "percent": -21, "from_frame": 27})
    assert "by -21 % since the first frame" in first.end
    assert first.verdicts["voided"] == 0, "earlier frames were judged separately"
    second = run_again(tmp_path)
    assert "by -21 % since the first frame" in second.end
    voided = [attempt.kind for attempt in second.attempts if attempt.verdict == VOIDED]
    assert set(voided) <= {"response"}, "only the frames that link runs are repeated"
    for settings in (tmp_path / "LAB.toml", tmp_path / "session" / "session.toml"):
        settings.write_text(settings.read_text().replace("-21", "-8"))
    resumed = run_again(tmp_path)
    assert resumed.end == "complete", resumed.messages
    assert (
        "8.0 % weaker" in lines_of(resumed.messages, "level")[0]
        or "8.1 % weaker" in lines_of(resumed.messages, "level")[0]
    )


def test_refuses_black_illuminant_before_the_run(tmp_path: Path) -> None:
    make_lab(tmp_path)
    save_illuminants([Illuminant(0, "uniform", None, BLACK)], tmp_path / "illuminations.csv")
    with pytest.raises(InputError, match=r"illuminant 0 .*0, 0, 0.*delete it"):
        run_session(load_lab(tmp_path / "LAB.toml"), tmp_path / "another", lambda count, total: None)
    assert not (tmp_path / "another").exists()
