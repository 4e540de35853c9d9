"""Check of the reported uncertainties in rooms with optics, dark light and sensors that differ from the assumptions.

`python -m benchmarks.troubles [--rooms N] [--first SEED] [--full]` takes a session of eight illuminants on a chart of
512 colours (`--full`: 32 768) in each of N random rooms and builds its LUT. It prints one JSON object per room (the
troubles, the verdict, the error and the reported uncertainty of each ground truth), then a summary of the LUTs. A third
of the rooms has no trouble. In the other rooms each trouble occurs with a probability of one third.

The simulated optics differ in form from the model of the correction. Each channel has its own veiling glare and its own
point spread, which follows a power law of the distance, r^-2 or r^-3 (calculated by Fourier transforms of the whole
frame). Sensors compress near white or lose counts near black. Dark frames contain light that other frames do not
contain. Photosites differ in response, rows have offsets, the print reflects light, and a colour wheel makes a
fractional number of turns per exposure.

The true ground truth is the mean light of bare paper over the patches, including the light that the wheel passed during
this exposure. Three conditions are required: 95 % of the true errors of ground truths and patches are within the
expanded uncertainty; no error of a ground truth exceeds twice this uncertainty; and the median of uncertainty / true
error is below 3.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.cases import chart_of
from benchmarks.sessions import FrameChange, compare, short_plan, short_session, world_of
from calibration.pipeline.build import build
from calibration.pipeline.frames import BuildOptions
from calibration.table.lut import open_lut
from calibration.verdict import BuildResult
from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE, Colour
from experiment.session.records import SessionStep, plan_steps
from foundation.errors import CropError
from sim.world.sensors import BODIES
from sim.world.world import UNDISTURBED, Glare, Room, Situation, World

_Array = npt.NDArray[np.float64]

# Core radius of the spread, half-size px; inside it the blur of the room applies.
_CORE_PX = 1.5


@dataclass(frozen=True)
class Troubles:
    """Deviations from the assumptions; three values are R, G, B."""

    tail: tuple[float, float, float] = (0.0, 0.0, 0.0)  # share of the light that is spread
    power: float = 3.0  # exponent of the decrease with distance
    veil: tuple[float, float, float] = (0.0, 0.0, 0.0)  # share of the mean light of the frame, added everywhere
    compression: float = 0.0  # share of counts lost at saturation, proportional to the light
    lost: float = 0.0  # counts lost near black
    # light in dark frames only / white; if set, dark light is subtracted
    in_darks: tuple[float, float, float] | None = None
    banding: float = 0.0  # standard deviation of a row offset, counts
    prnu: float = 0.0  # standard deviation of the response; 0 keeps that of the room
    mirrored: float = 0.0  # share of paper light reflected in `spot`
    spot: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)  # left, top, right, bottom, relative to the page
    wheel: float = 0.0  # standard deviation of a primary in an exposure that cuts a wheel turn

    def situation(self, seed: int, number: int) -> Situation:
        """Return the disturbance of a step's frame."""
        random_share = np.random.default_rng((seed, 37, number)).standard_normal(3)
        red, green, blue = (1 + self.wheel * (random_share - random_share.mean())).tolist()
        return Situation(lamp=(red, green, blue), glares=(Glare(self.spot, self.mirrored),) if self.mirrored else ())

    def to_json(self) -> dict[str, Any]:
        """Return the troubles that are present."""
        none = Troubles()
        return {name: value for name, value in vars(self).items() if value != getattr(none, name)}


