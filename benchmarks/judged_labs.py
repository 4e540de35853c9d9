"""A simulated room with the live judge and the frames taken in it, for `benchmarks.detection`."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.judge.judge import LiveJudge
from acquisition.run.rig.simulated import sheet
from drivers.presenter import BLACK, Colour
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.config import LabSettings, parse_lab
from experiment.lights import Illuminant, plan_illuminants
from experiment.session.records import RESPONSE, Judgement, SessionStep, plan_steps
from sim.camera.film import write_dng
from sim.world.disturbances import CALM, AnyDisturbance, Disturbances, Moment
from sim.world.sensors import BODIES, Body
from sim.world.world import Room, World

LAB = 'rig = "simulated"\nchart = "chart.json"\nilluminations = "illuminations.csv"\n[camera]\nshutter_s = {}\n'

Counts = npt.NDArray[np.uint16]
# Light of each primary (3,) for the codes of this frame and the previous one.
Projector = Callable[[Colour, Colour], npt.NDArray[np.float64]]


@dataclass
class Lab:
    """A room with its judge and the frames taken so far."""

    world: World
    chart: Chart
    plan: tuple[Illuminant, ...]
    settings: LabSettings
    file: Path
    judge: LiveJudge
    events: Disturbances = CALM
    projector: Projector | None = None
    flicker: float = 0.0
    taken: int = 0
    previous: Colour = BLACK
    keys: Iterator[int] = field(default_factory=itertools.count)

    @property
    def body(self) -> Body:
        return self.world.body

    def fork(self) -> Lab:
        """Return the same lab with a copy of the judge in its present state."""
        return replace(self, judge=copy.copy(self.judge))

    def counts(self, colour: Colour, *events: AnyDisturbance) -> Counts:
        """Return the counts of a new frame."""
        moment = Moment(self.taken, float(self.taken), colour, ((-1.0, self.previous),))
        key = next(self.keys)
        disturbances = Disturbances((*self.events.events, *events))
        situation = disturbances.situation(moment)
        if self.projector is not None:
            light = self.projector(colour, self.previous).astype(np.float32)
            situation = replace(situation, picture=light[None, None])
        if self.flicker:
            strength = float(np.random.default_rng([7, key]).normal(1, self.flicker))
            situation = replace(situation, ambient=(0.012 * strength, 0.01 * strength, 0.007 * strength))
        counts = self.world.expose(
            disturbances.shown(moment), self.settings.camera.exposure, key=(key,), situation=situation
        )
        return disturbances.counted(counts, moment)

    def show(self, counts: Counts, step: SessionStep, **writing: Any) -> Judgement:
        """Judge the counts of a frame."""
        file_options: dict[str, Any] = {"settings": self.settings.camera.exposure, "body": self.body, **writing}
        body = file_options.pop("body")
        with self.file.open("wb") as stream:
            write_dng(stream, counts, body, taken_at=datetime(2026, 1, 1, tzinfo=UTC), **file_options)
        self.taken += 1
        return self.judge.judge(self.file, step)

    def take(self, step: SessionStep, *events: AnyDisturbance) -> Judgement:
        """Take and judge a new frame of a step."""
        judgement = self.show(self.counts(step.colour, *events), step)
        self.previous = step.colour
        return judgement

    def session(self, count: int, reference_every: int, seed: int) -> list[tuple[SessionStep, Judgement]]:
        """Take a session with `count` illuminants of the plan, each frame once, even if it is refused."""
        order: list[int] = np.random.default_rng(seed).permutation(len(self.plan)).tolist()
        lights = [replace(self.plan[k], index=n) for n, k in enumerate(order[:count])]
        steps = plan_steps(lights, reference_every, seed=seed, response=RESPONSE)
        return [(step, self.take(step)) for step in steps]


def lab_of(
    folder: Path, room: Room, body: str = "Test", chart: Chart | None = None, shutter_s: float = 0.5, **lab_fields: Any
) -> Lab:
    """Return a lab with a new judge."""
    settings = parse_lab(LAB.format(shutter_s), "LAB.toml")
    chart = chart or design_chart(3, "A7")
    plan = plan_illuminants()
    judge = LiveJudge(settings, chart, plan)
    world = World(sheet(chart), BODIES[body], room)
    return Lab(world, chart, plan, settings, folder / "frame.dng", judge, **lab_fields)


def rooms(seed: int) -> tuple[Room, dict[str, Any]]:
    """Return a random room and the options of its lab."""
    random = np.random.default_rng([5, seed])
    room = Room(
        seed=seed,
        lamp_spectrum="led" if seed % 3 == 0 else "uhp",
        wheel_hz=0.0 if seed % 3 == 0 else 60.0,
        shutter_jitter_s=float(random.uniform(2e-4, 7e-4)),
        transfer="srgb" if seed % 4 == 0 else float(random.uniform(1.8, 2.6)),
        ambient=float(random.choice([0.0, 0.002, 0.01])),
        vignetting=float(random.uniform(0.05, 0.45)),
        projector_falloff=float(random.uniform(0.05, 0.35)),
        primary_difference=float(random.uniform(0, 0.3)),
        black_leak=float(1 / random.uniform(300, 3000)),
        white_level_share=float(random.uniform(0.45, 0.8)),
        hot_per_million=float(random.choice([0.0, 20.0, 200.0])),
        blur_px=float(random.uniform(0.35, 0.7)),
        stain_mm=float(random.choice([0.0, 8.0])),
        tilt_deg=float(random.uniform(-4, 4)),
        pan_deg=float(random.uniform(-4, 4)),
        profile="managed" if seed % 5 == 0 else "unmanaged",
    )
    lab_options: dict[str, Any] = {"shutter_s": 0.25 if seed % 10 == 3 else 0.5}
    return room, lab_options


def cause(judgement: Judgement) -> str:
    """Return the name of the check that refused a frame; empty if it was accepted."""
    return next((check.name for check in judgement.checks if check.reason), "")
