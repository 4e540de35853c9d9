"""What frames show of the cells, in the order taken: evenness, highest counts, and which cells are unfit for use.

Rules that hold inside:

- Frames enter in the order taken, and what one adds depends on those before it alone: statistics that were stored in a
  checkpoint and restored end in the same bits.
- A cell that is cut off, clipped, covered or not of one colour is listed with its cause. It is never filled.

C cells of S samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from calibration.measurements import FrameMeasurements
from calibration.pipeline.measuring import MeasuredDarkFrame, MeasuredFrame
from calibration.pipeline.registered_frame import RegisteredFrame
from calibration.radiometry.dark_frames import DarkFrameFigures, DarkSummary, HotPixels, dark_summary, median_noise
from calibration.registration.registration import MAX_PLACE_ERROR_PX
from calibration.sampling.patch_statistics import has_dead_photosite, unevenness
from calibration.table.provenance import Unfit
from experiment.chart.model import Chart
from experiment.framing.planes import CLIPPING_SHARE
from experiment.measures.stains import Stains, find_stains

_BRIGHTEST_PERCENTILE = 99.5
"""Of the cells' levels, what is taken for paper white: the brightest of all may be a reflection."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CellStatistics:
    """What the frames taken in so far show of the cells; each frame makes new ones.

    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `highest_at`: (C,) int64, the light under which it was reached; −1 for a white frame.
    - `outside`: (C,) bool, whether a cell was cut off in a frame.
    - `covered`: (C,) bool, whether a cell did not look like the chart's in a frame in which the chart was registered.
    - `place_error`: (C,) float64 half-size px, three standard errors of a cell's place, the worst of the frames in
      which the chart was registered; over the clearance of its samples (`Registration.clearance`).
    - `even_sum`: (C, S, 3) float32, sum of the frames of even light, counts above black.
    - `even_noise2`: (C, 3) float64, sum of the variances of one sample in these frames, counts².
    - `even_frames`: how many they are.
    - `hot`: samples that stand out in every dark frame.
    - `darks`: figures of the dark frames.
    """

    chart: Chart
    highest: npt.NDArray[np.uint16]
    highest_at: npt.NDArray[np.int64]
    outside: _Mask
    covered: _Mask
    place_error: _Array
    even_sum: npt.NDArray[np.float32]
    even_noise2: _Array
    even_frames: int
    hot: HotPixels
    darks: tuple[DarkFrameFigures, ...]

    @staticmethod
    def before_all_frames(chart: Chart, samples: int, first: RegisteredFrame) -> CellStatistics:
        """Return the statistics before any frame is taken in."""
        count = chart.colour_count
        return CellStatistics(
            chart=chart,
            highest=np.zeros(count, dtype=np.uint16),
            highest_at=np.zeros(count, dtype=np.int64),
            outside=np.zeros(count, dtype=np.bool_),
            covered=_covered_cells(chart, first),
            place_error=_place_errors(chart, first),
            even_sum=np.zeros((count, samples, 3), dtype=np.float32),
            even_noise2=np.zeros((count, 3)),
            even_frames=0,
            hot=HotPixels(count, samples),
            darks=(),
        )

    def with_frame(self, measured: MeasuredFrame) -> CellStatistics:
        """Return the statistics after a light or white frame."""
        light = measured.figures.record.illumination
        brighter = measured.highest > self.highest
        after = replace(
            self,
            highest=np.where(brighter, measured.highest, self.highest),
            highest_at=np.where(brighter, -1 if light is None else light, self.highest_at),
            outside=self.outside | ~measured.inside,
        )
        if measured.figures.reregistered:
            hot = deepcopy(self.hot)
            hot.restart(median_noise(self.darks))
            covered = self.covered | _covered_cells(self.chart, measured.registered)
            place_error = np.maximum(self.place_error, _place_errors(self.chart, measured.registered))
            after = replace(after, covered=covered, place_error=place_error, hot=hot)
        if measured.samples is not None and measured.noise is not None:
            after = replace(
                after,
                even_sum=self.even_sum + measured.samples,
                even_noise2=self.even_noise2 + measured.noise**2,
                even_frames=self.even_frames + 1,
            )
        return after

    def with_dark_frame(self, measured: MeasuredDarkFrame) -> CellStatistics:
        """Return the statistics after a dark frame."""
        hot = deepcopy(self.hot)
        hot.add(measured.excess)
        return replace(self, hot=hot, darks=(*self.darks, measured.figures))

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return what a checkpoint stores of the statistics: all but chart and figures of dark frames.

        (C,) uint16, int64 and bool, (C, S, 3) float32 and (C, 3) float64 by the attributes' names, `even_frames` as a
        scalar int64; and what `HotPixels.to_arrays` returns.
        """
        return {
            "highest": self.highest,
            "highest_at": self.highest_at,
            "outside": self.outside,
            "covered": self.covered,
            "place_error": self.place_error,
            "even_sum": self.even_sum,
            "even_noise2": self.even_noise2,
            "even_frames": np.array(self.even_frames),
            **self.hot.to_arrays(),
        }

    def from_arrays(self, stored: dict[str, npt.NDArray[Any]], darks: tuple[DarkFrameFigures, ...]) -> CellStatistics:
        """Return statistics of the same chart from what `to_arrays` returned, and the figures of the dark frames.

        Each array of `stored` has the same shape and dtype as there; that is not checked.
        """
        hot = deepcopy(self.hot)
        hot.restore(stored)
        return replace(
            self,
            highest=stored["highest"],
            highest_at=stored["highest_at"],
            outside=stored["outside"],
            covered=stored["covered"],
            place_error=stored["place_error"],
            even_sum=stored["even_sum"],
            even_noise2=stored["even_noise2"],
            even_frames=int(stored["even_frames"]),
            hot=hot,
            darks=darks,
        )

    def dark_summary(self) -> DarkSummary:
        """Return what the dark frames show."""
        return dark_summary(self.darks, self.hot)

    def saturated(self, saturation_counts: int) -> bool:
        """Return whether a photosite of a cell reached saturation, given as a raw count."""
        return bool((self.highest >= saturation_counts).any())

    def noise(self) -> _Array:
        """Return (3,) float64, median standard deviation of one sample in the even frames, of the brightest cells'."""
        frames = max(self.even_frames, 1)
        level = np.percentile(self.even_sum.mean(axis=1) / frames, _BRIGHTEST_PERCENTILE, axis=0)
        return np.sqrt(np.median(self.even_noise2 / frames, axis=0)) / np.maximum(level, 1e-6)

    def stains(self, field: _Array) -> Stains:
        """Return where the print does not have its codes' colours.

        `field` (C, 3) float64 is that of a frame of even light, of each cell's own colour as far as it is known: by the
        field of paper alone, cells of one side would be off where the primaries light the print in different ways.
        """
        cells_mm = self.chart.centres_mm[self.chart.cell_of_colour]
        level = self.even_sum.mean(axis=1, dtype=np.float64) / max(self.even_frames, 1) / field
        return find_stains(level, cells_mm, self.chart.bits, ~(self.outside | self.covered))

    def unfit(self, saturation_counts: int, stains: Stains, frames: Sequence[FrameMeasurements]) -> tuple[Unfit, ...]:
        """Return the cells not to be used, each with the first cause that applies.

        `saturation_counts`: raw count of saturation.
        """
        disturbed = disturbed_cells(frames)
        lit = [(frame.consistency.alone, frame.record.illumination) for frame in frames]
        alone = {colour: light for cells, light in lit if light is not None for colour in cells}
        even, dark = max(self.even_frames, 1), self.dark_summary()
        hottest = dark.hottest if len(dark.hottest) else np.zeros(self.chart.colour_count)
        dead = has_dead_photosite(self.even_sum / even)
        uneven = unevenness(self.even_sum / even, np.sqrt(self.even_noise2) / even)
        allowed, samples = CLIPPING_SHARE * saturation_counts, self.even_sum.shape[1]
        found: list[Unfit] = []
        for colour in range(self.chart.colour_count):
            cause = ""
            if self.outside[colour]:
                cause = f"outside: its {samples} pixels do not all lie in the frame"
            elif self.highest[colour] >= allowed:
                light = int(self.highest_at[colour])
                under = f"light {light}" if light >= 0 else "white"
                cause = f"clipped: {int(self.highest[colour])} counts under {under}, below {allowed:.0f} allowed"
            elif self.covered[colour]:
                cause = "covered: it does not look like the chart's (covered, damaged, or printed otherwise)"
            elif self.place_error[colour] > MAX_PLACE_ERROR_PX:
                cause = (
                    f"misplaced: its place is known to {self.place_error[colour]:.2f} px, {MAX_PLACE_ERROR_PX:g} px "
                    "allowed (three standard errors); the print waves there, or little of it is seen"
                )
            elif stains.stained[colour]:
                deviation = stains.deviation_of(colour)
                how = f"{abs(deviation):.1%} {'darker' if deviation < 0 else 'brighter'}"
                cause = f"stained: it is, or its surroundings are, {how} than their codes elsewhere on the print"
            elif hottest[colour] > 0:
                cause = f"hot: a photosite stands out by {hottest[colour]:.0f} counts in every dark frame"
            elif dead[colour]:
                cause = "dead: a photosite sees less than half of the light of its cell"
            elif uneven[colour] > 0:
                cause = f"uneven: rim and middle differ by {uneven[colour]:.1%} under white"
            elif colour in disturbed:
                cause = f"disturbed: {_disturbance(disturbed[colour])}"
            elif colour in alone:
                cause = f"unlike: under light {alone[colour]} it is far from its code, and its neighbours are not"
            if cause:
                found.append(Unfit(colour=colour, cause=cause))
        return tuple(found)


