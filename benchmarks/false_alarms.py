"""What the live judge takes for a fault that is none: undisturbed sessions in rooms of many kinds, and in odd ones."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.judged_labs import Projector, cause, lab_of, rooms
from calibration.figures.light import OFF_CODES_DEG
from drivers.presenter import Colour
from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.model import Chart
from sim.world.disturbances import Disturbances, LampDrift, SensorWarming
from sim.world.world import Room


def drifting(frames: int) -> Disturbances:
    """Return a lamp that loses 2 % in a session, blue more, and a sensor that warms up."""
    return Disturbances((LampDrift(percent=-2, rgb=(0, 0, -0.4), to_frame=frames), SensorWarming(to_frame=frames)))


def with_white_segment(room: Room, share: float) -> Projector:
    """Return a projector whose wheel has a white segment, which shows what the three colours have in common."""

    def light(colour: Colour, before: Colour) -> npt.NDArray[np.float64]:
        alone = room.light_of(np.array(colour)) / (1 + share)
        return np.asarray(alone + share * alone.min(), dtype=np.float64)

    return light


def with_memory(room: Room, share: float) -> Projector:
    """Return a projector whose primaries are weaker, by up to a share, the brighter each was in the picture before."""

    def light(colour: Colour, before: Colour) -> npt.NDArray[np.float64]:
        now, past = (room.light_of(np.array(c)) for c in (colour, before))
        return np.asarray(now * (1 - share * past), dtype=np.float64)

    return light


def false_alarms(folder: Path, sessions: int, lights: int, drifts: int) -> tuple[int, int, Counter[str]]:
    """Return undisturbed sessions with a refused frame, frames in all, and causes, in rooms of many seeds."""
    refused, frames, causes = 0, 0, Counter[str]()
    for seed in range(sessions):
        room, more = rooms(seed)
        some = 8 if seed % 25 == 7 else lights
        if seed < drifts:
            more["events"] = drifting(some + 40)
        lab = lab_of(folder, room, chart=_chart_of(seed), **more)
        said = lab.session(some, 12, seed)
        wrong = [(step, one) for step, one in said if not one.accepted]
        frames += len(said)
        refused += bool(wrong)
        for step, one in wrong:
            causes[cause(one)] += 1
            print(f"session {seed}: {step.stem} {step.colour}: {one.reason}", file=sys.stderr)
    return refused, frames, causes


def _chart_of(seed: int) -> Chart:
    if seed % 10 == 9:
        return paper_chart("A5", 3)
    return design_chart(2, "A7") if seed % 10 == 4 else design_chart(3, "A7")


def odd_worlds(folder: Path, lights: int) -> list[tuple[str, int, int, Counter[str], str]]:
    """Return how sessions fare under projectors and rooms that are not as the judge's model has them."""
    room = Room(seed=77, wheel_hz=60, transfer=2.2)
    fading = LampDrift(percent=-10, rgb=(0, 0, -3), to_frame=lights)
    cases: list[tuple[str, dict[str, Any]]] = [
        ("white segment, +20 %", {"projector": with_white_segment(room, 0.2)}),
        ("white segment, +60 %", {"projector": with_white_segment(room, 0.6)}),
        ("primaries weaker by up to 2 % after bright ones", {"projector": with_memory(room, 0.02)}),
        ("other light of 1 % that flickers by 3 %", {"flicker": 0.03}),
        ("white of 650 counts", {"room": replace(room, white_level_share=0.05)}),
        ("lamp −10 % in the session, blue −13 %", {"events": Disturbances((fading,))}),
    ]  # fmt: skip
    found: list[tuple[str, int, int, Counter[str], str]] = []
    for name, more in cases:
        lab = lab_of(folder, more.pop("room", room), **more)
        said = lab.session(lights, 12, 3)
        causes = Counter(cause(one) for _, one in said if not one.accepted)
        limit = [
            c.high for _, one in said[-20:] for c in one.checks if c.name == OFF_CODES_DEG.name and c.high is not None
        ]
        found.append((name, len(said), sum(causes.values()), causes, f"{np.median(limit):.2f}°" if limit else ""))
        for step, one in said:
            if not one.accepted:
                print(f"{name}: {step.stem} {step.colour}: {one.reason}", file=sys.stderr)
    return found
