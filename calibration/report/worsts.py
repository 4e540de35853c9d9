"""Where the worst of each figure is: the frame, the light, the place on the print, whether or not a limit is exceeded.

A number that says "worst" is of little use to whoever cannot look at it. Places are drawn on the frame that was
registered, frames are ringed in the course of the session, lights among the lights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.causes.gathering import PrintPlace
from calibration.measurements import FrameMeasurements, TableMeasurements
from calibration.report.groups import Group
from calibration.figures.all_figures import FIGURES
from experiment.chart.model import Chart

_TITLES = {threshold.name: threshold.title for threshold in FIGURES}


@dataclass(frozen=True)
class Worst:
    """The worst of a figure.

    - `figure`: name of its limit (`calibration.verdict.thresholds`).
    - `group`: its group of the report.
    - `what`: what is worst, in few words.
    - `file`: the frame, relative to the session; "" where it is of no frame alone.
    - `light`: the light's number; None where it is of no light alone.
    - `place`: where on the print; None where it has no place.
    """

    figure: str
    group: Group
    what: str
    file: str = ""
    light: int | None = None
    place: PrintPlace | None = None

    @property
    def where(self) -> str:
        """Where it is, in words: ``light 3, frames/0009_light_003.cr2, 312, 440 mm``."""
        light = "" if self.light is None else f"light {self.light}"
        place = "" if self.place is None else f"{self.place.x_mm:.0f}, {self.place.y_mm:.0f} mm"
        return ", ".join(part for part in (light, self.file, place) if part)

    @property
    def label(self) -> str:
        """What stands beside its number below the picture."""
        return f"{_TITLES.get(self.figure, self.figure)}: {self.what}"


def worst_of(figures: TableMeasurements, chart: Chart) -> tuple[Worst, ...]:
    """Return where the worst of each figure is that has one, in the order of the groups."""
    return (*_of_geometry(figures, chart), *_of_lights(figures), *_of_cells(figures, chart), *_of_truth(figures))


def cell_sides_px(figures: TableMeasurements, chart: Chart) -> npt.NDArray[np.float64]:
    """Return the shorter side of each cell (N,) float64 half-size px, in the chart's order."""
    to_pixels = figures.registration.to_pixels
    half = np.array(chart.cell_mm) / 2
    sides = [
        np.linalg.norm(to_pixels(chart.centres_mm + half * axis) - to_pixels(chart.centres_mm - half * axis), axis=1)
        for axis in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    ]
    return np.asarray(np.min(sides, axis=0))


def _of_geometry(figures: TableMeasurements, chart: Chart) -> list[Worst]:
    registration, file = figures.registration, figures.session.registered_file
    sides = cell_sides_px(figures, chart)
    smallest = int(np.argmin(sides))
    found = [
        Worst(
            "bleed", "geometry", f"smallest cell, {sides[smallest]:.1f} px", file,
            place=_place(file, chart.centres_mm[smallest], 0.0),
        )
    ]  # fmt: skip
    good = np.flatnonzero(registration.blocks.good)
    if len(good):
        length = np.linalg.norm(registration.blocks.residual_px[good], axis=1)
        block = good[int(np.argmax(length))]
        size = 8 * float(max(chart.cell_mm))
        found.append(
            Worst(
                "block_residual_px", "geometry", f"largest of a block, {length.max():.3f} px", file,
                place=_place(file, registration.blocks.centres_mm[block], size),
            )
        )  # fmt: skip
    softest = _extreme(figures, lambda frame: frame.blur_px)
    found.append(Worst("softer_bleed", "geometry", f"blur σ {softest.blur_px:.2f} px", softest.record.file))
    return found


