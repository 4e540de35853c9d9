"""Disturbances of a frame, the frames on which each is tried, and the detections by the live judge."""

from __future__ import annotations

import itertools
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.judged_labs import Lab, cause
from drivers.presenter import BLACK, WHITE, Colour
from experiment.session.records import Judgement, SessionStep
from sim.world.disturbances import (
    AmbientStep,
    AnyDisturbance,
    Bump,
    DeadPrimary,
    Defocus,
    HalfChanged,
    LampStep,
    Person,
    PopUp,
    ScrambledRows,
    ScreenSaver,
    ZeroedStrip,
)

LIGHT, ANY, LIT, TWO_COLOURED = "lights", "any", "lit", "lights with more of red than of blue, or less"


@dataclass(frozen=True)
class Trial:
    """A disturbance of one frame. A message with the right cause matches its pattern in `NAMED`."""

    name: str
    size: str  # description of its strength
    events: tuple[AnyDisturbance, ...] = ()  # changes of the simulated room
    stays: bool = True  # it lasts, so the next frame may detect it
    at: str = LIGHT  # kinds of frames on which it is tried
    special: str = ""  # disturbance outside the room: file, serial number, …

    def is_named_in(self, reason: str) -> bool:
        return re.search(NAMED[self.name], reason) is not None


TRIALS = (
    Trial("frozen screen", "for several frames", special="frozen"),
    Trial("frozen screen", "for one frame", stays=False, special="frozen"),
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
    Trial("person", "walks past, a tenth of the light", (Person(place=(0.2, -0.2, 0.55, 1.2), left=0.9),), False, LIT),
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
    Trial("dead primary", "red", (DeadPrimary(),), at=LIT),
    Trial("dead primary", "blue", (DeadPrimary(primary="blue"),), at=LIT),
    Trial("screen saver", "whole picture", (ScreenSaver(),), at=LIT),
    Trial("screen saver", "a third of the light", (ScreenSaver(share=0.33),), at=LIT),
    Trial("colours exchanged", "red for blue", at=TWO_COLOURED, special="exchanged"),
)


_ANOTHER_LIGHT = "still shows the previous|shows another illuminant|is not the ordered"
_ELSEWHERE = "darken the room|other light than|other light falls on the chart|the room light has changed"

# Pattern of the right cause for each disturbance, with alternatives if one frame cannot distinguish several causes.
NAMED = {
    "frozen screen": _ANOTHER_LIGHT,
    "pop-up during the exposure": f"a window (may have )?cover|a window or a screen saver covers|{_ANOTHER_LIGHT}",
    "bump": "the chart has moved|not detected at its last position",
    "lamp": "the lamp",
    "light in the room": _ELSEWHERE,
    "light in the room, warm": _ELSEWHERE,
    "defocus": "focus",
    "person": "a person or an object is in front|somebody walked past",
    "hand": "a person or an object is in front",
    "half-changed picture": "only part of the projected image ha[ds] changed|the projected image changed during",
    "late picture": "previous illuminant|the projected image is late|the projected image changed during",
    "repeated file": "delivered an earlier frame again",
    "zeroed strip": r"rows, from row \d+,? do not reach",
    "scrambled rows": "the file was damaged",
    "dead primary": "(red|blue) is missing|check the lamp|that the projector is on",
    "screen saver": "screen saver",
    "another camera": "connect the camera",
    "another ISO speed": "ISO speed 200",
    "colours exchanged": _ANOTHER_LIGHT,
}


@dataclass
class Tally:
    """Counts for one disturbance: detected in the same frame, in the next frame, never; wrong causes; causes."""

    at_once: int = 0
    next: int = 0
    missed: int = 0
    wrong_cause: int = 0
    causes: Counter[str] = field(default_factory=Counter)


def steps_of(lab: Lab, at: str, random: np.random.Generator) -> Iterator[SessionStep]:
    """Yield the steps for a disturbance: illuminants of the plan, deep blue and red, white, black."""
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


def disturbed(lab: Lab, trial: Trial, step: SessionStep, previous: Colour) -> Judgement:
    """Judge a frame with a disturbance; `shown` is the illuminant of the previous frame."""
    if trial.special == "frozen":
        judgement = lab.show(lab.counts(previous), step)
    elif trial.special == "exchanged":
        red, green, blue = step.colour
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
    """Try each disturbance in each lab and count the detections."""
    table: dict[tuple[str, str], Tally] = {}
    for number, lab in enumerate(labs):
        random = np.random.default_rng(number)
        for trial in TRIALS:
            tally = table.setdefault((trial.name, trial.size), Tally())
            for step in itertools.islice(steps_of(lab, trial.at, random), tries):
                previous, following = (lab.plan[int(k)].colour for k in random.choice(len(lab.plan), 2, replace=False))
                if step.colour in (previous, following):
                    continue
                fork = lab.fork()
                counts = fork.counts(previous)
                accepted = fork.show(counts, SessionStep(8999, "light", 0, previous))
                fork.previous = previous
                if not accepted.accepted:
                    tally.causes["(previous frame refused)"] += 1
                    continue
                if trial.special == "file":
                    judgement = fork.show(counts, step)
                elif trial.special == "again":
                    judgement = fork.show(counts, SessionStep(8999, "light", 0, previous))
                else:
                    judgement = disturbed(fork, trial, step, previous)
                if judgement.accepted and trial.stays:
                    judgement = disturbed(fork, trial, SessionStep(9999, "light", 0, following), previous)
                    tally.next += not judgement.accepted
                else:
                    tally.at_once += not judgement.accepted
                tally.missed += judgement.accepted
                tally.causes[cause(judgement) or "(missed)"] += 1
                if judgement.accepted:
                    print(f"missed: {trial.name} {trial.size} at {step.kind} {step.colour}", file=sys.stderr)
                elif not trial.is_named_in(judgement.reason):
                    tally.wrong_cause += 1
                    place = f"{trial.name} {trial.size} in room {number} at {step.kind} {step.colour}"
                    print(f"wrong cause: {place} after {previous}: {judgement.reason}", file=sys.stderr)
    return table