def disturbed_cells(frames: Sequence[FrameMeasurements]) -> dict[int, list[tuple[int, float]]]:
    """Return the lights under which something covered cells, and how far these are off; by the cells' colours.

    White frames' do not count: a table has no samples of them.
    """
    found: dict[int, list[tuple[int, float]]] = {}
    for frame in frames:
        if frame.record.illumination is not None:
            for colour, off in frame.consistency.disturbed:
                found.setdefault(colour, []).append((frame.record.illumination, off))
    return found


def _disturbance(under: list[tuple[int, float]]) -> str:
    light, off = max(under, key=lambda one: abs(one[1]))
    more = f" and {len(under) - 1} more" if len(under) > 1 else ""
    deviation = f"{abs(off):.1%} {'darker' if off < 0 else 'brighter'} than its code gives"
    how = deviation if off else "too dark to be compared"
    return f"under light {light}{more} it is {how}, next to cells that are far off"


def _place_errors(chart: Chart, registered: RegisteredFrame) -> _Array:
    """Return three standard errors (C,) of the cells' places, in the order of colours, over their clearance."""
    registration = registered.registration
    return 3 * registration.uncertainty_px(chart.centres_mm[chart.cell_of_colour]) / registration.clearance


def _covered_cells(chart: Chart, registered: RegisteredFrame) -> _Mask:
    """Return the cells (C,) that do not look like the chart's, alone or with their neighbourhood."""
    blocks, cells = registered.registration.blocks, chart.cell_of_colour
    nearest = np.asarray(cKDTree(blocks.centres_mm).query(chart.centres_mm[cells])[1])
    return registered.registration.mismatched_cells[cells] | ~blocks.good[nearest]
