"""Rooms that nothing was tuned for: short sessions in random rooms, their tables compared with the truth.

`python -m benchmarks.rooms [--rooms N] [--first SEED] [--calm N]` takes a session of eight lights in each of N random
rooms and in as many calm ones as are asked for, builds its table, and prints one JSON object a line for each room, then
a census. A random room has waves, long or short, a curl, a lens with shoulders, veil and lateral colour, uneven light
and hot photosites; a calm one has less of each than a careful lab tolerates.

A room fails loudly when registration or the verdict refuses it, which is allowed. It fails silently when there is a
table in which a light is 0.1° or a cell's mean of 300 counts and more 3 % off, and the verdict accepts it or remarks on
something else; that must not happen. An error of up to twice what the table states of it is not silent. A remark in a
calm room whose table is right is false, but for one on small cells where they are.

`--case NAME` takes one of the named cases instead (`benchmarks.cases`; `--case all` takes all): a lens, a mixed-up
session, a hand, a leak, and whether the verdict says so. `--small` takes charts of 512 colours and small frames.

On one core a room of 18 megapixels takes some 40 s, a small one 3. Returns 1 when anything failed silently, was given a
wrong cause, or was remarked on without a reason.
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

# A cell this far off lies beyond what its samples' window allows for, 0.25 px, by enough to hold another colour.
SILENT_PX = 1.0

# Words of remarks that say why cells are off in a random room.
OF_CELLS = r"bleed|spread|veil|glare|correct|neighbour|uncertain|focus|blur|window|fall-?off|hot"

# Words of remarks that say why a light is off there.
OF_LIGHTS = r"ground truth|fall-?off|uneven"

SETTINGS = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
TAKEN_AT = datetime(2024, 3, 1, 9, 0, tzinfo=UTC)
LIGHTS = {"white": WHITE, "deep red": Colour(255, 0, 0), "deep blue": Colour(0, 0, 255), "dim": Colour(110, 70, 20)}


@dataclass(frozen=True)
class Case:
    """A room, a camera and a light."""

    seed: int
    body: str
    light: str
    room: Room


def random_case(seed: int) -> Case:
    """Return the case of a seed.

    Perspective to 15°, waves to 6 mm, a third of them short; blur 0.4 to 0.9 px, shoulders to 4.5 %, veil to 1.5 %,
    lateral colour to 1 px, vignetting to 40 %; hot photosites and the response's spread as bodies have them.
    """
    random = np.random.default_rng([20, seed])
    tilt, pan = random.uniform(-10.6, 10.6, 2)
    room = Room(
        seed=seed + 1000,
        # Perspective and rotation take room in the frame.
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
    """Return a room with what a Gaussian lens and a long-waved paper lack; drawn apart from the rest."""
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
    """Return the share of the light that the best lens loses at the frame's corner, by its focal length in diagonals.

    The fourth power of the cosine of the field angle, of which an entrance pupil that grows with it (the Slyusarev
    effect) is taken to give one back (chosen).

    >>> round(natural_vignetting(2.0), 3)
    0.087
    """
    cosine = 1 / np.sqrt(1 + (0.5 / focal_diagonals) ** 2)
    return float(1 - cosine**3)


def calm_case(seed: int) -> Case:
    """Return the case of a seed in a careful lab: what a room has too much of is cut to what is tolerated.

    Its lens darkens the corners as far as any lens does: in light that is more even than that nothing shows whether a
    lens has a veil, which is remarked on (`natural_vignetting`).
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
    """One frame of a chart in a room.

    - `case`, `chart`, `world`: the random case, the chart in its room, and the room.
    - `mosaic`: the frame as read from its file.
    """

    case: Case
    chart: Chart
    world: World
    mosaic: Mosaic

    def crop_offset_px(self) -> npt.NDArray[np.float64]:
        """Return (2,) float64, half-size px: column and row of the visible frame where the frame as read begins."""
        visible = self.world.body.visible
        return np.array([self.mosaic.visible.left - visible.left, self.mosaic.visible.top - visible.top]) / 2

    def corners_px(self) -> npt.NDArray[np.float64] | None:
        """Return the corners of the field, (4, 2) float64 half-size px, whole pixels; None for a chart with tags."""
        if self.chart.tags:
            return None
        return (self.world.project(field_mm(self.chart)) - self.crop_offset_px()).round()

    def miss_px(self, registration: Registration) -> npt.NDArray[np.float64]:
        """Return (C,) float64, the distance of each registered cell from its true place, half-size px."""
        places = self.world.project(self.chart.centres_mm) - self.crop_offset_px()
        return np.linalg.norm(registration.to_pixels(self.chart.centres_mm) - places, axis=1)


