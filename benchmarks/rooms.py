"""Registration in rooms that nothing was tuned for: whole charts in random rooms, compared with the truth.

`python -m benchmarks.rooms [--rooms N] [--first SEED]` prints one JSON object a line for each room, then a summary.
A room fails loudly when registration or the verdict refuses it, which is allowed, and silently when it is accepted and
a cell lies `SILENT_PX` or more from the truth, or its samples are wrong by more than `SILENT_SHARE`, which must not
happen. About 10 s a room on one core.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.chart.layout import A_SERIES_MM, design_chart
from acquisition.chart.model import Chart
from acquisition.chart.printing import drawing
from acquisition.framing.planes import frame_black
from benchmarks.accuracy import WELL_LIT_DN, sample_variance
from calibration.registration.register import register
from calibration.registration.registration import Registration
from calibration.sampling.samples import gather, sites_at
from calibration.sampling.windows import bleed
from calibration.verdict.verdict import judge
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE, Colour
from drivers.raw.rawfile import Mosaic, read_raw
from foundation.errors import CropError
from sim.camera.dng import write_dng
from sim.world.drawing import Print
from sim.world.room import Room
from sim.world.sensors import BODIES
from sim.world.world import World

SILENT_PX = 1.0
"""A cell this far off lies beyond what its samples' window allows for, 0.25 px, by enough to hold another colour."""

SILENT_SHARE = 0.003
"""RMS error of the means of 25 samples above 300 counts, their noise taken out."""

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
    """Return the case of a seed: perspective to 15°, waves to 6 mm, blur 0.4 to 0.9 px, vignetting to 40 %."""
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
    return Case(seed, body, str(random.choice(sorted(LIGHTS), p=[0.2, 0.2, 0.1, 0.5])), room)


@dataclass(frozen=True, eq=False)
class PhotographedChart:
    """One frame of a chart in a room.

    Attributes
    ----------
    case, chart, world
        The random case, the chart in its room, and the room.
    mosaic
        The frame as read from its file.
    """

    case: Case
    chart: Chart
    world: World
    mosaic: Mosaic

    def crop_offset_px(self) -> npt.NDArray[np.float64]:
        """Return (2,) float64, half-size px: column and row of the visible frame where the frame as read begins."""
        visible = self.world.body.visible
        return np.array([self.mosaic.visible.left - visible.left, self.mosaic.visible.top - visible.top]) / 2

    def miss_px(self, registration: Registration) -> npt.NDArray[np.float64]:
        """Return (C,) float64, the distance of each registered cell from its true place, half-size px."""
        places = self.world.project(self.chart.centres_mm) - self.crop_offset_px()
        return np.linalg.norm(registration.to_pixels(self.chart.centres_mm) - places, axis=1)

    def sample_error(self, registration: Registration) -> float:
        """Return the RMS relative error of the cells' means above 300 counts, less what noise alone gives.

        Against the room's true light at the place on the print where the 25 pixels' middle lies.
        """
        height, width = self.mosaic.block_planes().shape[2:]
        sites = sites_at(registration.to_pixels(self.chart.centres_mm), (height, width))
        samples, _ = gather(self.mosaic, frame_black(self.mosaic), sites)
        middle = self.world.view.locate(np.column_stack([sites.columns, sites.rows]) + self.crop_offset_px())
        light, room = LIGHTS[self.case.light], self.case.room
        true = self.world.seen(self.chart.rgb, middle, light, SETTINGS)
        error = samples.mean(axis=1) / true - 1
        noise = sample_variance(true, self.world.body, SETTINGS.iso, room.response_spread) / samples.shape[1] / true**2
        lit = (true > WELL_LIT_DN) & sites.inside[:, None]
        return float(np.sqrt(max(float((error**2 - noise)[lit].mean()), 0.0)))


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
    """Return (C,) float64, the distance of each registered cell from its true place, half-size px.

    Raises
    ------
    QualityError
        The room was refused.
    """
    shot = photographed_case(case, bits, page)
    return shot.miss_px(register(shot.mosaic, shot.chart, f"room {case.seed}"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Try rooms, print the result of each, and return 1 if one failed silently, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args(arguments)
    places: list[tuple[float, float, float]] = []
    samples: list[float] = []
    loud = silent = remarked = 0
    for seed in range(given.first, given.first + given.rooms):
        case, started = random_case(seed), time.perf_counter()
        row: dict[str, object] = {"room": seed, "body": case.body, "light": case.light}
        row |= {"blur_px": round(case.room.blur_px, 3), "waves_mm": round(case.room.waviness_mm, 1)}
        shot = photographed_case(case)
        try:
            found = register(shot.mosaic, shot.chart, f"room {seed}")
        except CropError as refused:
            loud += 1
            row["refused"] = str(refused)
        else:
            error, wrong = shot.miss_px(found), shot.sample_error(found)
            places.append((case.room.waviness_mm, float(np.sqrt((error**2).mean())), float(error.max())))
            mixed = bleed(found.cell_px, found.blur_px)
            verdict = judge({"cell_px": found.cell_px, "bleed": mixed, "tag_residual_px": found.lens_residual_px})
            row |= {"rms_px": round(places[-1][1], 4), "max_px": round(places[-1][2], 3)}
            row |= {"cell_px": round(found.cell_px, 2), "bleed": round(mixed, 4)}
            row |= {"samples": round(wrong, 5), "verdict": verdict.outcome}
            if verdict.outcome == "refuse":
                loud += 1
            else:
                remarked += verdict.outcome == "accept with remarks"
                samples.append(wrong)
                silent += bool(error.max() >= SILENT_PX or wrong > SILENT_SHARE)
        row["seconds"] = round(time.perf_counter() - started, 1)
        print(json.dumps(row), flush=True)
    against = f"{given.rooms} random rooms"
    figures = {"rooms refused": loud, "rooms with remarks": remarked, "rooms wrong without a word": silent}
    for name, value in figures.items():
        print(json.dumps({"name": name, "value": value, "unit": "rooms", "against": against}))
    table = np.array(places).reshape(-1, 3)
    for low, high in ((0, 3), (3, 6)):
        waves, rms, largest = table[(table[:, 0] > low) & (table[:, 0] <= high)].T
        if not len(waves):
            continue
        for name, value in (("worst room's RMS", rms.max()), ("worst of all", largest.max())):
            figure = {
                "name": f"cell centres, waves to {high} mm, {name}",
                "value": round(float(value), 4),
                "unit": "px",
            }
            print(json.dumps(figure | {"unit": "px", "against": f"{len(waves)} of {against} that were registered"}))
    if samples:
        figure = {"name": "samples of rooms accepted, worst room's RMS error", "value": round(100 * max(samples), 3)}
        print(json.dumps(figure | {"unit": "%", "against": "World.seen, above 300 counts, noise taken out"}))
    return int(silent > 0)


if __name__ == "__main__":
    raise SystemExit(main())