class TroubledWorld(World):
    """A room with other optics and another sensor than the simulated ones."""

    def __init__(self, world: World, troubles: Troubles) -> None:
        super().__init__(world.sheet, world.body, world.room)
        self._troubles = troubles
        self.wheel_shares: dict[Colour, tuple[float, float, float]] = {}

    def drive(
        self,
        colour: Colour,
        settings: ExposureSettings,
        lamp: float | _Array = 1.0,
        ambient: float | _Array = 0.0,
    ) -> _Array:
        """Return the light of each primary as `World.drive`, including the wheel."""
        return super().drive(colour, settings, lamp * np.array(self.wheel_shares.get(colour, (1.0,) * 3)), ambient)

    def signal(
        self,
        colour: Colour,
        settings: ExposureSettings,
        lamp: float = 1.0,
        situation: Situation = UNDISTURBED,
    ) -> npt.NDArray[np.float32]:
        """Return a frame without noise and clipping as `World.signal`, including the troubles."""
        counts = super().signal(colour, settings, lamp, situation).astype(np.float64)
        trouble = self._troubles
        if colour == BLACK and trouble.in_darks is not None:
            white = super().signal(WHITE, settings)
            for channel, site in self._sites():
                counts[site] += trouble.in_darks[channel] * white[site]
        for channel, site in self._sites():
            plane = counts[site]
            spread_light = _convolved(plane, trouble.power) if trouble.tail[channel] else plane
            plane = (1 - trouble.tail[channel]) * plane + trouble.tail[channel] * spread_light
            counts[site] = (1 - trouble.veil[channel]) * plane + trouble.veil[channel] * plane.mean()
        full_scale = self.body.saturation - self.body.black
        counts *= 1 - trouble.compression * np.clip(counts, 0, None) / full_scale
        if trouble.lost:
            counts -= trouble.lost * (1 - np.exp(-np.clip(counts, 0, None) / trouble.lost))
        return counts.astype(np.float32)

    def expose(
        self,
        colour: Colour,
        settings: ExposureSettings,
        *,
        key: tuple[int, ...],
        lamp: float = 1.0,
        situation: Situation = UNDISTURBED,
    ) -> npt.NDArray[np.uint16]:
        """Return a frame as `World.expose`, with the noise of this sensor."""
        body, visible = self.body, self.body.visible
        random = np.random.default_rng((self.room.seed, 17, *key))
        light = np.zeros(body.sensor)
        inside = slice(visible.top, visible.top + visible.height), slice(visible.left, visible.left + visible.width)
        light[inside] = self.signal(colour, settings, lamp, situation)
        variance = body.noise_dn(settings.iso) ** 2 + np.clip(light, 0, None) / body.gain_e(settings.iso)
        rows = self._troubles.banding * random.standard_normal((body.sensor[0], 1))
        counts = body.black + light + rows + np.sqrt(variance) * random.standard_normal(body.sensor)
        return np.clip(np.rint(counts), 0, body.saturation).astype(np.uint16)

    def _sites(self) -> list[tuple[int, tuple[slice, slice]]]:
        """Return channel and photosites of each position of the Bayer block."""
        pattern = self.body.pattern
        return [
            ("RGB".index(pattern[2 * row + column]), (slice(row, None, 2), slice(column, None, 2)))
            for row in range(2)
            for column in range(2)
        ]


def _convolved(plane: _Array, power: float) -> _Array:
    """Spread a plane by a normalised power law of the distance; its edge is continued outside the frame."""
    rows, columns = plane.shape
    padded = np.pad(plane, ((0, rows), (0, columns)), mode="edge")
    y, x = (np.arange(count, dtype=np.float64) for count in (2 * rows, 2 * columns))
    distance = np.hypot(np.minimum(y, 2 * rows - y)[:, None], np.minimum(x, 2 * columns - x))
    kernel: _Array = np.maximum(distance, _CORE_PX) ** -power
    spread: _Array = np.fft.irfft2(np.fft.rfft2(padded) * np.fft.rfft2(kernel / kernel.sum()), padded.shape)
    return spread[:rows, :columns]


def random_troubles(seed: int) -> Troubles:
    """Return the troubles of a room."""
    random = np.random.default_rng((seed, 29))
    if random.random() < 1 / 3:
        return Troubles()

    def occurs() -> bool:
        return bool(random.random() < 1 / 3)

    def by_channel(largest: float) -> tuple[float, float, float]:
        red, green, blue = np.round(largest * random.uniform(0.2, 1, 3), 4).tolist()
        return red, green, blue

    def spot() -> tuple[float, float, float, float]:
        (x, y), (width, height) = random.uniform(0.2, 0.8, 2).tolist(), random.uniform(0.125, 0.5, 2).tolist()
        return round(x - width, 3), round(y - height, 3), round(x + width, 3), round(y + height, 3)

    nothing = 0.0, 0.0, 0.0
    troubles = Troubles(
        tail=by_channel(0.07) if occurs() else nothing,
        power=2.0 if random.random() < 0.5 else 3.0,
        veil=by_channel(0.016) if occurs() else nothing,
        compression=round(random.uniform(0.005, 0.04), 4) if occurs() else 0.0,
        lost=round(random.uniform(2, 12), 1) if occurs() else 0.0,
        in_darks=by_channel(0.008) if occurs() else None,
        banding=round(random.uniform(0.2, 1.0), 2) if occurs() else 0.0,
        prnu=round(random.uniform(0.01, 0.03), 4) if occurs() else 0.0,
        mirrored=round(random.uniform(0.002, 0.03), 4) if occurs() else 0.0,
        spot=spot(),
        wheel=round(random.uniform(0.001, 0.02), 4) if random.random() < 1 / 6 else 0.0,
    )
    return troubles if troubles.mirrored else replace(troubles, spot=Troubles().spot)


def random_room(seed: int) -> Room:
    """Return the room of a careful laboratory with a purely Gaussian lens."""
    random = np.random.default_rng((seed, 31))
    return Room(
        seed=seed,
        blur_px=float(random.uniform(0.4, 0.6)),
        waviness_mm=float(random.uniform(0.5, 3)),
        vignetting=float(random.uniform(0.15, 0.4)),
        projector_falloff=float(random.uniform(0.05, 0.3)),
        primary_difference=float(random.uniform(0.0, 0.12)),
        lateral_red_px=float(random.uniform(0, 0.4)),
        response_spread=float(random.uniform(0.002, 0.01)),
    )


