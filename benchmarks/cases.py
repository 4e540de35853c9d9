"""Difficult lenses and careless laboratories as named cases: rooms and frames with a known fault.

Each `NamedCase` has a room, frames that differ from the plan, and two regular expressions: for right causes and for
wrong causes that a verdict may name. `try_case` takes a short session, builds its LUT, compares it with the truth and
reports one of these failures:

- *silent*: the LUT is wrong, and the verdict accepts it or names no right cause;
- *wrong cause*: the verdict names a wrong cause or no right cause, with or without a LUT;
- *false remark*: there is a remark although nothing is wrong;
- *unsaid*: the LUT is right, but an expected remark is missing.

A LUT is wrong if the error of a ground truth exceeds `WRONG_DEG`, or if the error of a patch mean of at least 300
counts (brightness error included) exceeds `WRONG_SHARE`. The error must also exceed twice the reported uncertainty (k =
2).
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
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.errors import CropError
from sim.optics import MILD_SHOULDERS, STRONG_SHOULDERS
from sim.world.sensors import BODIES
from sim.world.world import Blob, Glare, Room, Situation, World

# Ground truth error, in degrees, that counts as wrong; errors in random rooms are within 0.02°.
WRONG_DEG: Final = 0.1

# Relative error of a patch mean that counts as wrong: three standard deviations of its noise at 300 counts.
WRONG_SHARE: Final = 0.03

HALF: Final = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.25)
FAST: Final = ExposureSettings(iso=200, aperture=8.0, shutter_s=0.25)

_STAINED: Final = r"clean the print|print it again"
_BRILLIANT: Final = r"brilliant"
_HAND: Final = r"\bhands?\b|shadow"
_GLARE: Final = r"reflection|glare|mirror"
_SPREAD: Final = r"bleed|neighbouring (?:cells|patches)|neighbours'? (light|colour)|spread|veil|correction"


# Causes that are wrong in most cases.
_NOT_SO: Final = rf"{_STAINED}|{_BRILLIANT}|{_HAND}|{_GLARE}"


@dataclass(frozen=True, eq=False)
class NamedCase:
    """One case: a room, the changes of its frames, and the causes that a verdict may name."""

    name: str
    what: str
    right: str  # regular expression of right causes; a remark or refusal must match it if the LUT is wrong
    wrong: str  # regular expression of wrong causes; "." if nothing is wrong
    # differences of frames from room and plan
    changes: Callable[[World, Chart, Sequence[Illuminant]], Changes] = lambda world, chart, lights: as_planned
    room: Mapping[str, Any] = field(default_factory=dict[str, Any])  # differences from the default room
    lights: Mapping[str, Colour] = field(default_factory=lambda: dict(EIGHT_LIGHTS))
    settings: str = "rig = 'simulated'\n"
    every: int = 25  # illuminants between two white references
    must_say: bool = False  # the right cause is expected although the LUT is right


def _other_camera(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    body = replace(world.body, model="Canon EOS 5D Mark II", sensitivities="Canon_EOS_5D_Mark_II")
    world_of_body = World(world.sheet, body, world.room)
    changed = FrameChange(world=world_of_body, serial="000000000077")
    return lambda step: changed if light_named(lights, step) in ("warm", "violet") else AS_PLANNED


def _exchanged(first_name: str, second_name: str) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    """Exchange the files of two illuminants."""
    first, second = EIGHT_LIGHTS[first_name], EIGHT_LIGHTS[second_name]

    def changes(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
        exchanged = {first_name: FrameChange(colour=second), second_name: FrameChange(colour=first)}
        return lambda step: exchanged.get(light_named(lights, step) or "", AS_PLANNED)

    return changes


def _exchanged_reference(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    """Exchange the first white reference and the frame of the red primary."""

    def changes(step: SessionStep) -> FrameChange:
        if step.number == 0:
            return FrameChange(colour=EIGHT_LIGHTS["red"])
        return FrameChange(colour=WHITE) if light_named(lights, step) == "red" else AS_PLANNED

    return changes


def _lights_alone(*names: str, **change: Any) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    """Change the frames of some illuminants."""
    changed = FrameChange(**change)

    def changes(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
        return lambda step: changed if light_named(lights, step) in names else AS_PLANNED

    return changes


def _whites(**change: Any) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed if step.kind == "white" else AS_PLANNED


def _later_white(**change: Any) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    """Change all white references except the first."""
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed if step.kind == "white" and step.number else AS_PLANNED


def _all(**change: Any) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed


def _later(**change: Any) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    """Change every frame from `_MIDWAY` on."""
    changed = FrameChange(**change)
    return lambda world, chart, lights: lambda step: changed if step.number >= _MIDWAY else AS_PLANNED


# First step with a lasting change in a short session: half of its illuminants are taken.
_MIDWAY: Final = 6


def _hot_photosite(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    """Add 3000 counts to one photosite in the middle of the darkest patch, in dark frames too."""
    darkest = int(np.argmin(chart.rgb.astype(np.int64).sum(axis=1)))
    column, row = np.round(world.project(chart.centres_mm[darkest])).astype(np.int64).tolist()
    site = world.body.visible.top + 2 * row, world.body.visible.left + 2 * column + 1
    changed = FrameChange(counts_added={site: 3000})
    return lambda step: changed


def _other_print(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    """Replace the print midway by another with as many colours; its tags are at the same positions."""
    small = chart.colour_count < _FULL_COLOURS
    second_world = world_of(chart_of(small, seed=7), world.body, world.room)
    changed = FrameChange(world=second_world)
    return lambda step: changed if step.number >= _MIDWAY else AS_PLANNED


class _Settling(World):
    """A room whose projector is still changing: each frame contains part of another illuminant."""

    def __init__(self, world: World, previous: Colour, share: float) -> None:
        super().__init__(world.sheet, world.body, world.room)
        self._previous, self._share = previous, share

    def decoded(self, colour: Colour) -> npt.NDArray[np.float64]:
        """Return the light of each primary as `World.decoded`, including the part of the previous illuminant."""
        return (1 - self._share) * super().decoded(colour) + self._share * super().decoded(self._previous)


def _mixed(light: str, previous: str, share: float) -> Callable[[World, Chart, Sequence[Illuminant]], Changes]:
    """Mix a share of another illuminant into the frame of `light`."""

    def changes(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
        mixed = FrameChange(world=_Settling(world, EIGHT_LIGHTS[previous], share))
        return lambda step: mixed if light_named(lights, step) == light else AS_PLANNED

    return changes


class _CutWorld(World):
    """A room whose camera writes zeros in the last third of the sensor rows."""

    def expose(self, *arguments: Any, **named: Any) -> npt.NDArray[np.uint16]:
        """Return a frame as `World.expose` does, without its last third."""
        counts = super().expose(*arguments, **named)
        counts[2 * len(counts) // 3 :] = 0
        return counts


def _cut(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    cut = FrameChange(world=_CutWorld(world.sheet, world.body, world.room))
    return lambda step: cut if light_named(lights, step) == "warm" else AS_PLANNED


class _BandedWorld(World):
    """A room whose sensor adds a random offset to each row of each frame."""

    def expose(self, *arguments: Any, **named: Any) -> npt.NDArray[np.uint16]:
        """Return a frame as `World.expose` does; the row offsets have a standard deviation of 2 counts."""
        counts = super().expose(*arguments, **named)
        rows = 2.0 * np.random.default_rng((self.room.seed, *named["key"])).standard_normal((len(counts), 1))
        return np.clip(np.rint(counts + rows), 0, self.body.saturation).astype(np.uint16)


def _one_white(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    return lambda step: FrameChange(number=0) if step.kind == "white" else AS_PLANNED


def _banded(world: World, chart: Chart, lights: Sequence[Illuminant]) -> Changes:
    banded = FrameChange(world=_BandedWorld(world.sheet, world.body, world.room))
    return lambda step: banded


# Colours of a chart with five bits.
_FULL_COLOURS: Final = 32768

# A broad reflection on most of the upper half of the print.
_SPOT: Final = (0.1, -0.2, 0.9, 0.8)

# Hand and forearm in front of the print.
_HAND_AT: Final = (0.55, 0.35, 0.68, 0.7)

# The cases, in the order of the printed table.
CASES: Final[tuple[NamedCase, ...]] = (
    NamedCase("nothing-wrong", "a good lens, a good lab", r"(?!)", r".", room={"veil": 0.002, "lateral_red_px": 0.3}),
    NamedCase(
        "other-camera",
        "two of eight illuminants from another camera; the files contain its model and serial number",
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
        "the files of the white illuminant and the red primary exchanged",
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
        "two illuminants at half the exposure, as recorded in their files",
        r"expos|shutter",
        _NOT_SO,
        _lights_alone("warm", "violet", settings=HALF),
    ),
    NamedCase(
        "half-exposed-whites",
        "the white references at half the exposure, as recorded in their files",
        r"expos|shutter",
        _NOT_SO,
        _whites(settings=HALF),
    ),
    NamedCase(
        "other-iso",
        "two illuminants at twice the ISO speed and half the time: equally bright, but noisier",
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
        "one photosite 3000 counts too high in a dark patch, in every frame",
        r"\bhot\b",
        _NOT_SO,
        _hot_photosite,
    ),
    NamedCase(
        "fall-off",
        "half as much light in the corners as in the centre",
        r"fall-?off|vignett|corner",
        _NOT_SO,
        room={"vignetting": 0.45, "projector_falloff": 0.2},
    ),
    NamedCase(
        "short-waves",
        "waves of 150 mm, 6 mm high, and a curl of 25 mm, with a wide-angle lens",
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
        "a hand in front of the print in the second white reference",
        _HAND + r"|object",
        rf"{_STAINED}|{_BRILLIANT}",
        _later_white(situation=Situation(blobs=(Blob(_HAND_AT),))),
    ),
    NamedCase(
        "hand-in-light",
        "a hand in front of the print under one illuminant",
        _HAND + r"|object",
        rf"{_STAINED}|{_BRILLIANT}",
        _lights_alone("warm", situation=Situation(blobs=(Blob(_HAND_AT),))),
    ),
    NamedCase(
        "broad-glare",
        "a broad reflection of 3 % of the paper's light, in every frame",
        _GLARE,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        _all(situation=Situation(glares=(Glare(_SPOT, 0.03),))),
    ),
    NamedCase(
        "leak",
        "room light of 1 % of white under half of the illuminants, but in no dark frame",
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
        "a stain on the print, in every frame",
        r"probably a stain",
        rf"{_BRILLIANT}|\bhands?\b",
        room={"stain_mm": 25.0, "stain_depth": 0.3},
    ),
    NamedCase(
        "bump",
        "the print moves by 3 px midway; the sampling grid follows",
        r"mov|push|bump|displac",
        _NOT_SO,
        _later(situation=Situation(bump_px=(2.6, 1.5))),
    ),
    NamedCase(
        "defocus",
        "the focus changes midway: σ grows by 0.9 px",
        r"focus|blur|soft|sharp",
        _NOT_SO,
        _later(situation=Situation(defocus_px=0.9)),
    ),
    NamedCase(
        "other-print",
        "another print is used from the middle of the session on",
        r"print|poster|chart",
        rf"{_STAINED}|{_BRILLIANT}|{_GLARE}",
        _other_print,
    ),
    # An illuminant without a code of 0 makes no wrong LUT: its ground truth is the light that was there. Eight
    # illuminants do not determine the tone curve well enough to detect 5 %.
    NamedCase(
        "mixed-red",
        "5 % of blue in the frame of the red primary: the projected image had not settled",
        r"settle|another light|name",
        _NOT_SO,
        _mixed("red", "blue", 0.05),
        must_say=True,
    ),
    NamedCase(
        "mixed-dim",
        "5 % of white in the frame of a dim illuminant",
        r"settle|another light|name",
        _NOT_SO,
        _mixed("dim", "white", 0.05),
    ),
    NamedCase("upside-down", "the chart is upside down", r"(?!)", r".", room={"roll_deg": 180.0}),
    NamedCase(
        "wrong-iso",
        "every file records another ISO speed than the settings of the session",
        r"\bISO\b",
        _NOT_SO,
        _all(settings=FAST),
        settings="rig = 'simulated'\n[camera]\niso = 100\n",
        must_say=True,
    ),
    NamedCase(
        "banding",
        "photosite response differs by 2 %, rows have offsets of 2 counts",
        r"hot|noise|photosites|sensor|rows",
        _NOT_SO,
        _banded,
        room={"response_spread": 0.02},
    ),
    NamedCase(
        "shadow-in-primary",
        "a tenth of the light is missing in the frame of the red primary",
        r"one primary",
        rf"{_STAINED}|{_BRILLIANT}|{_GLARE}",
        _lights_alone("red", situation=Situation(lamp=(0.9, 0.9, 0.9))),
        must_say=True,
    ),
    NamedCase(
        "shadow-on-primary",
        "a shadow of a tenth of the light on part of the print, in the frame of the red primary",
        _HAND,
        rf"{_STAINED}|{_BRILLIANT}|{_GLARE}",
        _lights_alone("red", situation=Situation(blobs=(Blob(_HAND_AT, left=0.9),))),
    ),
    NamedCase(
        "cut-file",
        "the last third of one frame is zero",
        r"zeros",
        _NOT_SO,
        _cut,
        must_say=True,
    ),
    NamedCase(
        "colour-wheel",
        "a colour wheel with 50 turns per second, and exposures that end within a turn",
        r"wheel",
        _NOT_SO,
        _all(settings=ExposureSettings(iso=100, aperture=8.0, shutter_s=0.51)),
        room={"wheel_hz": 50.0},
        every=3,
        must_say=True,
    ),
    NamedCase(
        "hot-photosites",
        "2800 hot photosites per million",
        r"\bhot\b",
        rf"{_NOT_SO}|focus",
        room={"hot_per_million": 2800.0},
        must_say=True,
    ),
    NamedCase(
        "one-white",
        "all white references are the same file",
        r"is that of another frame|one photograph",
        _NOT_SO,
        _one_white,
        every=3,
        must_say=True,
    ),
    NamedCase(
        "mild-glare",
        "a broad reflection of 2 % of the paper's light, in every frame",
        _GLARE,
        rf"{_STAINED}|{_BRILLIANT}|{_HAND}",
        _all(situation=Situation(glares=(Glare(_SPOT, 0.02),))),
    ),
)

# Failures of a verdict.
FAILURES: Final = ("silent", "wrong_cause", "false_remark", "unsaid")

BY_NAME: Final[Mapping[str, NamedCase]] = {case.name: case for case in CASES}


@cache
def chart_of(small: bool, seed: int = 1) -> Chart:
    """Return a chart of 32768 colours on A0, or a small one of 512 colours on A5."""
    return design_chart(3, A_SERIES_MM["A5"], seed) if small else design_chart(5, A_SERIES_MM["A0"], seed)


# Figure of a verdict: error remaining after lens correction.
LENS_LEFT: Final = "correction_residual"

# The reported RMS error counts as correct if it differs from the RMS error of the LUT by fewer standard errors.
_TRUE_WITHIN: Final = 2.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of one session."""

    verdict: str  # accept, accept with remarks, or refuse
    rows: tuple[str, ...]  # figures that are not accepted; empty after an error
    says: tuple[str, ...]  # remarks or refusal, as the user reads them
    truth: TableTruth | None  # the LUT compared with the truth; None without a LUT
    lens_left: float = 0.0  # reported RMS error of patch means after lens correction

    @property
    def remarks_without_lens(self) -> tuple[str, ...]:
        """Remarks without the one about the remaining lens error, if that figure is correct.

        With a chart of few colours, veiling glare cannot be measured, and this remark is always made.
        """
        is_correct = self.truth is None or self.truth.rms <= _TRUE_WITHIN * self.lens_left
        if not is_correct or len(self.rows) != len(self.says):
            return self.says
        return tuple(text for row, text in zip(self.rows, self.says, strict=True) if row != LENS_LEFT)

    @property
    def is_wrong(self) -> bool:
        """Whether an error in the LUT exceeds both the limit and twice the reported uncertainty."""
        truth = self.truth
        return truth is not None and bool(
            (truth.light_deg > np.maximum(WRONG_DEG, 2 * truth.light_uncertainty)).any()
            or (truth.cell_error > np.maximum(WRONG_SHARE, 2 * truth.cell_uncertainty))[truth.lit].any()
        )

    def mentions(self, words: str) -> bool:
        """Return whether a remark or the refusal matches a regular expression, ignoring case."""
        return any(re.search(words, text, re.IGNORECASE) for text in self.says)

    def to_json(self) -> dict[str, Any]:
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
    """Build the LUT of a session in a folder and return the result."""
    try:
        result = build(session, folder)
    except CropError as error:
        return Outcome("refuse", (), (str(error),), None)
    verdict = result.verdict
    says = tuple(remark(row, result.figures) for row in verdict.remarks)
    truth = compare(result, open_lut(folder), world, chart, session, changes, every)
    names = tuple(row.figure.name for row in verdict.remarks)
    return Outcome(
        verdict.outcome, names, says, truth, result.figures.lens.remaining_rms if LENS_LEFT in names else 0.0
    )


