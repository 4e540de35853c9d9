"""Whether what tables state of their errors is true: rooms whose optics, darkness and sensor are not as assumed.

`python -m benchmarks.troubles [--rooms N] [--first SEED] [--full]` takes a session of eight lights on a chart of 512
colours (with `--full` of 32 768) in each of N random rooms, builds its table, and prints one JSON object a line: the
troubles, the verdict, and each light's error beside what the table states of it; then a census of the tables that were
made. A third of the rooms has no trouble; in the others each is there with a probability of a third.

The optics share no form with the correction: each channel's light is spread by a power law of the distance, r^-2 or
r^-3, by Fourier transforms of the whole frame, and has a veil of its own. Sensors compress near white or lose counts
near black; dark frames hold light that the lights' frames lack; photosites differ and rows have offsets; the print
mirrors light; a colour wheel turns a broken number of times in an exposure.

A light's truth is the mean over the cells of what bare paper sends there, which the flat field divides out, in the
light that the wheel let through in its exposure. A table is
asked for: its true errors lie within the stated expanded uncertainty for 95 of 100 lights and cells, no light beyond
twice it, and the median of stated over true error is below 3.
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

_CORE_PX = 1.5
"""Half-size pixels within which a tail does not rise further: the core is the room's own blur."""


@dataclass(frozen=True)
class Troubles:
    """What is not as assumed; R, G, B where there are three.

    - `tail`: share of the light that is spread, and `power` of the distance by which it falls.
    - `veil`: share of the frame's mean light on all of it.
    - `compression`: share of counts lost at saturation, falling in proportion to the light.
    - `lost`: counts lost near black.
    - `in_darks`: light of the dark frames that the lights lack, over white's; dark light is subtracted where it is not
      None.
    - `banding`: standard deviation of a row's offset, counts.
    - `prnu`: standard deviation of the photosites' response; 0 for what the room has.
    - `mirrored`: share of paper's light that the print mirrors in a spot of an eighth of its size to half of it,
      `spot`, (left, top, right, bottom) in shares of the page.
    - `wheel`: standard deviation of a primary's light in an exposure that cuts a turn of the wheel.
    """

    tail: tuple[float, float, float] = (0.0, 0.0, 0.0)
    power: float = 3.0
    veil: tuple[float, float, float] = (0.0, 0.0, 0.0)
    compression: float = 0.0
    lost: float = 0.0
    in_darks: tuple[float, float, float] | None = None
    banding: float = 0.0
    prnu: float = 0.0
    mirrored: float = 0.0
    spot: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    wheel: float = 0.0

    def situation(self, seed: int, number: int) -> Situation:
        """Return what is otherwise in the frame of a step."""
        cut = np.random.default_rng((seed, 37, number)).standard_normal(3)
        red, green, blue = (1 + self.wheel * (cut - cut.mean())).tolist()
        return Situation(lamp=(red, green, blue), glares=(Glare(self.spot, self.mirrored),) if self.mirrored else ())

    def to_json(self) -> dict[str, Any]:
        """Return what is there."""
        plain = Troubles()
        return {name: value for name, value in vars(self).items() if value != getattr(plain, name)}