@dataclass(frozen=True, eq=False)
class ReportedErrors:
    """True errors of a LUT and the reported uncertainties: (L,) degrees for ground truths, (N,) for lit patches."""

    light_deg: _Array
    light_uncertainty: _Array
    cell: _Array
    cell_uncertainty: _Array


def tried(seed: int, troubles: Troubles, small: bool) -> tuple[str, list[str], ReportedErrors | None]:
    """Return the verdict, the remarks, and the errors of the LUT; None if there is no LUT."""
    chart = chart_of(small)
    room = random_room(seed)
    room = replace(room, response_spread=troubles.prnu or room.response_spread)
    world = TroubledWorld(world_of(chart, BODIES["Test" if small else "EOS 550D"], room), troubles)

    def changes(step: SessionStep) -> FrameChange:
        return FrameChange(situation=troubles.situation(seed, step.number))

    for step in plan_steps(short_plan(), 3):
        if step.kind == "light":
            world.wheel_shares[step.colour] = troubles.situation(seed, step.number).lamp
    with tempfile.TemporaryDirectory() as folder:
        session = short_session(Path(folder) / "session", chart, world, changes, every=3)
        try:
            options = BuildOptions(subtract_dark=troubles.in_darks is not None)
            result = build(session, Path(folder) / "lut", options=options)
        except CropError as refusal:
            return "refuse", [str(refusal).split("the LUT is refused: ")[-1][:160]], None
        lut = open_lut(Path(folder) / "lut")
        truth = compare(result, lut, world, chart, session, changes, every=3)
        # Compare under the illuminant of the registration, as the LUT reports them.
        white_index = next(number for number, light in enumerate(lut.illuminations) if light.colour == WHITE)
        lit = truth.lit[white_index]
        error, cell_uncertainty = np.abs(truth.error[white_index][lit]), truth.cell_uncertainty[lit]
        errors = ReportedErrors(truth.light_deg, truth.light_uncertainty, error, cell_uncertainty)
        return result.verdict.outcome, _remarked_figures(result), errors


def _remarked_figures(result: BuildResult) -> list[str]:
    return [row.figure.name for row in result.verdict.rows if row.outcome != "accept"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run rooms, print each and a summary; return 1 if the reported uncertainties are too small, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=200, help="number of random rooms")
    parser.add_argument("--first", type=int, default=0, help="seed of the first room")
    parser.add_argument("--full", action="store_true", help="use charts of 32768 colours and frames of 18 megapixels")
    options = parser.parse_args(arguments)
    tables: list[ReportedErrors] = []
    verdicts: dict[str, int] = {}
    false_remarks = 0
    for seed in range(options.first, options.first + options.rooms):
        troubles = random_troubles(seed)
        verdict, remarks, table = tried(seed, troubles, small=not options.full)
        verdicts[verdict] = verdicts.get(verdict, 0) + 1
        row: dict[str, Any] = {"room": seed, "troubles": troubles.to_json(), "verdict": verdict, "says": remarks}
        if table is not None:
            tables.append(table)
            false_remarks += verdict != "accept" and troubles == Troubles()
            row |= {
                "true_deg": table.light_deg.round(4).tolist(),
                "stated_deg": table.light_uncertainty.round(4).tolist(),
            }
            row |= {"cells_within": round(float((table.cell <= table.cell_uncertainty).mean()), 3)}
        print(json.dumps(row), flush=True)
    return _census(tables, verdicts, false_remarks)


def _census(tables: Sequence[ReportedErrors], verdicts: dict[str, int], false_remarks: int) -> int:
    """Print the figures of all LUTs; return 1 if the reported uncertainties are too small."""
    true_deg, uncertainty_deg = (
        np.concatenate([getattr(table, name) for table in tables]) for name in ("light_deg", "light_uncertainty")
    )
    patch, limits = (
        np.concatenate([getattr(table, name) for table in tables]) for name in ("cell", "cell_uncertainty")
    )
    figures = {
        "ground truths within the uncertainty": float((true_deg <= uncertainty_deg).mean()),
        "ground truths beyond twice the uncertainty": float((true_deg > 2 * uncertainty_deg).sum()),
        "patches within the uncertainty": float((patch <= limits).mean()),
        "uncertainty / true error, median ground truth": float(np.median(uncertainty_deg / np.maximum(true_deg, 1e-6))),
        "rooms without trouble, but with remarks": float(false_remarks),
        **{f"rooms, {verdict}": float(count) for verdict, count in verdicts.items()},
    }
    for name, value in figures.items():
        print(json.dumps({"name": name, "value": round(value, 4), "against": f"{len(tables)} LUTs"}))
    is_sufficient = (
        figures["ground truths within the uncertainty"] >= 0.95 and figures["patches within the uncertainty"] >= 0.95
    )
    return 0 if is_sufficient and not figures["ground truths beyond twice the uncertainty"] else 1


if __name__ == "__main__":
    sys.exit(main())