def _of_lights(figures: TableMeasurements) -> list[Worst]:
    lights, found = figures.lights, list[Worst]()
    if lights.off_codes_deg is not None and lights.off_codes_deg.any():
        light = int(np.argmax(lights.off_codes_deg))
        found.append(_light(figures, "off_codes_deg", "light", light, f"{lights.off_codes_deg[light]:.2g}° off"))
    if lights.codes is not None and lights.codes.off_brightness.any():
        light = int(np.argmax(lights.codes.off_brightness))
        off = f"{100 * lights.codes.off_brightness[light]:.2g} % off"
        found.append(_light(figures, "off_brightness", "light", light, off))
    return found


def _of_cells(figures: TableMeasurements, chart: Chart) -> list[Worst]:
    """Return the worst of frames against the print, and of the print."""
    found: list[Worst] = []
    scattered = _extreme(figures, lambda frame: frame.consistency.scatter)
    if (scatter := scattered.consistency.scatter) > 0:
        found.append(Worst("unlike_scatter", "radiometry", f"{100 * scatter:.2g} %", scattered.record.file))
    blocked = _extreme(figures, lambda frame: frame.consistency.block)
    if (block := blocked.consistency.block) > 0:
        where = _place(blocked.record.file, np.array(blocked.consistency.at_mm), blocked.consistency.extent_mm)
        found.append(Worst("unlike_block", "radiometry", f"{100 * block:.2g} %", blocked.record.file, place=where))
    stains, file = figures.cells.stains, figures.session.registered_file
    if stains.known:
        off = stains.largest_deviation()
        colour = int(np.argmax(np.abs(off)))
        middle = chart.centres_mm[chart.cell_of_colour[colour]]
        what = f"colour {colour}, {100 * off[colour]:+.2g} %"
        found.append(Worst("doubtful_share", "radiometry", what, file, place=_place(file, middle, 0.0)))
    white = figures.lights.white.max(axis=1)
    if len(white) > 1:
        for figure, light in (("brightest_share", int(np.argmax(white))), ("darkest_counts", int(np.argmin(white)))):
            found.append(_light(figures, figure, "radiometry", light, f"{white[light]:.0f} counts"))
    ratio = figures.sensor.transfer.ratio
    if len(ratio) == len(chart.cell_of_colour):
        colour = int(np.argmax(ratio))
        middle = chart.centres_mm[chart.cell_of_colour[colour]]
        what = f"colour {colour}, {ratio[colour]:.2g} times the curve's variance"
        found.append(Worst("noisy_share", "noise", what, file, place=_place(file, middle, 0.0)))
    return found


def _of_truth(figures: TableMeasurements) -> list[Worst]:
    lights = figures.lights
    fewest = _extreme(figures, lambda frame: -float(frame.paper.references))
    found = [Worst("references_used", "truth", f"{fewest.paper.references} used", fewest.record.file)]
    whites = figures.white_frames
    if whites:
        spread = max(whites, key=lambda frame: float(frame.paper.spread[int(np.argmax(frame.paper.white))]))
        share = 100 * float(spread.paper.spread[int(np.argmax(spread.paper.white))])
        found.append(Worst("reference_spread", "truth", f"{share:.2g} %", spread.record.file))
    if len(lights.white) > 1:
        light = int(np.argmax(lights.white_error_deg))
        found.append(_light(figures, "truth_worst_deg", "truth", light, f"{lights.white_error_deg[light]:.2g}°"))
    return found


def _extreme(figures: TableMeasurements, value: Callable[[FrameMeasurements], float]) -> FrameMeasurements:
    """Return the frame with the largest value, the first of equals."""
    return max(figures.frames, key=value)


def _light(figures: TableMeasurements, figure: str, group: Group, light: int, what: str) -> Worst:
    frames = (frame.record for frame in figures.frames if frame.record.illumination == light)
    record = next(frames, None)
    return Worst(figure, group, what, "" if record is None else record.file, light)


def _place(file: str, middle_mm: npt.NDArray[np.float64], size_mm: float) -> PrintPlace:
    return PrintPlace(file, float(middle_mm[0]), float(middle_mm[1]), size_mm)
