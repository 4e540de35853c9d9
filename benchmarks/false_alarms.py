"""False alarms of the live judge: undisturbed sessions in many rooms, and with unusual projectors."""

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
    """Return a lamp that loses 2 % in a session, more in blue, and a sensor that warms up."""
    return Disturbances((LampDrift(percent=-2, rgb=(0, 0, -0.4), to_frame=frames), SensorWarming(to_frame=frames)))


def with_white_segment(room: Room, share: float) -> Projector:
    """Return a projector with a white wheel segment, which shows the common part of the three colours."""

    def light(colour: Colour, previous: Colour) -> npt.NDArray[np.float64]:
        primaries = room.light_of(np.array(colour)) / (1 + share)
        return np.asarray(primaries + share * primaries.min(), dtype=np.float64)

    return light


def with_memory(room: Room, share: float) -> Projector:
    """Return a projector whose primaries get weaker, by up to `share`, if they were bright in the previous image."""

    def light(colour: Colour, previous: Colour) -> npt.NDArray[np.float64]:
        current, earlier = (room.light_of(np.array(c)) for c in (colour, previous))
        return np.asarray(current * (1 - share * earlier), dtype=np.float64)

    return light


def false_alarms(folder: Path, sessions: int, lights: int, drifts: int) -> tuple[int, int, Counter[str]]:
    """Count undisturbed sessions with a refused frame, all frames, and causes, in rooms of many seeds."""
    rejected_sessions, frames, causes = 0, 0, Counter[str]()
    for seed in range(sessions):
        room, lab_options = rooms(seed)
        light_count = 8 if seed % 25 == 7 else lights
        if seed < drifts:
            lab_options["events"] = drifting(light_count + 40)
        lab = lab_of(folder, room, chart=_chart_of(seed), **lab_options)
        judgements = lab.session(light_count, 12, seed)
        refused = [(step, judgement) for step, judgement in judgements if not judgement.accepted]
        frames += len(judgements)
        rejected_sessions += bool(refused)
        for step, judgement in refused:
            causes[cause(judgement)] += 1
            print(f"session {seed}: {step.stem} {step.colour}: {judgement.reason}", file=sys.stderr)
    return rejected_sessions, frames, causes


def _chart_of(seed: int) -> Chart:
    if seed % 10 == 9:
        return paper_chart("A5", 3)
    return design_chart(2, "A7") if seed % 10 == 4 else design_chart(3, "A7")


def unusual_worlds(folder: Path, lights: int) -> list[tuple[str, int, int, Counter[str], str]]:
    """Judge sessions with projectors and rooms that differ from the model of the judge."""
    room = Room(seed=77, wheel_hz=60, transfer=2.2)
    fading = LampDrift(percent=-10, rgb=(0, 0, -3), to_frame=lights)
    cases: list[tuple[str, dict[str, Any]]] = [
        ("white segment, +20 %", {"projector": with_white_segment(room, 0.2)}),
        ("white segment, +60 %", {"projector": with_white_segment(room, 0.6)}),
        ("primaries weaker by up to 2 % after bright ones", {"projector": with_memory(room, 0.02)}),
        ("ambient light of 1 % that flickers by 3 %", {"flicker": 0.03}),
        ("white of 650 counts", {"room": replace(room, white_level_share=0.05)}),
        ("lamp −10 % in the session, blue −13 %", {"events": Disturbances((fading,))}),
    ]  # fmt: skip
    rows: list[tuple[str, int, int, Counter[str], str]] = []
    for name, changes in cases:
        lab = lab_of(folder, changes.pop("room", room), **changes)
        judgements = lab.session(lights, 12, 3)
        causes = Counter(cause(judgement) for _, judgement in judgements if not judgement.accepted)
        limit = [
            c.high
            for _, judgement in judgements[-20:]
            for c in judgement.checks
            if c.name == OFF_CODES_DEG.name and c.high is not None
        ]
        rows.append((name, len(judgements), sum(causes.values()), causes, f"{np.median(limit):.2f}°" if limit else ""))
        for step, judgement in judgements:
            if not judgement.accepted:
                print(f"{name}: {step.stem} {step.colour}: {judgement.reason}", file=sys.stderr)
    return rows
