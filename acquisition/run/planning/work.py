"""What a run has to do, known from files alone: the frames that are left, in which order, of which chart and lights.

A session that is there is read and not changed; one that is not is not made.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from drivers.presenter import BLACK
from experiment.chart.model import Chart, load_chart
from experiment.config import LabSettings, parse_lab
from experiment.lights import Illumination, load_illuminations
from experiment.session.folder import Session, session_exists
from experiment.session.plan import RESPONSE, SessionStep, plan_steps
from foundation.errors import ConfigurationError
from foundation.hashing import file_sha256

FIXED: Final = (
    "rig", "camera", "simulated.body", "simulated.camera", "simulated.seed", "simulated.room",
    "sequence.reference_every",
)  # fmt: skip
"""Settings that must stay for a whole session: they decide what its frames show."""

KNOWN_AFTER: Final = 5
"""Frames after which their own times and sizes tell more than what is assumed."""


@dataclass(frozen=True)
class Work:
    """What a run has to do, known from files alone.

    - `folder`: of the session.
    - `new`: whether the session is yet to be made.
    - `steps`, `done`: the plan, and the numbers of its steps that have their frame.
    - `order`: of the lights, in words.
    - `chart`, `lights`: what hangs on the wall, and what is shown.
    - `lights_sha256`: SHA-256 of the file of the lights, hexadecimal.
    - `frame_bytes`, `frame_s`: largest raw file of the session, and median seconds from one frame to the next; None
      where too few were taken.
    """

    folder: Path
    new: bool
    steps: tuple[SessionStep, ...]
    done: frozenset[int]
    order: str
    chart: Chart
    lights: tuple[Illumination, ...]
    lights_sha256: str
    frame_bytes: int | None = None
    frame_s: float | None = None

    @property
    def left(self) -> int:
        """Frames to take."""
        return sum(step.number not in self.done for step in self.steps)


def planned_steps(settings: LabSettings, lights: Sequence[Illumination]) -> tuple[SessionStep, ...]:
    """Return the frames of a new session, in the order that the settings ask for."""
    sequence = settings.sequence
    seed = sequence.seed if sequence.order == "shuffled" else None
    return plan_steps(lights, sequence.reference_every, seed=seed, response=RESPONSE if settings.judge.response else ())


def outline(settings: LabSettings, folder: Path) -> Work:
    """Return what a run has to do, from the files that the settings name and the session that is there."""
    chart, lights = load_chart(settings.chart), load_illuminations(settings.illuminations)
    lights_sha256 = file_sha256(settings.illuminations)
    if not session_exists(folder):
        steps = planned_steps(settings, lights)
        return Work(folder, True, steps, frozenset(), order_of(steps, settings), chart, lights, lights_sha256)
    with Session.open(folder) as session:
        return work_left(session, settings)


def work_left(session: Session, settings: LabSettings) -> Work:
    """Return what a run has to do that takes up an open session; its own frames tell their times and sizes."""
    require_same(session, settings)
    taken = [frame.taken_at for frame in sorted(session.frames(), key=lambda frame: frame.attempt)]
    gaps = [(after - before).total_seconds() for before, after in pairwise(taken) if after >= before]
    sizes = [frame.size for frame in session.journal.accepted_files()]
    return Work(
        session.folder,
        False,
        session.steps,
        frozenset(session.done_steps() & {step.number for step in session.steps}),
        order_of(session.steps, settings),
        session.chart,
        session.illuminations,
        file_sha256(settings.illuminations),
        max(sizes) if len(sizes) >= KNOWN_AFTER else None,
        statistics.median(gaps) if len(gaps) >= KNOWN_AFTER else None,
    )


def require_same(session: Session, settings: LabSettings) -> None:
    """Require that a session is taken up as it was begun: what decides what its frames show is the same."""
    try:
        before = parse_lab(session.settings_text(), str(session.folder / "session.toml"))
    except ConfigurationError as error:
        raise ConfigurationError(f"{error}; restore it from a copy") from error
    for key in FIXED:
        old, new = _value(before, key), _value(settings, key)
        if old != new:
            raise ConfigurationError(
                f"{session.folder} was begun with {key} = {old!r}, {settings.file} says {new!r}; "
                "put the old value back, or name a new session folder"
            )
    if load_chart(settings.chart).sha256 != session.chart.sha256:
        raise ConfigurationError(
            f"{session.folder} was begun with another chart than {settings.chart}; name that, or a new session folder"
        )
    if load_illuminations(settings.illuminations) != session.illuminations:
        raise ConfigurationError(
            f"{session.folder} was begun with other lights than {settings.illuminations}; "
            "name those, or a new session folder"
        )


def order_of(steps: Sequence[SessionStep], settings: LabSettings) -> str:
    """Return in words in which order a plan shows its lights; a session that was begun keeps its own."""
    shown = [step.illumination for step in steps if step.illumination is not None]
    sequence = settings.sequence
    # Which light is at which place of the list decides, not its codes.
    wanted = [step.illumination for step in plan_steps(_places(shown), 1, seed=sequence.seed) if step.kind == "light"]
    if shown == wanted and sequence.order == "shuffled":
        return f"shuffled by seed {sequence.seed}"
    if shown == sorted(shown):
        return "as listed" + (
            f", as the session was begun; {settings.file} says shuffled" * (sequence.order != "listed")
        )
    if shown == wanted:
        return f"shuffled by seed {sequence.seed}, as the session was begun; {settings.file} says listed"
    return "shuffled by another seed, as the session was begun"


def _places(shown: Sequence[int]) -> list[Illumination]:
    return [Illumination(index, "uniform", None, BLACK) for index in sorted(shown)]


def _value(settings: LabSettings, key: str) -> Any:
    value: Any = settings.model_dump()
    for part in key.split("."):
        value = value[part]
    return value
