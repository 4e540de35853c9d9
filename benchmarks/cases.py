"""Foreign lenses and careless labs as named cases: rooms and frames in which a table went wrong, or was said to.

Each `NamedCase` is a room, frames that are not what the plan says, and what a verdict may say of it: words of the right
causes, words of wrong ones. `try_case` takes a short session in it, builds its table and holds it against the truth:

- *silent*: a light is `WRONG_DEG` off, or a cell's mean of 300 counts and more by `WRONG_SHARE`, its light's brightness
  included, by more than twice what the table states of it (k = 2), and the verdict is to accept or says nothing of a
  right cause;
- *wrong cause*: the verdict says what is not so, or nothing of a right cause, whether a table came of it or not;
- *false remark*: something is remarked on where nothing is the matter;
- *unsaid*: the table is right, and what should be said of it is not.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.sessions import (
    AS_PLANNED,
    EIGHT_LIGHTS,
    Changes,
    FrameChange,
    TableTruth,
    as_planned,
    compare,
    light_named,
    short_plan,
    short_session,
    world_of,
)
from calibration.pipeline.build import build
from calibration.table.lut import open_lut
from calibration.verdict import remark
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE, Colour
from experiment.chart.layout import A_SERIES_MM, design_chart
from experiment.chart.model import Chart
from experiment.lights import Illumination
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.errors import CropError
from sim.optics import MILD_SHOULDERS, STRONG_SHOULDERS
from sim.world.sensors import BODIES
from sim.world.world import Blob, Glare, Room, Situation, World

# Angle from which a light's ground truth is wrong; those of random rooms are within 0.02.
WRONG_DEG: Final = 0.1

# Error from which a cell's mean is wrong: three standard deviations of its noise at 300 counts.
WRONG_SHARE: Final = 0.03

HALF: Final = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.25)
FAST: Final = ExposureSettings(iso=200, aperture=8.0, shutter_s=0.25)

_STAINED: Final = r"clean the print|print it again"
_BRILLIANT: Final = r"brilliant"
_HAND: Final = r"\bhands?\b|shadow"
_GLARE: Final = r"reflection|glare|mirror"
_SPREAD: Final = r"bleed|neighbouring (?:cells|patches)|neighbours'? (light|colour)|spread|veil|correction"


# Causes that most cases are not.
_NOT_SO: Final = rf"{_STAINED}|{_BRILLIANT}|{_HAND}|{_GLARE}"


@dataclass(frozen=True, eq=False)
class NamedCase:
    """A case.

    - `name`, `what`: what it is called, and what it is.
    - `right`: words, as a regular expression, one of which a remark or a refusal must have where the table is wrong.
    - `wrong`: words of causes that are not there; ``.`` where nothing is the matter.
    - `changes`: how frames differ, from the room and the plan.
    - `room`: how the room differs.
    - `lights`: of the plan, by name.
    - `settings`: the session's settings.
    - `every`: lights from one white reference to the next.
    - `must_say`: whether the right words are expected although the table is right.
    """

    name: str
    what: str
    right: str
    wrong: str
    changes: Callable[[World, Chart, Sequence[Illumination]], Changes] = lambda world, chart, lights: as_planned
    room: Mapping[str, Any] = field(default_factory=dict[str, Any])
    lights: Mapping[str, Colour] = field(default_factory=lambda: dict(EIGHT_LIGHTS))
    settings: str = "rig = 'simulated'\n"
    every: int = 25
    must_say: bool = False


def _other_camera(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    body = replace(world.body, model="Canon EOS 5D Mark II", sensitivities="Canon_EOS_5D_Mark_II")
    other = World(world.sheet, body, world.room)
    foreign = FrameChange(world=other, serial="000000000077")
    return lambda step: foreign if light_named(lights, step) in ("warm", "violet") else AS_PLANNED


def _exchanged(one: str, two: str) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return that the files of two lights stand for each other."""
    first, second = EIGHT_LIGHTS[one], EIGHT_LIGHTS[two]

    def changes(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
        shown = {one: FrameChange(colour=second), two: FrameChange(colour=first)}
        return lambda step: shown.get(light_named(lights, step) or "", AS_PLANNED)

    return changes


def _exchanged_reference(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    """Return that the first white reference and the frame of the red primary stand for each other."""

    def changes(step: SessionStep) -> FrameChange:
        if step.number == 0:
            return FrameChange(colour=EIGHT_LIGHTS["red"])
        return FrameChange(colour=WHITE) if light_named(lights, step) == "red" else AS_PLANNED

    return changes


def _lights_alone(*names: str, **change: Any) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return a change of some lights' frames."""
    changed = FrameChange(**change)

    def changes(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
        return lambda step: changed if light_named(lights, step) in names else AS_PLANNED

    return changes


def _whites(**change: Any) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return a change of the white references' frames."""
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed if step.kind == "white" else AS_PLANNED


def _later_white(**change: Any) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return a change of all white references' frames but the first."""
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed if step.kind == "white" and step.number else AS_PLANNED


def _all(**change: Any) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return a change of every frame."""
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed


def _later(**change: Any) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return a change of every frame from the sixth on."""
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed if step.number >= _MIDWAY else AS_PLANNED


# The step from which a lasting change of a short session is there: after half of its lights.
_MIDWAY: Final = 6


def _hot_photosite(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    """Return that one photosite in the middle of the darkest cell stands 3000 counts too high, in dark frames too."""
    darkest = int(np.argmin(chart.rgb.astype(np.int64).sum(axis=1)))
    column, row = np.round(world.project(chart.centres_mm[darkest])).astype(np.int64).tolist()
    place = world.body.visible.top + 2 * row, world.body.visible.left + 2 * column + 1
    changed = FrameChange(counts_added={place: 3000})
    return lambda step: changed


def _other_print(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    """Return that another print of as many colours hangs there midway, its tags where the first's were."""
    small = chart.colour_count < _FULL_COLOURS
    other = world_of(chart_of(small, seed=7), world.body, world.room)
    changed = FrameChange(world=other)
    return lambda step: changed if step.number >= _MIDWAY else AS_PLANNED


class _Settling(World):
    """A room in which the picture has not settled: part of another light's picture is in each frame."""

    def __init__(self, world: World, other: Colour, share: float) -> None:
        super().__init__(world.sheet, world.body, world.room)
        self._other, self._share = other, share

    def decoded(self, colour: Colour) -> npt.NDArray[np.float64]:
        """Return the light of each primary, the other light's part included, as `World.decoded`."""
        return (1 - self._share) * super().decoded(colour) + self._share * super().decoded(self._other)


def _mixed(light: str, other: str, share: float) -> Callable[[World, Chart, Sequence[Illumination]], Changes]:
    """Return that a share of another light is in a light's frame."""

    def changes(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
        mixed = FrameChange(world=_Settling(world, EIGHT_LIGHTS[other], share))
        return lambda step: mixed if light_named(lights, step) == light else AS_PLANNED

    return changes


class _CutWorld(World):
    """A room whose camera's files are cut and filled with zeros: the last third of the sensor's rows."""

    def expose(self, *arguments: Any, **named: Any) -> npt.NDArray[np.uint16]:
        """Return a frame, as `World.expose`, without its last third."""
        counts = super().expose(*arguments, **named)
        counts[2 * len(counts) // 3 :] = 0
        return counts


def _cut(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    cut = FrameChange(world=_CutWorld(world.sheet, world.body, world.room))
    return lambda step: cut if light_named(lights, step) == "warm" else AS_PLANNED


class _BandedWorld(World):
    """A room whose sensor gives each row an offset of its own in each frame."""

    def expose(self, *arguments: Any, **named: Any) -> npt.NDArray[np.uint16]:
        """Return a frame, as `World.expose`, with offsets of 2 counts, standard deviation."""
        counts = super().expose(*arguments, **named)
        rows = 2.0 * np.random.default_rng((self.room.seed, *named["key"])).standard_normal((len(counts), 1))
        return np.clip(np.rint(counts + rows), 0, self.body.saturation).astype(np.uint16)


def _one_white(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    return lambda step: FrameChange(number=0) if step.kind == "white" else AS_PLANNED


def _banded(world: World, chart: Chart, lights: Sequence[Illumination]) -> Changes:
    banded = FrameChange(world=_BandedWorld(world.sheet, world.body, world.room))
    return lambda step: banded


# Of a chart of five bits.
_FULL_COLOURS: Final = 32768

# A broad reflection: most of the upper half of the print.
_SPOT: Final = (0.1, -0.2, 0.9, 0.8)

# Hand and forearm before the print.
_HAND_AT: Final = (0.55, 0.35, 0.68, 0.7)

# The rows of the table, and what else the causes of a verdict are to tell apart.
CASES: Final[tuple[NamedCase, ...]] = (
    NamedCase("nothing-wrong", "a good lens, a good lab", r"(?!)", r".", room={"veil": 0.002, "lateral_red_px": 0.3}),
    NamedCase(
        "other-camera",
        "two of eight lights from another camera; model and serial number in the file",
        r"camera|model|serial|bod(y|ies)\b",
        _NOT_SO,
        _other_camera,
    ),
    NamedCase(
        "red-blue",
        "the files of the red and the blue primary exchanged",
        r"exchang|name|order|codes",
        _NOT_SO,
        _exchanged("red", "blue"),
    ),
    NamedCase(
        "warm-cool",
        "the files of a warm and a cool white exchanged",
        r"exchang|name|order|codes",
        _NOT_SO,
        _exchanged("warm", "cool"),
    ),
    NamedCase(
        "white-red",
        "the files of the white light and the red primary exchanged",
        r"exchang|name|order|codes",
        _NOT_SO,
        _exchanged("white", "red"),
    ),
    NamedCase(
        "white-reference-red",
        "the first white reference and the red primary exchanged",
        r"exchang|name|order|codes",
        _NOT_SO,
        _exchanged_reference,
    ),
    NamedCase(
        "half-exposed",
        "two lights at half the exposure, as their files say",
        r"expos|shutter",
        _NOT_SO,
        _lights_alone("warm", "violet", settings=HALF),
    ),
    NamedCase(
        "half-exposed-whites",
        "the white references at half the exposure, as their files say",
        r"expos|shutter",
        _NOT_SO,
        _whites(settings=HALF),
    ),
    NamedCase(
        "other-iso",
        "two lights at twice the ISO speed and half the time: as bright, and noisier",
        r"ISO|expos",
        _NOT_SO,
        _lights_alone("warm", "violet", settings=FAST),
        must_say=True,
    ),
    NamedCase(
        "mild-shoulders",
        "MTF 0.96 at 10 and 0.73 at 30 lp/mm",
        _SPREAD,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        room=MILD_SHOULDERS,
    ),
    NamedCase(
        "strong-shoulders",
        "MTF 0.93 at 10 and 0.64 at 30 lp/mm",
        _SPREAD,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        room=STRONG_SHOULDERS,
    ),
    NamedCase("veil", "veiling glare of 1 %", _SPREAD, rf"{_STAINED}|{_BRILLIANT}|{_HAND}", room={"veil": 0.01}),
    NamedCase(
        "mild-and-veil",
        "mild shoulders and veiling glare of 0.5 %",
        _SPREAD,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        room=MILD_SHOULDERS | {"veil": 0.005},
    ),
    NamedCase(
        "hot-photosite",
        "one photosite 3000 counts too high in a dark cell, in every frame",
        r"\bhot\b",
        _NOT_SO,
        _hot_photosite,
    ),
    NamedCase(
        "fall-off",
        "corners at half of the middle's light",
        r"fall-?off|vignett|corner",
        _NOT_SO,
        room={"vignetting": 0.45, "projector_falloff": 0.2},
    ),
    NamedCase(
        "short-waves",
        "waves of 150 mm, 6 mm high, and a curl of 25 mm before a wide-angle lens",
        r"\brim\b|edges? of|uncertain|wav|curl|flat",
        _NOT_SO,
        room={"waviness_mm": 6.0, "wave_mm": 150.0, "curl_mm": 25.0, "focal_diagonals": 0.8},
    ),
    NamedCase(
        "lateral-colour",
        "lateral chromatic aberration of 1 px at the corner, red out and blue in",
        r"chromatic|aberration",
        r".",
        room={"lateral_red_px": 1.0, "lateral_blue_px": -1.0},
    ),
    NamedCase(
        "hand-in-white",
        "a hand before the print in the second white reference",
        _HAND + r"|object",
        rf"{_STAINED}|{_BRILLIANT}",
        _later_white(situation=Situation(blobs=(Blob(_HAND_AT),))),
    ),
    NamedCase(
        "hand-in-light",
        "a hand before the print in one light",
        _HAND + r"|object",
        rf"{_STAINED}|{_BRILLIANT}",
        _lights_alone("warm", situation=Situation(blobs=(Blob(_HAND_AT),))),
    ),
    NamedCase(
        "broad-glare",
        "the print mirrors 3 % of paper's light in a broad spot, in every frame",
        _GLARE,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        _all(situation=Situation(glares=(Glare(_SPOT, 0.03),))),
    ),
    NamedCase(
        "leak",
        "light of the room, 1 % of white, in half of the lights and in no dark frame",
        r"room light|light of the room|ambient|stray light|\bleak",
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        _lights_alone("red", "blue", "warm", "violet", situation=Situation(ambient=(0.01, 0.01, 0.01))),
    ),
    NamedCase(
        "red-missing",
        "a plan without the red primary",
        r"primar",
        _NOT_SO,
        lights={name: colour for name, colour in EIGHT_LIGHTS.items() if name != "red"},
        must_say=True,
    ),
    NamedCase(
        "stain",
        "a thumb's stain on the print, in every frame",
        r"probably a stain",
        rf"{_BRILLIANT}|\bhands?\b",
        room={"stain_mm": 25.0, "stain_depth": 0.3},
    ),
    NamedCase(
        "bump",
        "the print pushed by 3 px midway, and followed",
        r"mov|push|bump|displac",
        _NOT_SO,
        _later(situation=Situation(bump_px=(2.6, 1.5))),
    ),
    NamedCase(
        "defocus",
        "the lens turned midway: σ grows by 0.9 px",
        r"focus|blur|soft|sharp",
        _NOT_SO,
        _later(situation=Situation(defocus_px=0.9)),
    ),
    NamedCase(
        "other-print",
        "another print hangs there midway",
        r"print|poster|chart",
        rf"{_STAINED}|{_BRILLIANT}|{_GLARE}",
        _other_print,
    ),
    # In a light without a code of 0 it is no error of the table: the ground truth is what was there, and eight lights
    # say too little of the tone curve to tell 5 % from it.
    NamedCase(
        "mixed-red",
        "5 % of blue in the frame of the red primary: the picture had not settled",
        r"settle|another light|name",
        _NOT_SO,
        _mixed("red", "blue", 0.05),
        must_say=True,
    ),
    NamedCase(
        "mixed-dim",
        "5 % of white in a dim light's frame",
        r"settle|another light|name",
        _NOT_SO,
        _mixed("dim", "white", 0.05),
    ),
    NamedCase("upside-down", "the chart hangs upside down", r"(?!)", r".", room={"roll_deg": 180.0}),
    NamedCase(
        "wrong-iso",
        "every file states another ISO speed than the session's settings",
        r"\bISO\b",
        _NOT_SO,
        _all(settings=FAST),
        settings="rig = 'simulated'\n[camera]\niso = 100\n",
        must_say=True,
    ),
    NamedCase(
        "banding",
        "photosites differ by 2 %, and rows have offsets of 2 counts",
        r"hot|noise|photosites|sensor|rows",
        _NOT_SO,
        _banded,
        room={"response_spread": 0.02},
    ),
    NamedCase(
        "shadow-in-primary",
        "a tenth of the light lacks in the frame of the red primary",
        r"one primary",
        rf"{_STAINED}|{_BRILLIANT}|{_GLARE}",
        _lights_alone("red", situation=Situation(lamp=(0.9, 0.9, 0.9))),
        must_say=True,
    ),
    NamedCase(
        "shadow-on-primary",
        "a shadow that takes a tenth of the light from a part of the print, in the frame of the red primary",
        _HAND,
        rf"{_STAINED}|{_BRILLIANT}|{_GLARE}",
        _lights_alone("red", situation=Situation(blobs=(Blob(_HAND_AT, left=0.9),))),
    ),
    NamedCase(
        "cut-file",
        "the last third of a light's frame is zeros",
        r"zeros",
        _NOT_SO,
        _cut,
        must_say=True,
    ),
    NamedCase(
        "colour-wheel",
        "a wheel of 50 turns a second, and exposures that end within a turn",
        r"wheel",
        _NOT_SO,
        _all(settings=ExposureSettings(iso=100, aperture=8.0, shutter_s=0.51)),
        room={"wheel_hz": 50.0},
        every=3,
        must_say=True,
    ),
    NamedCase(
        "hot-photosites",
        "2800 hot photosites of a million",
        r"\bhot\b",
        rf"{_NOT_SO}|focus",
        room={"hot_per_million": 2800.0},
        must_say=True,
    ),
    NamedCase(
        "one-white",
        "the white references are one file",
        r"is that of another frame|one photograph",
        _NOT_SO,
        _one_white,
        every=3,
        must_say=True,
    ),
    NamedCase(
        "mild-glare",
        "the print mirrors 2 % of paper's light in a broad spot, in every frame",
        _GLARE,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        _all(situation=Situation(glares=(Glare(_SPOT, 0.02),))),
    ),
)

# What a verdict on a case must not be.
FAILURES: Final = ("silent", "wrong_cause", "false_remark", "unsaid")

BY_NAME: Final[Mapping[str, NamedCase]] = {case.name: case for case in CASES}


@cache
def chart_of(small: bool, seed: int = 1) -> Chart:
    """Return a chart of 32768 colours on A0, or a small one of 512 on A5."""
    return design_chart(3, A_SERIES_MM["A5"], seed) if small else design_chart(5, A_SERIES_MM["A0"], seed)


# The row of a verdict on what the lens leaves.
LENS_LEFT: Final = "correction_residual"

# Standard errors within which the RMS error of a table must lie for the error that its report states to be true.
_TRUE_WITHIN: Final = 2.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a session.

    - `verdict`: ``accept``, ``accept with remarks`` or ``refuse``.
    - `rows`: names of the verdict's rows that are not accepted; of a refusal by an error, nothing.
    - `says`: the remarks, or the refusal, as the user reads them.
    - `truth`: the table against the truth; None where there is none.
    - `lens_left`: RMS error of cells' means that the report says the lens leaves; 0 where nothing is said of it.
    """

    verdict: str
    rows: tuple[str, ...]
    says: tuple[str, ...]
    truth: TableTruth | None
    lens_left: float = 0.0

    @property
    def told(self) -> tuple[str, ...]:
        """What is said beside the error that the lens may leave, where that figure is true.

        A chart of few colours cannot show a veil, and says so whether there is one or not.
        """
        covers = self.truth is None or self.truth.rms <= _TRUE_WITHIN * self.lens_left
        if not covers or len(self.rows) != len(self.says):
            return self.says
        return tuple(text for row, text in zip(self.rows, self.says, strict=True) if row != LENS_LEFT)

    @property
    def is_wrong(self) -> bool:
        """Whether there is a table, and a light or a cell in it is wrong, by more than twice what is stated of it."""
        truth = self.truth
        return truth is not None and bool(
            (truth.light_deg > np.maximum(WRONG_DEG, 2 * truth.light_stated)).any()
            or (truth.cell_error > np.maximum(WRONG_SHARE, 2 * truth.cell_stated))[truth.lit].any()
        )

    def mentions(self, words: str) -> bool:
        """Return whether a remark or the refusal has words, a regular expression, whatever their case."""
        return any(re.search(words, text, re.IGNORECASE) for text in self.says)

    def to_json(self) -> dict[str, Any]:
        """Return the outcome for a line of JSON."""
        row: dict[str, Any] = {"verdict": self.verdict, "rows": list(self.rows)}
        if self.truth is not None:
            truth = self.truth
            red, green, blue = truth.offset_rms_px()
            row |= {
                "light_deg": round(float(truth.light_deg.max()), 4),
                "brightness_percent": round(100 * float(np.abs(truth.brightness - 1).max()), 2),
                "cells_rms_percent": round(100 * truth.rms, 3),
                "cells_worst_percent": round(100 * truth.worst, 2),
                "cells_beyond_3_percent": truth.cells_beyond(WRONG_SHARE),
                "cells_unfit": int((~truth.fit).sum()),
                "centres_rms_px": [round(red, 4), round(green, 4), round(blue, 4)],
                "centre_worst_fit_px": round(truth.worst_offset_px(), 3),
            }
        return row | {"wrong": self.is_wrong, "says": list(self.says)}


def outcome_of(
    session: Session, folder: Path, world: World, chart: Chart, changes: Changes = as_planned, every: int = 25
) -> Outcome:
    """Build a session's table in a folder, and return what came of it."""
    try:
        result = build(session, folder)
    except CropError as refused:
        return Outcome("refuse", (), (str(refused),), None)
    verdict = result.verdict
    says = tuple(remark(row, result.figures) for row in verdict.remarks)
    truth = compare(result, open_lut(folder), world, chart, session, changes, every)
    names = tuple(row.figure.name for row in verdict.remarks)
    return Outcome(verdict.outcome, names, says, truth, result.figures.lens.left if LENS_LEFT in names else 0.0)


def try_case(case: NamedCase, *, small: bool, seed: int = 1, body: str = "EOS 550D") -> dict[str, Any]:
    """Take a short session in a case, build and judge its table, and return a line of JSON on it."""
    started = time.perf_counter()
    chart, lights = chart_of(small), short_plan(case.lights)
    room = replace(Room(seed=seed), **case.room)
    world = world_of(chart, BODIES["Test" if small else body], room)
    changes = case.changes(world, chart, lights)
    with (
        tempfile.TemporaryDirectory() as folder,
        short_session(Path(folder) / "session", chart, world, changes, lights, case.every, case.settings) as session,
    ):
        found = outcome_of(session, Path(folder) / "lut", world, chart, changes, case.every)
    # What a small chart cannot know is no false remark; of a full one it is.
    told = replace(found, says=found.told if small else found.says)
    right, wrong = found.mentions(case.right), told.mentions(case.wrong)
    if LENS_LEFT in found.rows and len(found.told) == len(found.says):
        # A figure that is less than the error says nothing of it.
        right = False
    row: dict[str, Any] = {"case": case.name, "what": case.what} | found.to_json()
    row["silent"] = found.is_wrong and not right
    row["wrong_cause"] = case.wrong != "." and bool(told.says) and (wrong or not right)
    row["false_remark"] = case.wrong == "." and bool(told.says)
    row["unsaid"] = case.must_say and not right
    row["seconds"] = round(time.perf_counter() - started, 1)
    return row
