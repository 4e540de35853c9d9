"""What frames leave behind, in the order taken: the evenness of cells, the highest counts, and which cells are unfit.

Laws that hold inside:

- Frames enter in the order taken, and what one adds depends on those before it alone: a tally that was put away and
  taken up again ends in the same bits.
- A cell that is cut off, clipped, covered or not of one colour is listed with its cause. It is never filled.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from acquisition.chart.model import Chart
from calibration.checks.stains import Stains, find_stains
from calibration.pipeline.measuring import Measured, MeasuredDark, Stretch
from calibration.radiometry.darkness import DarkFigures, Darkness, HotSamples, darkness, usual_noise
from calibration.radiometry.paper import CLIPPED, Field
from calibration.registration.matching import MIN_BLOCK_SCORE
from calibration.sampling.samples import dead_samples, uneven
from calibration.table.lut import Unfit

_Array = npt.NDArray[np.float64]


class Tally:
    """Takes in measured frames.

    Parameters
    ----------
    chart
        The chart.
    samples
        Samples of each cell.
    first
        What holds for the first frames.
    """

    def __init__(self, chart: Chart, samples: int, first: Stretch) -> None:
        count = chart.colour_count
        self._chart = chart
        self._highest = np.zeros(count, dtype=np.uint16)
        self._highest_at = np.zeros(count, dtype=np.int64)
        self._outside = np.zeros(count, dtype=bool)
        self._even_sum: npt.NDArray[np.float32] = np.zeros((count, samples, 3), dtype=np.float32)
        self._even_noise = np.zeros((count, 3))
        self._even_frames = 0
        self._covered = _covered_cells(chart, first)
        self._hot = HotSamples(count, samples)
        self._darks: list[DarkFigures] = []

    def add(self, measured: Measured) -> None:
        """Take in a light or white frame."""
        light = measured.figures.record.illumination
        brighter = measured.highest > self._highest
        self._highest[brighter] = measured.highest[brighter]
        self._highest_at[brighter] = -1 if light is None else light
        self._outside |= ~measured.inside
        if measured.figures.registered:
            self._covered |= _covered_cells(self._chart, measured.stretch)
            self._hot.move(usual_noise(self._darks))
        if measured.samples is not None and measured.noise is not None:
            self._even_sum += measured.samples
            self._even_noise += measured.noise**2
            self._even_frames += 1

    def add_dark(self, measured: MeasuredDark) -> None:
        """Take in a dark frame."""
        self._darks.append(measured.figures)
        self._hot.add(measured.aside)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what the frames so far have left, but for the figures of dark ones."""
        return {
            "highest": self._highest,
            "highest_at": self._highest_at,
            "outside": self._outside,
            "covered": self._covered,
            "even_sum": self._even_sum,
            "even_noise": self._even_noise,
            "even_frames": np.array(self._even_frames),
            **self._hot.state(),
        }

    def restore(self, state: dict[str, npt.NDArray[Any]], darks: list[DarkFigures]) -> None:
        """Go on from what `state` returned, and the figures of the dark frames."""
        self._highest, self._highest_at = state["highest"], state["highest_at"]
        self._outside, self._covered = state["outside"], state["covered"]
        self._even_sum, self._even_noise = state["even_sum"], state["even_noise"]
        self._even_frames = int(state["even_frames"])
        self._hot.restore(state)
        self._darks = list(darks)

    @property
    def darkness(self) -> Darkness:
        """What the dark frames say."""
        return darkness(self._darks, self._hot)

    def saturated(self, saturation_counts: int) -> bool:
        """Return whether a photosite of a cell reached saturation."""
        return bool((self._highest >= saturation_counts).any())

    def noise(self) -> _Array:
        """Return the median standard deviation of one sample of the even frames, relative to the brightest cells."""
        frames = max(self._even_frames, 1)
        level = np.percentile(self._even_sum.mean(axis=1) / frames, 99.5, axis=0)
        return np.sqrt(np.median(self._even_noise / frames, axis=0)) / np.maximum(level, 1e-6)

    def stains(self, field: Field) -> Stains:
        """Return where the print is not of its codes' colours; `field` is that of a frame of even light."""
        cells = self._chart.centres_mm[self._chart.cell_of_colour]
        level = self._even_sum.mean(axis=1, dtype=np.float64) / max(self._even_frames, 1) / field.at(cells)
        return find_stains(level, cells, self._chart.bits, ~(self._outside | self._covered))

    def unfit(self, saturation_counts: int, stains: Stains) -> tuple[Unfit, ...]:
        """Return the cells not to be used, each with the first cause that applies."""
        frames, dark = max(self._even_frames, 1), self.darkness
        hottest = dark.hottest if len(dark.hottest) else np.zeros(self._chart.colour_count)
        dead = dead_samples(self._even_sum / frames)
        unevenness = uneven(self._even_sum / frames, np.sqrt(self._even_noise) / frames)
        allowed, samples = CLIPPED * saturation_counts, self._even_sum.shape[1]
        found: list[Unfit] = []
        for colour in range(self._chart.colour_count):
            cause = ""
            if self._outside[colour]:
                cause = f"outside: its {samples} pixels do not all lie in the frame"
            elif self._highest[colour] >= allowed:
                light = int(self._highest_at[colour])
                under = f"light {light}" if light >= 0 else "white"
                cause = f"clipped: {int(self._highest[colour])} counts under {under}, below {allowed:.0f} allowed"
            elif self._covered[colour]:
                cause = "covered: it does not look like the chart's (covered, damaged, or printed otherwise)"
            elif stains.stained[colour]:
                aside = stains.told(colour)
                how = f"{abs(aside):.1%} {'darker' if aside < 0 else 'brighter'}"
                cause = f"stained: it is, or its surroundings are, {how} than their codes elsewhere on the print"
            elif hottest[colour] > 0:
                cause = f"hot: a photosite stands out by {hottest[colour]:.0f} counts in every dark frame"
            elif dead[colour]:
                cause = "dead: a photosite sees less than half of the light of its cell"
            elif unevenness[colour] > 0:
                cause = f"uneven: rim and middle differ by {unevenness[colour]:.1%} under white"
            if cause:
                found.append(Unfit(colour=colour, cause=cause))
        return tuple(found)


def _covered_cells(chart: Chart, stretch: Stretch) -> npt.NDArray[np.bool_]:
    """Return the cells that do not look like the chart's, alone or with their neighbourhood."""
    blocks, cells = stretch.registration.blocks, chart.cell_of_colour
    nearest = np.asarray(cKDTree(blocks.centres_mm).query(chart.centres_mm[cells])[1])
    return stretch.registration.strangers[cells] | np.asarray(blocks.score[nearest] < MIN_BLOCK_SCORE)
