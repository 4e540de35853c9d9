"""A small simulated room with a chart of 3 bits, the Test body, and a judge of its frames."""

from __future__ import annotations

import copy
import itertools
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.judge.judge import LiveJudge
from acquisition.run.rig.simulated import sheet
from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, Colour
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.config import LabSettings, parse_lab
from experiment.lights import Illuminant, plan_illuminants
from experiment.session.records import RESPONSE, Judgement, SessionStep, plan_steps
from sim.camera.film import write_dng
from sim.world.disturbances import AnyDisturbance, Disturbances, Moment
from sim.world.sensors import BODIES, Body
from sim.world.world import Room, World

LAB = 'rig = "simulated"\nchart = "chart.json"\nilluminations = "illuminations.csv"\n'

Counts = npt.NDArray[np.uint16]
FRAMES = itertools.count()


@dataclass
class Bench:
    """A room, the frames of a plan, and their judge."""

    world: World
    chart: Chart
    lights: tuple[Illuminant, ...]
    steps: tuple[SessionStep, ...]
    settings: LabSettings
    folder: Path
    judge: LiveJudge
    body: Body = BODIES["Test"]

    def counts(self, step: SessionStep, *events: AnyDisturbance, before: Colour = BLACK) -> Counts:
        """Return the counts of a new frame, taken after a colour; every frame has its own noise."""
        moment = Moment(0, 0.0, step.colour, ((-1.0, before),))
        disturbances = Disturbances(events)
        counts = self.world.expose(
            disturbances.shown(moment),
            self.settings.camera.exposure,
            key=(next(FRAMES),),
            situation=disturbances.situation(moment),
        )
        return disturbances.counted(counts, moment)

    def show(self, counts: Counts, step: SessionStep, **writing: Any) -> Judgement:
        """Judge counts as a raw file."""
        path = self.folder / "frame.dng"
        writing_options: dict[str, Any] = {
            "settings": self.settings.camera.exposure,
            "taken_at": datetime(2026, 1, 1, tzinfo=UTC),
            **writing,
        }
        body = writing_options.pop("body", self.body)
        with path.open("wb") as stream:
            write_dng(stream, counts, body, **writing_options)
        return self.judge.judge(path, step)

    def take(self, step: SessionStep, *events: AnyDisturbance, before: Colour = BLACK) -> Judgement:
        return self.show(self.counts(step, *events, before=before), step)

    def fork(self) -> Bench:
        """Return a copy with its own judge in the same state."""
        return replace(self, judge=copy.copy(self.judge))

    def light(self, red: int, green: int, blue: int, number: int = 900) -> SessionStep:
        return SessionStep(number, "light", 0, Colour(red, green, blue))


def bench(folder: Path, room: Room, count: int = 12, every: int = 6, lab: str = LAB, response: bool = True) -> Bench:
    chart = design_chart(3, "A7")
    plan = plan_illuminants()
    order: list[int] = np.random.default_rng(room.seed).permutation(len(plan)).tolist()
    planned = tuple(replace(plan[k], index=n) for n, k in enumerate(order[:count]))
    settings = parse_lab(lab, "LAB.toml")
    steps = plan_steps(planned, every, seed=1, response=RESPONSE if response else ())
    world = World(sheet(chart), BODIES["Test"], room)
    return Bench(world, chart, plan, steps, settings, folder, LiveJudge(settings, chart, plan))


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Make a bench after a small accepted session with a colour wheel."""
    lab = bench(tmp_path_factory.mktemp("judge"), Room(seed=3, wheel_hz=60, transfer=2.2), count=12, every=6)
    for step in lab.steps:
        judgement = lab.take(step)
        assert judgement.accepted, f"{step}: {judgement.reason}"
    return lab


EXPOSURE = ExposureSettings(100, 8.0, 0.5)
