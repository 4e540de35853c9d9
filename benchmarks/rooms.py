"""Random rooms, for which nothing was tuned: short sessions are taken, and their LUTs are compared with the truth.

`python -m benchmarks.rooms [--rooms N] [--first SEED] [--calm N]` takes a session of eight illuminants in each of N
random rooms and in a number of calm rooms, builds the LUTs and prints one JSON object per room, then a summary. A
random room has short or long waves, a curl, uneven light, hot photosites, and a lens with shoulders (a wide part of the
point spread), veiling glare and lateral colour. A calm room has less of each fault than a careful laboratory tolerates.

Registration or the verdict may refuse a room. A failure is silent if the LUT is wrong and the verdict accepts it or
names another fault. A LUT is wrong if a ground truth has an error of 0.1°, or a patch mean of at least 300 counts an
error of 3 %, and the error exceeds twice the reported uncertainty. In a calm room, every remark on a correct LUT is
false, except a remark about patches that are really small.

`--case NAME` takes a named case of `benchmarks.cases` instead, for example a lens, exchanged files or a hand in front
of the chart, and checks the verdict; `--case all` takes all cases. `--small` uses charts of 512 colours and small
frames.

On one core a room of 18 megapixels takes about 40 s, a small one 3 s. The exit code is 1 after a silent failure, a
wrong cause or a false remark.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.cases import BY_NAME, CASES, FAILURES, LENS_LEFT, WRONG_SHARE, Outcome, chart_of, outcome_of, try_case
from benchmarks.sessions import short_session, world_of
from calibration.figures.geometry import CELL_PX
from calibration.registration.register import Registration, register
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE, Colour
from drivers.raw.rawfile import Mosaic, read_raw
from experiment.chart.layout import A_SERIES_MM, design_chart
from experiment.chart.model import Chart
from experiment.chart.printing import drawing
from experiment.framing.field import field_mm
from sim.camera.film import write_dng
from sim.optics import MILD_SHOULDERS
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import Room, World

# A position error that may hit another colour: well beyond the margin of the sample windows, 0.25 px.
SILENT_PX = 1.0

# Words of remarks that explain wrong patches in a random room.
OF_CELLS = r"bleed|spread|veil|glare|correct|neighbour|uncertain|focus|blur|window|fall-?off|hot"

# Words of remarks that explain a wrong ground truth there.
OF_LIGHTS = r"ground truth|fall-?off|uneven"

SETTINGS = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
TAKEN_AT = datetime(2024, 3, 1, 9, 0, tzinfo=UTC)
LIGHTS = {"white": WHITE, "deep red": Colour(255, 0, 0), "deep blue": Colour(0, 0, 255), "dim": Colour(110, 70, 20)}


@dataclass(frozen=True)
class Case:
    """A room, a camera and an illuminant."""

    seed: int
    body: str
    light: str
    room: Room


def random_case(seed: int) -> Case:
    """Return the room, body and illuminant of a seed.

    Ranges: perspective up to 15°, waves up to 6 mm (a third of them short), blur 0.4 to 0.9 px, shoulders up to 4.5 %,
    veiling glare up to 1.5 %, lateral colour up to 1 px, vignetting up to 40 %.
    """
    random = np.random.default_rng([20, seed])
    tilt, pan = random.uniform(-10.6, 10.6, 2)
    room = Room(
        seed=seed + 1000,
        # Leave space in the frame for perspective and rotation.
        fill=float(random.uniform(0.86, 0.92)),
        focal_diagonals=float(random.uniform(0.9, 2.0)),
        tilt_deg=float(tilt),
        pan_deg=float(pan),
        roll_deg=float(random.uniform(-2, 2) + (180 if random.random() < 0.15 else 0)),
        k1=float(random.uniform(-0.08, 0.05)),
        k2=float(random.uniform(-0.02, 0.02)),
        p1=float(random.uniform(-5e-4, 5e-4)),
        p2=float(random.uniform(-5e-4, 5e-4)),
        waviness_mm=float(random.uniform(0, 6)),
        blur_px=float(random.uniform(0.4, 0.9)),
        vignetting=float(random.uniform(0, 0.4)),
        projector_falloff=float(random.uniform(0, 0.3)),
        primary_difference=float(random.uniform(0, 0.3)),
        lamp_spectrum="led" if random.random() < 0.5 else "uhp",
        ambient=float(random.choice([0, 0.002, 0.01])),
    )
    body = str(random.choice([name for name in sorted(BODIES) if name != "Test"]))
    light = str(random.choice(sorted(LIGHTS), p=[0.2, 0.2, 0.1, 0.5]))
    return Case(seed, body, light, _with_lens(seed, room))


def _with_lens(seed: int, room: Room) -> Room:
    """Add faults beyond a Gaussian lens and long paper waves, from a separate random sequence."""
    random = np.random.default_rng([21, seed])
    short, curled, spread = random.random(3) < (0.33, 0.5, 0.75)
    return replace(
        room,
        wave_mm=float(random.uniform(130, 400)) if short else 0.0,
        curl_mm=float(random.uniform(-20, 20)) if curled else 0.0,
        shoulder_share=float(random.uniform(0, 0.045)) if spread else 0.0,
        shoulder_px=float(random.uniform(1.5, 4)),
        veil=float(random.uniform(0, 0.015)),
        lateral_red_px=float(random.uniform(-1, 1)),
        lateral_blue_px=float(random.uniform(-1, 1)),
        hot_per_million=float(random.choice([0.0, 2.0, 20.0])),
        response_spread=float(random.uniform(0.001, 0.006)),
    )


def natural_vignetting(focal_diagonals: float) -> float:
    """Return the share of light that the best lens loses at the corner of the frame, by focal length in diagonals.

    The loss follows the fourth power of the cosine of the field angle. A growing entrance pupil (Slyusarev effect) is
    assumed to recover one power.

    >>> round(natural_vignetting(2.0), 3) 0.087
    """
    cosine = 1 / np.sqrt(1 + (0.5 / focal_diagonals) ** 2)
    return float(1 - cosine**3)


def calm_case(seed: int) -> Case:
    """Return the room of a seed; all faults are within the limits that a careful laboratory tolerates.

    The corners are as dark as with any lens: under more even light, a lens with veiling glare cannot be recognised,
    which causes a remark (`natural_vignetting`).
    """
    case = random_case(seed)
    room = case.room
    mild = float(MILD_SHOULDERS["shoulder_share"])
    return replace(
        case,
        room=replace(
            room,
            fill=max(room.fill, 0.92),
            tilt_deg=room.tilt_deg / 2,
            pan_deg=room.pan_deg / 2,
            waviness_mm=room.waviness_mm / 2,
            wave_mm=0.0,
            curl_mm=room.curl_mm / 3,
            blur_px=min(room.blur_px, 0.55),
            shoulder_share=min(room.shoulder_share, mild),
            shoulder_px=min(room.shoulder_px, 3.0),
            veil=room.veil / 3,
            vignetting=min(max(room.vignetting, natural_vignetting(room.focal_diagonals)), 0.3),
            projector_falloff=min(room.projector_falloff, 0.2),
            primary_difference=min(room.primary_difference, 0.15),
            ambient=0.0,
            hot_per_million=min(room.hot_per_million, 2.0),
        ),
    )


@dataclass(frozen=True, eq=False)
class PhotographedChart:
    """One frame of a chart in a room."""

    case: Case  # the room
    chart: Chart
    world: World
    mosaic: Mosaic  # the frame as read from its file

    def crop_offset_px(self) -> npt.NDArray[np.float64]:
        """Return the position (2,) of the decoded frame within the visible frame: column, row, half-size px."""
        visible = self.world.body.visible
        return np.array([self.mosaic.visible.left - visible.left, self.mosaic.visible.top - visible.top]) / 2

    def corners_px(self) -> npt.NDArray[np.float64] | None:
        """Return the field corners (4, 2), rounded half-size px; None for a chart with tags."""
        if self.chart.tags:
            return None
        return (self.world.project(field_mm(self.chart)) - self.crop_offset_px()).round()

    def miss_px(self, registration: Registration) -> npt.NDArray[np.float64]:
        """Return the distance (C,) of each registered patch from its true position, half-size px."""
        true_px = self.world.project(self.chart.centres_mm) - self.crop_offset_px()
        return np.linalg.norm(registration.to_pixels(self.chart.centres_mm) - true_px, axis=1)


def photographed_case(case: Case, bits: int = 5, page: str = "A0") -> PhotographedChart:
    """Return a frame of a new chart in the room of a case."""
    return photographed(case, design_chart(bits, A_SERIES_MM[page], case.seed))


def photographed(case: Case, chart: Chart) -> PhotographedChart:
    """Return a frame of a chart in the room of a case."""
    printed = drawing(chart)
    world = World(Print(printed.page_mm, printed.rectangles_mm, printed.rgb), BODIES[case.body], case.room)
    stream = BytesIO()
    write_dng(
        stream, world.expose(LIGHTS[case.light], SETTINGS, key=(1,)), world.body, settings=SETTINGS, taken_at=TAKEN_AT
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.dng"
        path.write_bytes(stream.getvalue())
        return PhotographedChart(case, chart, world, read_raw(path))


def miss(case: Case, bits: int = 5, page: str = "A0") -> npt.NDArray[np.float64]:
    """Return the distance (C,) of each registered patch from its true position, half-size px."""
    shot = photographed_case(case, bits, page)
    return shot.miss_px(register(shot.mosaic, shot.chart, f"room {case.seed}"))


def take_room(case: Case, small: bool) -> Outcome:
    """Take a short session in a room, build its LUT and return the result."""
    chart = chart_of(small, case.seed)
    world = world_of(chart, BODIES["Test" if small else case.body], case.room)
    with tempfile.TemporaryDirectory() as folder, short_session(Path(folder) / "session", chart, world) as session:
        return outcome_of(session, Path(folder) / "lut", world, chart)


def _cell_sides_px(to_pixels: Callable[..., npt.NDArray[np.float64]], chart: Chart) -> npt.NDArray[np.float64]:
    """Return the shorter side (N,) of each patch, half-size px; `to_pixels` maps chart mm to the half-size frame."""
    half = np.array(chart.cell_mm) / 2
    sides = [
        np.linalg.norm(to_pixels(chart.centres_mm + half * axis) - to_pixels(chart.centres_mm - half * axis), axis=1)
        for axis in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    ]
    return np.asarray(np.min(sides, axis=0))


def true_rows(case: Case, small: bool) -> set[str]:
    """Return the figures that may be remarked on in a calm room: patch size, if a patch is too small."""
    chart = chart_of(small, case.seed)
    world = world_of(chart, BODIES["Test" if small else case.body], case.room)
    return {CELL_PX.name} if _cell_sides_px(world.project, chart).min() < CELL_PX.accept else set()


def is_silent(result: Outcome) -> bool:
    """Return whether the LUT is wrong and no remark explains it."""
    truth = result.truth
    if truth is None or not result.is_wrong:
        return False
    # A reported lens error explains an error of this size; a smaller one does not.
    if len(result.remarks_without_lens) < len(result.says) and truth.worst > WRONG_SHARE:
        return False
    return not replace(result, says=_without_lens(result)).mentions(
        OF_LIGHTS if truth.worst <= WRONG_SHARE else OF_CELLS
    )


def _without_lens(outcome: Outcome) -> tuple[str, ...]:
    """Return the remarks without the one about the remaining lens error."""
    if len(outcome.rows) != len(outcome.says):
        return outcome.says
    return tuple(text for row, text in zip(outcome.rows, outcome.says, strict=True) if row != LENS_LEFT)


def described(case: Case) -> dict[str, Any]:
    """Return the room settings that may influence its LUT, for a JSON line."""
    names = (
        "blur_px", "shoulder_share", "shoulder_px", "veil", "lateral_red_px", "lateral_blue_px",
        "waviness_mm", "wave_mm", "curl_mm", "vignetting", "projector_falloff", "primary_difference",
        "ambient", "hot_per_million", "response_spread",
    )  # fmt: skip
    return {"room": case.seed, "body": case.body} | {name: round(getattr(case.room, name), 4) for name in names}


def census(outcomes: Sequence[tuple[Case, Outcome]], room_kind: str) -> int:
    """Print the numbers of verdicts and the worst LUTs; return the number of silent failures."""
    silent = sum(is_silent(outcome) for _, outcome in outcomes)
    counts = {
        "refused": sum(outcome.verdict == "refuse" for _, outcome in outcomes),
        "with remarks": sum(outcome.verdict == "accept with remarks" for _, outcome in outcomes),
        "wrong": sum(outcome.is_wrong for _, outcome in outcomes),
        "wrong without an explaining remark": silent,
    }
    against = f"{len(outcomes)} {room_kind}"
    for name, value in counts.items():
        print(json.dumps({"name": f"{room_kind}, {name}", "value": value, "unit": "rooms", "against": against}))
    lut_outcomes = [(case, outcome, outcome.truth) for case, outcome in outcomes if outcome.truth is not None]
    for verdict in ("accept", "accept with remarks"):
        truths = [truth for _, outcome, truth in lut_outcomes if outcome.verdict == verdict]
        if not truths:
            continue
        figures = (
            ("ground truth, worst", max(float(truth.light_deg.max()) for truth in truths), "degrees"),
            ("patches, RMS in the worst room", 100 * max(truth.rms for truth in truths), "%"),
            ("patches, worst of all", 100 * max(truth.worst for truth in truths), "%"),
        )
        for name, value, unit in figures:
            figure = {"name": f"{room_kind}, {verdict}, {name}", "value": float(f"{value:.3g}"), "unit": unit}
            print(json.dumps(figure | {"against": "World, noise subtracted, from 300 counts on"}))
    for waves, is_short in (("long", False), ("short", True)):
        truths = [truth for case, _, truth in lut_outcomes if (case.room.wave_mm > 0) == is_short]
        if not truths:
            continue
        offsets = np.array([truth.offset_rms_px() for truth in truths]).max(axis=0)
        channels = ("red", "green", "blue")
        offset_px = {f"worst room's RMS, {name}": value for name, value in zip(channels, offsets, strict=True)}
        offset_px["worst of all fit patches"] = max(truth.worst_offset_px() for truth in truths)
        for name, value in offset_px.items():
            figure = {"name": f"{room_kind}, {waves} waves, patch centres, {name}", "value": round(float(value), 4)}
            print(json.dumps(figure | {"unit": "px", "against": "World.project"}))
    return silent


def main(arguments: Sequence[str] | None = None) -> int:
    """Run rooms or named cases and print the results; return 1 after a silent failure or a wrong remark, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=50, help="number of random rooms")
    parser.add_argument("--calm", type=int, default=10, help="number of calm rooms")
    parser.add_argument("--first", type=int, default=0, help="seed of the first room")
    parser.add_argument("--small", action="store_true", help="use small charts and frames")
    parser.add_argument("--case", action="append", choices=["all", *BY_NAME], default=[], help="a named case instead")
    options = parser.parse_args(arguments)
    if options.case:
        names = [case.name for case in CASES] if "all" in options.case else options.case
        failed = [_case_failed(name, small=options.small, seed=options.first + 1) for name in names]
        print(
            json.dumps(
                {"name": "cases failed", "value": sum(failed), "unit": "cases", "against": f"{len(failed)} cases"}
            )
        )
        return int(any(failed))
    seeds = range(options.first, options.first + options.rooms), range(options.first, options.first + options.calm)
    wild = [(case, _run_room(case, "random", small=options.small)) for case in map(random_case, seeds[0])]
    calm = [(case, _run_room(case, "calm", small=options.small)) for case in map(calm_case, seeds[1])]
    silent = sum(
        census(outcomes, what) for outcomes, what in ((wild, "random rooms"), (calm, "calm rooms")) if outcomes
    )
    wrong = sum(bool(set(room.rows) - true_rows(case, options.small)) and not room.is_wrong for case, room in calm)
    wrong += sum(room.verdict == "refuse" for _, room in calm)
    print(json.dumps({"name": "calm rooms, false remarks", "value": wrong, "unit": "rooms", "against": f"{len(calm)}"}))
    return int(silent > 0 or wrong > 0)


def _case_failed(name: str, *, small: bool, seed: int) -> bool:
    """Run and print a named case; return whether it failed."""
    row = try_case(BY_NAME[name], small=small, seed=seed)
    print(json.dumps(row), flush=True)
    return any(row[failure] for failure in FAILURES)


def _run_room(case: Case, kind: str, *, small: bool) -> Outcome:
    """Run and print a room; return the result."""
    start_s = time.perf_counter()
    outcome = take_room(case, small)
    row = {"kind": kind} | described(case) | outcome.to_json() | {"silent": is_silent(outcome)}
    print(json.dumps(row | {"seconds": round(time.perf_counter() - start_s, 1)}), flush=True)
    return outcome


if __name__ == "__main__":
    raise SystemExit(main())