def photographed_case(case: Case, bits: int = 5, page: str = "A0") -> PhotographedChart:
    """Return a frame of a new chart in the room of a case."""
    return photographed(case, design_chart(bits, A_SERIES_MM[page], case.seed))


def photographed(case: Case, chart: Chart) -> PhotographedChart:
    """Return a frame of a chart in the room of a case."""
    drawn = drawing(chart)
    world = World(Print(drawn.page_mm, drawn.rectangles_mm, drawn.rgb), BODIES[case.body], case.room)
    stream = BytesIO()
    write_dng(
        stream, world.expose(LIGHTS[case.light], SETTINGS, key=(1,)), world.body, settings=SETTINGS, taken_at=TAKEN_AT
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.dng"
        path.write_bytes(stream.getvalue())
        return PhotographedChart(case, chart, world, read_raw(path))


def miss(case: Case, bits: int = 5, page: str = "A0") -> npt.NDArray[np.float64]:
    """Return (C,) float64, the distance of each registered cell from its true place, half-size px."""
    shot = photographed_case(case, bits, page)
    return shot.miss_px(register(shot.mosaic, shot.chart, f"room {case.seed}"))


def tried(case: Case, small: bool) -> Outcome:
    """Take a short session in a room, build its table, and return what came of it."""
    chart = chart_of(small, case.seed)
    world = world_of(chart, BODIES["Test" if small else case.body], case.room)
    with tempfile.TemporaryDirectory() as folder, short_session(Path(folder) / "session", chart, world) as session:
        return outcome_of(session, Path(folder) / "lut", world, chart)


def _cell_sides_px(to_pixels: Callable[..., npt.NDArray[np.float64]], chart: Chart) -> npt.NDArray[np.float64]:
    """Return the shorter side of each cell (N,) float64 half-size px, in the chart's order.

    `to_pixels`: takes places on the print (N, 2) mm to the half-size frame.
    """
    half = np.array(chart.cell_mm) / 2
    sides = [
        np.linalg.norm(to_pixels(chart.centres_mm + half * axis) - to_pixels(chart.centres_mm - half * axis), axis=1)
        for axis in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    ]
    return np.asarray(np.min(sides, axis=0))


def true_rows(case: Case, small: bool) -> set[str]:
    """Return the rows of a verdict that may remark on a calm room: that of the cells' size where one is too small."""
    chart = chart_of(small, case.seed)
    world = world_of(chart, BODIES["Test" if small else case.body], case.room)
    return {CELL_PX.name} if _cell_sides_px(world.project, chart).min() < CELL_PX.accept else set()


def is_silent(found: Outcome) -> bool:
    """Return whether a table is wrong and nothing that is said of it says why."""
    truth = found.truth
    if truth is None or not found.is_wrong:
        return False
    # An error that the report states is not silent where it is as large as it says, and silent where it is not.
    if len(found.told) < len(found.says) and truth.worst > WRONG_SHARE:
        return False
    return not replace(found, says=_without_lens(found)).mentions(OF_LIGHTS if truth.worst <= WRONG_SHARE else OF_CELLS)


def _without_lens(found: Outcome) -> tuple[str, ...]:
    """Return what is said beside the error that the lens may leave."""
    if len(found.rows) != len(found.says):
        return found.says
    return tuple(text for row, text in zip(found.rows, found.says, strict=True) if row != LENS_LEFT)


def described(case: Case) -> dict[str, Any]:
    """Return the settings of a case's room that its table may depend on, for a line of JSON."""
    names = (
        "blur_px", "shoulder_share", "shoulder_px", "veil", "lateral_red_px", "lateral_blue_px",
        "waviness_mm", "wave_mm", "curl_mm", "vignetting", "projector_falloff", "primary_difference",
        "ambient", "hot_per_million", "response_spread",
    )  # fmt: skip
    return {"room": case.seed, "body": case.body} | {name: round(getattr(case.room, name), 4) for name in names}


def census(outcomes: Sequence[tuple[Case, Outcome]], what: str) -> int:
    """Print how many rooms went which way, and the worst of those that have a table; return how many were silent."""
    silent = sum(is_silent(found) for _, found in outcomes)
    counts = {
        "refused": sum(found.verdict == "refuse" for _, found in outcomes),
        "with remarks": sum(found.verdict == "accept with remarks" for _, found in outcomes),
        "wrong": sum(found.is_wrong for _, found in outcomes),
        "wrong without a word of why": silent,
    }
    against = f"{len(outcomes)} {what}"
    for name, value in counts.items():
        print(json.dumps({"name": f"{what}, {name}", "value": value, "unit": "rooms", "against": against}))
    tables = [(case, found, found.truth) for case, found in outcomes if found.truth is not None]
    for verdict in ("accept", "accept with remarks"):
        truths = [truth for _, found, truth in tables if found.verdict == verdict]
        if not truths:
            continue
        figures = (
            ("light, worst", max(float(truth.light_deg.max()) for truth in truths), "degrees"),
            ("cells, worst room's RMS", 100 * max(truth.rms for truth in truths), "%"),
            ("cells, worst of all", 100 * max(truth.worst for truth in truths), "%"),
        )
        for name, value, unit in figures:
            figure = {"name": f"{what}, {verdict}, {name}", "value": float(f"{value:.3g}"), "unit": unit}
            print(json.dumps(figure | {"against": "World, noise taken out, from 300 counts on"}))
    for waves, chosen in (("long", False), ("short", True)):
        truths = [truth for case, _, truth in tables if (case.room.wave_mm > 0) == chosen]
        if not truths:
            continue
        offsets = np.array([truth.offset_rms_px() for truth in truths]).max(axis=0)
        channels = ("red", "green", "blue")
        placed = {f"worst room's RMS in {name}": value for name, value in zip(channels, offsets, strict=True)}
        placed["worst of all fit cells"] = max(truth.worst_offset_px() for truth in truths)
        for name, value in placed.items():
            figure = {"name": f"{what}, {waves} waves, cell centres, {name}", "value": round(float(value), 4)}
            print(json.dumps(figure | {"unit": "px", "against": "World.project"}))
    return silent


def main(arguments: Sequence[str] | None = None) -> int:
    """Try rooms or named cases, print what came of each, and return 1 if one failed silently or wrongly, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=50, help="random rooms")
    parser.add_argument("--calm", type=int, default=10, help="calm rooms")
    parser.add_argument("--first", type=int, default=0, help="the first room's seed")
    parser.add_argument("--small", action="store_true", help="small charts and frames")
    parser.add_argument("--case", action="append", choices=["all", *BY_NAME], default=[], help="a named case instead")
    given = parser.parse_args(arguments)
    if given.case:
        names = [case.name for case in CASES] if "all" in given.case else given.case
        failed = [_case_failed(name, small=given.small, seed=given.first + 1) for name in names]
        print(
            json.dumps(
                {"name": "cases failed", "value": sum(failed), "unit": "cases", "against": f"{len(failed)} cases"}
            )
        )
        return int(any(failed))
    seeds = range(given.first, given.first + given.rooms), range(given.first, given.first + given.calm)
    wild = [(case, _printed(case, "random", small=given.small)) for case in map(random_case, seeds[0])]
    calm = [(case, _printed(case, "calm", small=given.small)) for case in map(calm_case, seeds[1])]
    silent = sum(
        census(outcomes, what) for outcomes, what in ((wild, "random rooms"), (calm, "calm rooms")) if outcomes
    )
    false = sum(bool(set(found.rows) - true_rows(case, given.small)) and not found.is_wrong for case, found in calm)
    false += sum(found.verdict == "refuse" for _, found in calm)
    print(json.dumps({"name": "calm rooms, false remarks", "value": false, "unit": "rooms", "against": f"{len(calm)}"}))
    return int(silent > 0 or false > 0)


def _case_failed(name: str, *, small: bool, seed: int) -> bool:
    """Print what came of a named case, and return whether it failed."""
    row = try_case(BY_NAME[name], small=small, seed=seed)
    print(json.dumps(row), flush=True)
    return any(row[failure] for failure in FAILURES)


def _printed(case: Case, kind: str, *, small: bool) -> Outcome:
    """Print what came of a room, and return it."""
    started = time.perf_counter()
    found = tried(case, small)
    row = {"kind": kind} | described(case) | found.to_json() | {"silent": is_silent(found)}
    print(json.dumps(row | {"seconds": round(time.perf_counter() - started, 1)}), flush=True)
    return found


if __name__ == "__main__":
    raise SystemExit(main())
