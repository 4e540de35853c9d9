"""What the live judge sees, and what it takes for a fault that is none: `python -m benchmarks.detection`.

Three tables, as Markdown. Detection: each disturbance and size, tried in several simulated rooms at several lights,
deep blues, whites and dark frames among them: how often it was refused at its frame, at the next, or not at all, and by
which causes. False alarms: frames refused in undisturbed sessions, a room each, some with a lamp that drifts and a
sensor that warms up, some with projectors that do not add, remember the picture before, or with other light that
flickers. Neighbours: which of the plan's 707 lights could stand for one another without being told.

Frames are simulated (`sim.world`): a small body and chart for most, an EOS 550D before the whole chart with ``--full``.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.chart.layout import design_chart, paper_chart
from acquisition.chart.model import Chart
from acquisition.config import LabSettings, parse_lab
from acquisition.judge import limits
from acquisition.judge.judge import LiveJudge
from acquisition.judge.known.response import ProjectorModel
from acquisition.lights.illuminations import Illumination, plan_illuminations
from acquisition.run.rig.simulated import sheet
from acquisition.session.judgement import Judgement
from acquisition.session.plan import RESPONSE, SessionStep, plan_steps
from drivers.presenter import BLACK, WHITE, Colour
from sim.camera.dng import write_dng
from sim.world.disturbances import (
    CALM,
    AmbientStep,
    AnyDisturbance,
    Bump,
    Defocus,
    Disturbances,
    HalfChanged,
    LampDrift,
    LampStep,
    Moment,
    Person,
    PopUp,
    ScrambledRows,
    SensorWarming,
    ZeroedStrip,
)
from sim.world.room import Room
from sim.world.sensors import BODIES, Body
from sim.world.world import World

LAB = 'rig = "simulated"\nchart = "chart.json"\nilluminations = "illuminations.csv"\n[camera]\nshutter_s = {}\n'

Counts = npt.NDArray[np.uint16]
Projector = Callable[[Colour, Colour], npt.NDArray[np.float64]]
"""The light of each primary (3,) that codes give, after those of the frame before."""


@dataclass
class Lab:
    """A room, its judge, and the frames taken in it so far."""

    world: World
    chart: Chart
    plan: tuple[Illumination, ...]
    settings: LabSettings
    file: Path
    judge: LiveJudge
    events: Disturbances = CALM
    projector: Projector | None = None
    flicker: float = 0.0
    taken: int = 0
    before: Colour = BLACK
    keys: Iterator[int] = field(default_factory=itertools.count)

    @property
    def body(self) -> Body:
        return self.world.body

    def fork(self) -> Lab:
        """Return the same lab with a judge of its own that knows as much."""
        return replace(self, judge=copy.copy(self.judge))

    def counts(self, colour: Colour, *events: AnyDisturbance) -> Counts:
        """Return the counts of a new frame."""
        moment = Moment(self.taken, float(self.taken), colour, ((-1.0, self.before),))
        key = next(self.keys)
        gone_wrong = Disturbances((*self.events.events, *events))
        situation = gone_wrong.situation(moment)
        if self.projector is not None:
            light = self.projector(colour, self.before).astype(np.float32)
            situation = replace(situation, picture=light[None, None])
        if self.flicker:
            own = float(np.random.default_rng([7, key]).normal(1, self.flicker))
            situation = replace(situation, ambient=tuple(0.01 * own * share for share in (1.2, 1.0, 0.7)))
        counts = self.world.expose(colour, self.settings.camera.exposure, key=(key,), situation=situation)
        return gone_wrong.counted(counts, moment)

    def show(self, counts: Counts, step: SessionStep, **writing: Any) -> Judgement:
        """Return what is said of counts."""
        given: dict[str, Any] = {"settings": self.settings.camera.exposure, "body": self.body, **writing}
        body = given.pop("body")
        with self.file.open("wb") as stream:
            write_dng(stream, counts, body, taken_at=datetime(2026, 1, 1, tzinfo=UTC), **given)
        self.taken += 1
        return self.judge.judge(self.file, step)

    def take(self, step: SessionStep, *events: AnyDisturbance) -> Judgement:
        """Return what is said of a new frame of a step."""
        judgement = self.show(self.counts(step.colour, *events), step)
        self.before = step.colour
        return judgement

    def session(self, count: int, every: int, seed: int) -> list[tuple[SessionStep, Judgement]]:
        """Take a whole session of so many lights of the plan; every frame once, refused or not."""
        order: list[int] = np.random.default_rng(seed).permutation(len(self.plan)).tolist()
        some = [replace(self.plan[k], index=n) for n, k in enumerate(order[:count])]
        steps = plan_steps(some, every, seed=seed, response=RESPONSE)
        return [(step, self.take(step)) for step in steps]


def lab_of(
    folder: Path, room: Room, body: str = "Test", chart: Chart | None = None, shutter_s: float = 0.5, **more: Any
) -> Lab:
    """Return a lab with a judge that has seen nothing."""
    settings = parse_lab(LAB.format(shutter_s), "LAB.toml")
    chart = chart or design_chart(3, "A7")
    plan = plan_illuminations()
    judge = LiveJudge(settings, chart, plan)
    world = World(sheet(chart), BODIES[body], room)
    return Lab(world, chart, plan, settings, folder / "frame.dng", judge, **more)


# Detection

LIGHT, ANY, LIT, TWO_COLOURED = "lights", "any", "lit", "lights with more of red than of blue, or less"


@dataclass(frozen=True)
class Trial:
    """A disturbance: its size, how it is made, whether it stays, and at which frames it is tried.

    `NAMED` has what a sentence must say to have named its cause.
    """

    name: str
    size: str
    events: tuple[AnyDisturbance, ...] = ()
    stays: bool = True
    at: str = LIGHT
    special: str = ""

    def is_named_in(self, reason: str) -> bool:
        """Return whether the reason of a refusal says what was done."""
        return re.search(NAMED[self.name], reason) is not None


TRIALS = (
    Trial("frozen screen, from a frame on", "another light", special="frozen"),
    Trial("stale frame", "once", stays=False, special="frozen"),
    Trial("pop-up during the exposure", "window, whole time", (PopUp(),), stays=False, at=LIT),
    Trial("pop-up during the exposure", "window, 10 % of it", (PopUp(share=0.1),), stays=False, at=LIT),
    Trial("pop-up during the exposure", "whole picture (255, 136, 0)", (PopUp(place=(-9, -9, 9, 9)),), False, LIT),
    Trial("bump", "0.3 px", (Bump(px=0.3),), at=LIT),
    Trial("bump", "1 px", (Bump(px=1),), at=LIT),
    Trial("bump", "3 px", (Bump(px=3),), at=LIT),
    Trial("bump", "8 px", (Bump(px=8),), at=LIT),
    Trial("lamp", "−2 %", (LampStep(percent=-2),), at=LIT),
    Trial("lamp", "−10 %", (LampStep(percent=-10),), at=LIT),
    Trial("lamp", "−50 %", (LampStep(percent=-50),), at=LIT),
    Trial("light in the room", "+1 %", (AmbientStep(percent=1),), at=ANY),
    Trial("light in the room", "+3 %", (AmbientStep(percent=3),), at=ANY),
    Trial("light in the room, warm", "+1 %", (AmbientStep(percent=1, rgb=(1.6, 1.0, 0.4)),), at=ANY),
    Trial("defocus", "1 px", (Defocus(px=1),), at=LIT),
    Trial("defocus", "3 px", (Defocus(px=3),), at=LIT),
    Trial("person", "a quarter of the chart", (Person(),), at=LIT),
    Trial("hand", "3 % of the chart", (Person(place=(0.3, 0.4, 0.5, 0.6), left=0.3),), at=LIT),
    Trial("half-changed picture", "half", (HalfChanged(),), stays=False),
    Trial("half-changed picture", "half, a fifth of the time", (HalfChanged(share=0.2),), stays=False),
    Trial("half-changed picture", "a corner, 4 %", (HalfChanged(place=(-9, -9, 0.2, 0.2)),), stays=False),
    Trial(
        "late picture",
        "5 % of the time the light before",
        (HalfChanged(place=(-9, -9, 9, 9), share=0.05),),
        stays=False,
    ),
    Trial("repeated file", "of the light before", stays=False, special="file"),
    Trial("repeated file", "of the same light", stays=False, special="again"),
    Trial("zeroed strip", "5 % of the rows", (ZeroedStrip(),), stays=False, at=ANY),
    Trial("zeroed strip", "0.3 %", (ZeroedStrip(top=0.5, bottom=0.503),), stays=False, at=ANY),
    Trial("scrambled rows", "20 %", (ScrambledRows(),), stays=False, at=LIT),
    Trial("scrambled rows", "4 %", (ScrambledRows(top=0.5, bottom=0.54),), stays=False, at=LIT),
    Trial("another camera", "serial number", special="serial", at=ANY),
    Trial("another camera", "model", special="model", at=ANY),
    Trial("another ISO speed", "200", special="iso", at=ANY),
    Trial("colours exchanged", "red for blue", at=TWO_COLOURED, special="exchanged"),
)


_ANOTHER_LIGHT = "still seen|another light is seen|not the one ordered"
_ELSEWHERE = "light from elsewhere|other light fall on the chart|was a lamp or a display switched"

NAMED = {
    "frozen screen, from a frame on": _ANOTHER_LIGHT,
    "stale frame": _ANOTHER_LIGHT,
    "pop-up during the exposure": f"a window cover|{_ANOTHER_LIGHT}",
    "bump": "the chart has moved|not recognised where it was",
    "lamp": "the lamp",
    "light in the room": _ELSEWHERE,
    "light in the room, warm": _ELSEWHERE,
    "defocus": "focus",
    "person": "does somebody or something stand before",
    "hand": "does somebody or something stand before",
    "half-changed picture": "only a part of the picture had changed|did only a part of the picture change|"
    "did only a part of it change|did the picture change during",
    "late picture": "light of the frame before|is the picture late|did the picture change during",
    "repeated file": "a frame that it had given before",
    "zeroed strip": "part of the file was lost",
    "scrambled rows": "the file was damaged",
    "another camera": "connect the camera",
    "another ISO speed": "ISO speed 200",
    "colours exchanged": _ANOTHER_LIGHT,
}
"""What of each disturbance a sentence names; what cannot be told apart by one frame is named with its alternatives."""


@dataclass
class Tally:
    """How often something was refused at its frame, at the next one, not at all, with another cause, and by which."""

    at_once: int = 0
    next: int = 0
    missed: int = 0
    misnamed: int = 0
    causes: Counter[str] = field(default_factory=Counter)


def cause(judgement: Judgement) -> str:
    """Return the name of the check that refused a frame; empty if none did."""
    return next((check.name for check in judgement.checks if check.reason), "")


def steps_of(lab: Lab, at: str, random: np.random.Generator) -> Iterator[SessionStep]:
    """Yield steps at which a disturbance is tried: lights of the plan, deep blue and red ones, white, black."""
    fixed = [Colour(0, 0, 255), Colour(255, 0, 0), Colour(255, 255, 255), Colour(0, 48, 255)]
    lights = [*fixed, *(lab.plan[int(k)].colour for k in random.permutation(len(lab.plan)))]
    if at == TWO_COLOURED:
        lights = [colour for colour in lights if abs(colour.red - colour.blue) > 16]
    if at in (ANY, LIT):
        yield SessionStep(9000, "white", None, WHITE)
    if at == ANY:
        yield SessionStep(9001, "dark", None, BLACK)
    for number, colour in enumerate(lights, 9002):
        yield SessionStep(number, "light", 0, colour)


def disturbed(lab: Lab, trial: Trial, step: SessionStep, shown: Colour) -> Judgement:
    """Return what is said of a frame of a step with a disturbance; `shown` is the light of the frame before."""
    if trial.special == "frozen":
        judgement = lab.show(lab.counts(shown), step)
    elif trial.special == "exchanged":
        red, green, blue = step.colour.codes
        judgement = lab.show(lab.counts(Colour(blue, green, red)), step)
    elif trial.special == "serial":
        judgement = lab.show(lab.counts(step.colour), step, serial="7")
    elif trial.special == "model":
        judgement = lab.show(lab.counts(step.colour), step, body=replace(lab.body, model="Canon EOS 77D"))
    elif trial.special == "iso":
        twice = replace(lab.settings.camera.exposure, iso=200)
        counts = lab.world.expose(step.colour, twice, key=(next(lab.keys),))
        judgement = lab.show(counts, step, settings=twice)
    else:
        judgement = lab.take(step, *trial.events)
    return judgement


def detection(labs: Sequence[Lab], tries: int) -> dict[tuple[str, str], Tally]:
    """Return how often each disturbance was seen, tried so often in each lab."""
    table: dict[tuple[str, str], Tally] = {}
    for number, lab in enumerate(labs):
        random = np.random.default_rng(number)
        for trial in TRIALS:
            tally = table.setdefault((trial.name, trial.size), Tally())
            for step in itertools.islice(steps_of(lab, trial.at, random), tries):
                before, after = (lab.plan[int(k)].colour for k in random.choice(len(lab.plan), 2, replace=False))
                if step.colour in (before, after):
                    continue
                one = lab.fork()
                counts = one.counts(before)
                accepted = one.show(counts, SessionStep(8999, "light", 0, before))
                one.before = before
                if not accepted.accepted:
                    tally.causes["(frame before refused)"] += 1
                    continue
                if trial.special == "file":
                    said = one.show(counts, step)
                elif trial.special == "again":
                    said = one.show(counts, SessionStep(8999, "light", 0, before))
                else:
                    said = disturbed(one, trial, step, before)
                if said.accepted and trial.stays:
                    said = disturbed(one, trial, SessionStep(9999, "light", 0, after), before)
                    tally.next += not said.accepted
                else:
                    tally.at_once += not said.accepted
                tally.missed += said.accepted
                tally.causes[cause(said) or "(missed)"] += 1
                if said.accepted:
                    print(f"missed: {trial.name} {trial.size} at {step.kind} {step.colour}", file=sys.stderr)
                elif not trial.is_named_in(said.reason):
                    tally.misnamed += 1
                    where = f"{trial.name} {trial.size} in room {number} at {step.kind} {step.colour}"
                    print(f"misnamed: {where} after {before}: {said.reason}", file=sys.stderr)
    return table


# False alarms


def rooms(seed: int) -> tuple[Room, dict[str, Any]]:
    """Return a room drawn by its seed, and what else is special in its lab."""
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
    more: dict[str, Any] = {"shutter_s": 0.25 if seed % 10 == 3 else 0.5}
    return room, more


def drifting(frames: int) -> Disturbances:
    """Return a lamp that loses 2 % in a session, blue more, and a sensor that warms up."""
    return Disturbances((LampDrift(percent=-2, rgb=(0, 0, -0.4), to_frame=frames), SensorWarming(to_frame=frames)))


def with_white_segment(room: Room, share: float) -> Projector:
    """Return a projector whose wheel has a white segment, which shows what the three colours have in common."""

    def light(colour: Colour, before: Colour) -> npt.NDArray[np.float64]:
        alone = room.light_of(np.array(colour.codes)) / (1 + share)
        return np.asarray(alone + share * alone.min(), dtype=np.float64)

    return light


def with_memory(room: Room, share: float) -> Projector:
    """Return a projector whose primaries are weaker, by up to a share, the brighter each was in the picture before."""

    def light(colour: Colour, before: Colour) -> npt.NDArray[np.float64]:
        now, past = (room.light_of(np.array(c.codes)) for c in (colour, before))
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
        limit = [c.high for _, one in said[-20:] for c in one.checks if c.name == "light" and c.high is not None]
        found.append((name, len(said), sum(causes.values()), causes, f"{np.median(limit):.2f}°" if limit else ""))
        for step, one in said:
            if not one.accepted:
                print(f"{name}: {step.stem} {step.colour}: {one.reason}", file=sys.stderr)
    return found


# Neighbours


def neighbours(model: ProjectorModel, plan: Sequence[Illumination]) -> tuple[int, int, list[str]]:
    """Return how many lights have another, and how many the next of the list, that they cannot be told from; and which.

    A light that is seen instead is told if it would be on average: by `limits.STALE_SIGMAS` and `STALE_ADVANTAGE`.
    """
    codes = [light.codes for light in plan]
    amounts = np.array([model.predict(one).amounts for one in codes])
    least = max(limits.STALE_SIGMAS, limits.STALE_ADVANTAGE**0.5)

    def told(seen: int, ordered: int) -> bool:
        fit = model.compare(amounts[seen], codes[ordered])
        return float(np.hypot(fit.distance, fit.brightness / fit.brightness_sd)) > least

    pairs: set[tuple[int, int]] = set()
    for k in range(len(plan)):
        near = np.argsort(np.linalg.norm(amounts - amounts[k], axis=1))[1:9].tolist()
        pairs |= {(min(k, n), max(k, n)) for n in near if codes[n] != codes[k] and not (told(n, k) and told(k, n))}
        pairs |= {(min(k, n), max(k, n)) for n in near if codes[n] == codes[k]}
    lights = {one for pair in pairs for one in pair}
    following = sum((k, k + 1) in pairs for k in range(len(plan) - 1))
    return len(lights), following, [f"{plan[a].codes} and {plan[b].codes}" for a, b in sorted(pairs)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detection", description=__doc__)
    parser.add_argument("--rooms", type=int, default=4, metavar="N", help="small rooms for the detection")
    parser.add_argument(
        "--tries", type=int, default=8, metavar="N", help="frames that a disturbance is tried at, a room"
    )
    parser.add_argument("--sessions", type=int, default=100, metavar="N", help="undisturbed sessions, a fifth drifting")
    parser.add_argument("--lights", type=int, default=36, metavar="N", help="lights of such a session")
    parser.add_argument("--full", action="store_true", help="an EOS 550D before the whole chart, too")
    options = parser.parse_args(arguments)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        labs: list[Lab] = []
        for seed in range(options.rooms):
            room, more = rooms(3 * seed + 1)
            labs.append(lab_of(folder, room, **more))
        if options.full:
            labs.append(lab_of(folder, Room(seed=9, wheel_hz=60), "EOS 550D", design_chart(5, "A0")))
        for number, lab in enumerate(labs):
            for step, said in lab.session(options.lights, 12, number):
                if not said.accepted:
                    print(f"room {number}: {step.stem} refused: {said.reason}", file=sys.stderr)
        print("| disturbance | size | tried | at the frame | at the next | missed | misnamed | causes |")
        print("|---|---|---|---|---|---|---|---|")
        for (what, size), tally in detection(labs, options.tries).items():
            causes = ", ".join(f"{one} {count}" for one, count in tally.causes.most_common())
            tried = tally.at_once + tally.next + tally.missed
            counts = f"{tried} | {tally.at_once} | {tally.next} | {tally.missed} | {tally.misnamed}"
            print(f"| {what} | {size} | {counts} | {causes} |")
        if labs:
            lights, following, which = neighbours(labs[0].judge.knowledge.model, labs[0].plan)
            scatter = labs[0].judge.knowledge.model
            print(
                f"\nScatter learnt in the first room: {scatter.chroma_sd:.2%} of colours, {scatter.brightness_sd:.2%}."
            )
            print(f"{lights} of {len(labs[0].plan)} lights have another that could stand for them unnoticed;")
            print(f"{following} of them are followed by it in the list: {'; '.join(which)}")
        if options.sessions:
            refused, frames, causes = false_alarms(folder, options.sessions, options.lights, options.sessions // 5)
            print(
                f"\nFalse alarms: {refused} of {options.sessions} sessions, {sum(causes.values())} of {frames} frames",
                end="",
            )
            print(f" ({', '.join(f'{one} {count}' for one, count in causes.items())})" if causes else "")
            print("\n| world | frames | refused | causes | limit of light at the end |\n|---|---|---|---|---|")
            for what, count, wrong, named, limit in odd_worlds(folder, options.lights):
                print(f"| {what} | {count} | {wrong} | {dict(named) or ''} | {limit} |")
    print(f"\n{time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