def try_case(case: NamedCase, *, small: bool, seed: int = 1, body: str = "EOS 550D") -> dict[str, Any]:
    """Take and build a short session of a case and return one JSON line about it."""
    started = time.perf_counter()
    chart, lights = chart_of(small), short_plan(case.lights)
    room = replace(Room(seed=seed), **case.room)
    world = world_of(chart, BODIES["Test" if small else body], room)
    changes = case.changes(world, chart, lights)
    with (
        tempfile.TemporaryDirectory() as folder,
        short_session(Path(folder) / "session", chart, world, changes, lights, case.every, case.settings) as session,
    ):
        outcome = outcome_of(session, Path(folder) / "lut", world, chart, changes, case.every)
    # A small chart cannot detect everything: for it, a remark about the remaining lens error is not false.
    judged = replace(outcome, says=outcome.remarks_without_lens if small else outcome.says)
    names_right, names_wrong = outcome.mentions(case.right), judged.mentions(case.wrong)
    if LENS_LEFT in outcome.rows and len(outcome.remarks_without_lens) == len(outcome.says):
        # If the reported error is smaller than the true error, it does not explain the true error.
        names_right = False
    row: dict[str, Any] = {"case": case.name, "what": case.what} | outcome.to_json()
    row["silent"] = outcome.is_wrong and not names_right
    row["wrong_cause"] = case.wrong != "." and bool(judged.says) and (names_wrong or not names_right)
    row["false_remark"] = case.wrong == "." and bool(judged.says)
    row["unsaid"] = case.must_say and not names_right
    row["seconds"] = round(time.perf_counter() - started, 1)
    return row
