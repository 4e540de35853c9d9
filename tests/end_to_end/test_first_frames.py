"""Trouble in a first frame, and changes that last: the session ends complete, without the frame that was off."""

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
from experiment.lights import Illumination, plan_illuminations, save_illuminations
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
    """A session that was taken: the sentences of its run, why it ended, its attempts."""

    said: tuple[str, ...]
    end: str
    attempts: tuple[Attempt, ...]

    @property
    def exposed(self) -> list[Attempt]:
        return [attempt for attempt in self.attempts if attempt.has_frame]

    @property
    def verdicts(self) -> Counter[str | None]:
        return Counter(attempt.verdict for attempt in self.attempts)


def run(folder: Path, *events: Mapping[str, object]) -> Run:
    """Take a session of some lights of the plan in a room where events happen."""
    make_lab(folder, *events)
    return again(folder)


def make_lab(folder: Path, *events: Mapping[str, object]) -> None:
    """Write LAB.toml, chart and lights."""
    design_chart(3, "A7").save(folder / "chart.json")
    plan = plan_illuminations()
    order: list[int] = np.random.default_rng(3).permutation(len(plan)).tolist()
    some = [replace(plan[k], index=n) for n, k in enumerate(order[:LIGHTS])]
    save_illuminations(some, folder / "illuminations.csv")
    listed = ", ".join(
        "{" + ", ".join(f"{key} = {json.dumps(value)}" for key, value in event.items()) + "}" for event in events
    )
    (folder / "LAB.toml").write_text(LAB.format(events=listed))


def again(folder: Path) -> Run:
    """Run the same command once more."""
    said: list[str] = []
    end = ""
    try:
        outcome = run_session(load_lab(folder / "LAB.toml"), folder / "session", lambda done, total: None, said.append)
        end = "complete" if outcome.complete else "; ".join(outcome.refused)
    except QualityError as error:
        end = str(error)
    with Session.open(folder / "session") as session:
        return Run(tuple(said), end, tuple(session.journal.attempts()))


def of(said: Sequence[str], word: str) -> list[str]:
    return [sentence for sentence in said if sentence.startswith(f"{word}: ")]


def test_a_first_frame_that_is_the_odd_one_is_taken_again(tmp_path: Path) -> None:
    taken = run(tmp_path, {"what": "lamp step", "percent": -3, "from_frame": 0, "to_frame": 0})
    assert taken.end == "complete", taken.said
    assert taken.exposed[0].verdict == "voided"
    assert "first frames" in of(taken.said, "voided")[0]
    # Once, and nothing of the table's frames is lost by it.
    assert taken.verdicts["voided"] < 35


def test_first_frames_that_never_agree_pause_the_run_with_what_to_do(tmp_path: Path) -> None:
    flicker = [{"what": "lamp step", "percent": -10, "from_frame": n, "to_frame": n} for n in range(0, 400, 2)]
    taken = run(tmp_path, *flicker)
    assert taken.end != "complete"
    asked = [sentence for sentence in of(taken.said, "refused") if "when the same command is run again" in sentence]
    assert asked
    assert "one of the first frames" in asked[0]
    assert not any(attempt.kind == "light" and attempt.verdict == ACCEPTED for attempt in taken.attempts)


def test_a_lasting_change_is_followed_after_a_pause_and_said(tmp_path: Path) -> None:
    taken = run(tmp_path, {"what": "lamp step", "percent": -10, "from_frame": 27})
    assert taken.end == "complete", taken.said
    assert of(taken.said, "retry")
    (told,) = of(taken.said, "level")
    assert "10.1 % weaker" in told or "10.0 % weaker" in told or "9.9 % weaker" in told
    kinds = [attempt.kind for attempt in taken.attempts if attempt.verdict == ACCEPTED]
    ties = max(n for n, kind in enumerate(kinds) if kind == "response")
    assert kinds[ties + 1 : ties + 3] == ["white", "dark"], "references at the new level, before any light"


def test_a_lamp_that_fails_is_refused_alike_by_each_run_and_followed_when_it_recovers(tmp_path: Path) -> None:
    first = run(tmp_path, {"what": "lamp step", "percent": -21, "from_frame": 27})
    assert "has changed by -21 %" in first.end
    assert first.verdicts["voided"] == 0, "each light before was judged by itself"
    second = again(tmp_path)
    assert "has changed by -21 %" in second.end
    voided = [attempt.kind for attempt in second.attempts if attempt.verdict == VOIDED]
    assert set(voided) <= {"response"}, "frames that link runs are taken anew, no light is"
    for settings in (tmp_path / "LAB.toml", tmp_path / "session" / "session.toml"):
        settings.write_text(settings.read_text().replace("-21", "-8"))
    resumed = again(tmp_path)
    assert resumed.end == "complete", resumed.said
    assert "8.0 % weaker" in of(resumed.said, "level")[0] or "8.1 % weaker" in of(resumed.said, "level")[0]


def test_a_light_that_is_none_is_said_before_anything_moves(tmp_path: Path) -> None:
    make_lab(tmp_path)
    save_illuminations([Illumination(0, "uniform", None, BLACK)], tmp_path / "illuminations.csv")
    with pytest.raises(InputError, match=r"illuminant 0 .*0, 0, 0.*delete it"):
        run_session(load_lab(tmp_path / "LAB.toml"), tmp_path / "another", lambda done, total: None)
    assert not (tmp_path / "another").exists()