class TroubledWorld(World):
    """A room seen through other optics and by another sensor than the simulated ones."""

    def __init__(self, world: World, troubles: Troubles) -> None:
        super().__init__(world.sheet, world.body, world.room)
        self._troubles = troubles
        self.let_through: dict[Colour, tuple[float, float, float]] = {}

    def drive(
        self,
        colour: Colour,
        settings: ExposureSettings,
        lamp: float | _Array = 1.0,
        ambient: float | _Array = 0.0,
    ) -> _Array:
        """Return how much of each primary's light a light's frame collects, as `World.drive`, the wheel included."""
        return super().drive(colour, settings, lamp * np.array(self.let_through.get(colour, (1.0,) * 3)), ambient)

    def signal(
        self,
        colour: Colour,
        settings: ExposureSettings,
        lamp: float = 1.0,
        situation: Situation = UNDISTURBED,
    ) -> npt.NDArray[np.float32]:
        """Return a frame without noise and clipping, as `World.signal`, troubles included."""
        seen = super().signal(colour, settings, lamp, situation).astype(np.float64)
        trouble = self._troubles
        if colour == BLACK and trouble.in_darks is not None:
            white = super().signal(WHITE, settings)
            for channel, site in self._sites():
                seen[site] += trouble.in_darks[channel] * white[site]
        for channel, site in self._sites():
            plane = seen[site]
            spread = _convolved(plane, trouble.power) if trouble.tail[channel] else plane
            plane = (1 - trouble.tail[channel]) * plane + trouble.tail[channel] * spread
            seen[site] = (1 - trouble.veil[channel]) * plane + trouble.veil[channel] * plane.mean()
        full = self.body.saturation - self.body.black
        seen *= 1 - trouble.compression * np.clip(seen, 0, None) / full
        if trouble.lost:
            seen -= trouble.lost * (1 - np.exp(-np.clip(seen, 0, None) / trouble.lost))
        return seen.astype(np.float32)

    def expose(
        self,
        colour: Colour,
        settings: ExposureSettings,
        *,
        key: tuple[int, ...],
        lamp: float = 1.0,
        situation: Situation = UNDISTURBED,
    ) -> npt.NDArray[np.uint16]:
        """Return a frame, as `World.expose`, with this sensor's noise."""
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
    """Return a plane spread by a power law of the distance, whose sum is 1; beyond the frame there is its rim."""
    rows, columns = plane.shape
    padded = np.pad(plane, ((0, rows), (0, columns)), mode="edge")
    y, x = (np.arange(count, dtype=np.float64) for count in (2 * rows, 2 * columns))
    away = np.hypot(np.minimum(y, 2 * rows - y)[:, None], np.minimum(x, 2 * columns - x))
    kernel: _Array = np.maximum(away, _CORE_PX) ** -power
    spread: _Array = np.fft.irfft2(np.fft.rfft2(padded) * np.fft.rfft2(kernel / kernel.sum()), padded.shape)
    return spread[:rows, :columns]


def random_troubles(seed: int) -> Troubles:
    """Return the troubles of a room."""
    random = np.random.default_rng((seed, 29))
    if random.random() < 1 / 3:
        return Troubles()

    def there() -> bool:
        return bool(random.random() < 1 / 3)

    def by_channel(most: float) -> tuple[float, float, float]:
        red, green, blue = np.round(most * random.uniform(0.2, 1, 3), 4).tolist()
        return red, green, blue

    def spot() -> tuple[float, float, float, float]:
        (x, y), (width, height) = random.uniform(0.2, 0.8, 2).tolist(), random.uniform(0.125, 0.5, 2).tolist()
        return round(x - width, 3), round(y - height, 3), round(x + width, 3), round(y + height, 3)

    nothing = 0.0, 0.0, 0.0
    found = Troubles(
        tail=by_channel(0.07) if there() else nothing,
        power=2.0 if random.random() < 0.5 else 3.0,
        veil=by_channel(0.016) if there() else nothing,
        compression=round(random.uniform(0.005, 0.04), 4) if there() else 0.0,
        lost=round(random.uniform(2, 12), 1) if there() else 0.0,
        in_darks=by_channel(0.008) if there() else None,
        banding=round(random.uniform(0.2, 1.0), 2) if there() else 0.0,
        prnu=round(random.uniform(0.01, 0.03), 4) if there() else 0.0,
        mirrored=round(random.uniform(0.002, 0.03), 4) if there() else 0.0,
        spot=spot(),
        wheel=round(random.uniform(0.001, 0.02), 4) if random.random() < 1 / 6 else 0.0,
    )
    return found if found.mirrored else replace(found, spot=Troubles().spot)


def random_room(seed: int) -> Room:
    """Return a room of a careful lab, whose lens has a blur alone."""
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
class Stated:
    """A table's true errors beside what it states.

    - `light_deg`, `light_stated`: (L,) float64 degrees.
    - `cell`, `cell_stated`: (N,) float64, relative errors of lit cells' means, and what is stated of each.
    """

    light_deg: _Array
    light_stated: _Array
    cell: _Array
    cell_stated: _Array


def tried(seed: int, troubles: Troubles, small: bool) -> tuple[str, list[str], Stated | None]:
    """Return verdict, what is said, and a table's errors; None where there is no table."""
    chart = chart_of(small)
    room = random_room(seed)
    room = replace(room, response_spread=troubles.prnu or room.response_spread)
    world = TroubledWorld(world_of(chart, BODIES["Test" if small else "EOS 550D"], room), troubles)

    def changes(step: SessionStep) -> FrameChange:
        return FrameChange(situation=troubles.situation(seed, step.number))

    for step in plan_steps(short_plan(), 3):
        if step.kind == "light":
            world.let_through[step.colour] = troubles.situation(seed, step.number).lamp
    with tempfile.TemporaryDirectory() as folder:
        session = short_session(Path(folder) / "session", chart, world, changes, every=3)
        try:
            options = BuildOptions(subtract_dark=troubles.in_darks is not None)
            result = build(session, Path(folder) / "lut", options=options)
        except CropError as refused:
            return "refuse", [str(refused).split("the LUT is refused: ")[-1][:160]], None
        lut = open_lut(Path(folder) / "lut")
        truth = compare(result, lut, world, chart, session, changes, every=3)
        # Under the light in which the chart is registered, as the table states them.
        full = next(number for number, light in enumerate(lut.illuminations) if light.colour == WHITE)
        lit = truth.lit[full]
        error, stated = np.abs(truth.error[full][lit]), truth.cell_stated[lit]
        found = Stated(truth.light_deg, truth.light_stated, error, stated)
        return result.verdict.outcome, _said(result), found


def _said(result: BuildResult) -> list[str]:
    return [row.figure.name for row in result.verdict.rows if row.outcome != "accept"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Try rooms, print each and a census; return 1 where tables state less than is asked for, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=200, help="random rooms")
    parser.add_argument("--first", type=int, default=0, help="the first room's seed")
    parser.add_argument("--full", action="store_true", help="charts of 32768 colours on frames of 18 megapixels")
    given = parser.parse_args(arguments)
    tables: list[Stated] = []
    verdicts: dict[str, int] = {}
    remarked = 0
    for seed in range(given.first, given.first + given.rooms):
        troubles = random_troubles(seed)
        verdict, says, found = tried(seed, troubles, small=not given.full)
        verdicts[verdict] = verdicts.get(verdict, 0) + 1
        row: dict[str, Any] = {"room": seed, "troubles": troubles.to_json(), "verdict": verdict, "says": says}
        if found is not None:
            tables.append(found)
            remarked += verdict != "accept" and troubles == Troubles()
            row |= {"true_deg": found.light_deg.round(4).tolist(), "stated_deg": found.light_stated.round(4).tolist()}
            row |= {"cells_within": round(float((found.cell <= found.cell_stated).mean()), 3)}
        print(json.dumps(row), flush=True)
    return _census(tables, verdicts, remarked)


def _census(tables: Sequence[Stated], verdicts: dict[str, int], remarked: int) -> int:
    """Print what tables state altogether; return 1 where that is less than is asked for."""
    true, stated = (np.concatenate([getattr(one, name) for one in tables]) for name in ("light_deg", "light_stated"))
    cell, cell_stated = (np.concatenate([getattr(one, name) for one in tables]) for name in ("cell", "cell_stated"))
    figures = {
        "lights within what is stated": float((true <= stated).mean()),
        "lights beyond twice it": float((true > 2 * stated).sum()),
        "cells within what is stated": float((cell <= cell_stated).mean()),
        "stated over true, median light": float(np.median(stated / np.maximum(true, 1e-6))),
        "clean rooms remarked on": float(remarked),
        **{f"rooms, {verdict}": float(count) for verdict, count in verdicts.items()},
    }
    for name, value in figures.items():
        print(json.dumps({"name": name, "value": round(value, 4), "against": f"{len(tables)} tables"}))
    held = figures["lights within what is stated"] >= 0.95 and figures["cells within what is stated"] >= 0.95
    return 0 if held and not figures["lights beyond twice it"] else 1


if __name__ == "__main__":
    sys.exit(main())
