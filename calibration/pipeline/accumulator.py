"""Take in frames, one after another, in the order taken; what is known after each is one frozen value.

Rules that hold inside:

- What a frame adds depends on those before it alone, so that a build that was stopped goes on to the same bits.
- A frame measured before its turn counts only if the frame registered last is still the one it was measured with.
- The dark light of a frame is that of the last dark frame before it, or of the first, for frames before that.

What frames show of the cells, in the order taken: evenness, highest counts, and which cells are unfit for use.

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
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from calibration.figures.frame_figures import FrameFigures
from calibration.pipeline.baseline import Baseline, RegisteredFrame
from calibration.pipeline.frames import SelectedFrames, decode_frame
from calibration.pipeline.measuring import (
    MeasuredDarkFrame,
    MeasuredFrame,
    measure_frame,
    measure_registered_frame,
    movement_of,
    sample_dark_frame,
)
from calibration.radiometry.dark_frames import (
    DarkFrameFigures,
    DarkLight,
    DarkLightEstimator,
    DarkSummary,
    HotPixels,
    dark_summary,
    median_noise,
)
from calibration.registration.register import MAX_PLACE_ERROR_PX
from calibration.sampling import has_dead_photosite, unevenness
from calibration.table.lut import Unfit
from experiment.chart.model import Chart
from experiment.framing.movement import Shift
from experiment.framing.planes import CLIPPING_SHARE
from experiment.measures.stains import Stains, find_stains
from experiment.session.folder import Session
from experiment.session.records import FrameRecord

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

    def unfit(self, saturation_counts: int, stains: Stains, frames: Sequence[FrameFigures]) -> tuple[Unfit, ...]:
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


def disturbed_cells(frames: Sequence[FrameFigures]) -> dict[int, list[tuple[int, float]]]:
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


EarlyMeasurement = MeasuredFrame | MeasuredDarkFrame | None
"""A frame as measured before its turn; None where the chart has to be registered again in it."""


@dataclass(frozen=True, eq=False)
class IntakeState:
    """What the frames taken in so far have given.

    - `figures`: of each frame taken in, in order.
    - `statistics`: what they show of the cells.
    - `saturation`: raw count of saturation, the lowest that a frame shows.
    - `registered`: the frame registered last.
    - `estimator`: estimates the dark light; only dark frames that are subtracted enter it.
    - `dark`: what is subtracted from the frames that follow; None where nothing is.
    """

    figures: tuple[FrameFigures | DarkFrameFigures, ...]
    statistics: CellStatistics
    saturation: int
    registered: RegisteredFrame
    estimator: DarkLightEstimator
    dark: DarkLight | None

    @cached_property
    def frames(self) -> tuple[FrameFigures, ...]:
        """Figures of the light and white frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, FrameFigures))

    @property
    def records(self) -> list[FrameRecord]:
        """The frames taken in."""
        return [figures.record for figures in self.figures]

    def to_json(self) -> dict[str, Any]:
        """Return what a checkpoint stores as text; the rest is `to_arrays`."""
        return {
            "saturation": self.saturation,
            "registered": self.registered.file,
            "figures": [figures.to_json() for figures in self.figures],
        }

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return what a checkpoint stores as arrays, (C, S, 3) float32 `even_sum` and others by name.

        The rest stands at `CellStatistics.to_arrays` and `DarkLightEstimator.to_arrays`.
        """
        return {**self.statistics.to_arrays(), **self.estimator.to_arrays()}


@dataclass(frozen=True, eq=False)
class Intake:
    """The frames of a session on their way into a table: what does not change while they are taken in.

    - `session`: where the frames are read.
    - `baseline`: what holds for all of them.
    """

    session: Session
    selected: SelectedFrames
    baseline: Baseline

    @property
    def subtracts_dark(self) -> bool:
        """Whether the light of the dark frames is subtracted."""
        return self.baseline.options.subtract_dark

    def others_wait_for(self, record: FrameRecord) -> bool:
        """Return whether the frames after this one can be measured only when it has been taken in."""
        return self.subtracts_dark and record.kind == "dark"

    def before_all_frames(self, saturation: int) -> IntakeState:
        """Return the state before any frame; `saturation` is the raw count that the first registered frame shows."""
        baseline = self.baseline
        return IntakeState(
            figures=(),
            statistics=CellStatistics.before_all_frames(baseline.chart, baseline.options.samples, baseline.first),
            saturation=saturation,
            registered=baseline.first,
            estimator=baseline.dark_light_estimator(),
            dark=None,
        )

    def restored(self, stored: dict[str, Any], arrays: dict[str, npt.NDArray[Any]], begin: IntakeState) -> IntakeState:
        """Return the state that a checkpoint stored; `arrays`: of `IntakeState.to_arrays`, (...), any dtype."""
        page_mm = self.baseline.chart.page_mm
        figures = tuple(
            DarkFrameFigures.from_json(record, figures)
            if record.kind == "dark"
            else FrameFigures.from_json(record, page_mm, figures)
            for record, figures in zip(self.selected.records, stored["figures"], strict=False)
        )
        registered = self.baseline.first
        if stored["registered"] != registered.file:
            record = next(record for record in self.selected.records if record.file == stored["registered"])
            registered = self.baseline.register(decode_frame(self.session, record))
        estimator = deepcopy(begin.estimator)
        estimator.restore(arrays)
        darks = tuple(dark for dark in figures if isinstance(dark, DarkFrameFigures))
        return IntakeState(
            figures=figures,
            statistics=begin.statistics.from_arrays(arrays, darks),
            saturation=int(stored["saturation"]),
            registered=registered,
            estimator=estimator,
            dark=estimator.current,
        )

    def with_dark_light(self, state: IntakeState) -> IntakeState:
        """Return the state with the dark light that frames before the first dark one get, which is that one's."""
        if not self.subtracts_dark or state.dark is not None:
            return state
        record = next(record for record in self.selected.records if record.kind == "dark")
        measured = sample_dark_frame(self.baseline, decode_frame(self.session, record), self.baseline.first)
        return replace(state, dark=self._learn(self.baseline.dark_light_estimator(), measured))

    def measure(self, record: FrameRecord, state: IntakeState) -> EarlyMeasurement:
        """Return what a frame shows in this state; None where the chart has to be registered again. Thread-safe."""
        decoded = decode_frame(self.session, record)
        if record.kind == "dark":
            return sample_dark_frame(self.baseline, decoded, state.registered)
        even = self.selected.is_even(record)
        measured = measure_frame(self.baseline, decoded, state.registered, even, state.dark)
        return None if isinstance(measured, Shift) else measured

    def take_in(
        self, record: FrameRecord, early: EarlyMeasurement, state: IntakeState
    ) -> tuple[IntakeState, MeasuredFrame | MeasuredDarkFrame]:
        """Return the state after the next frame, and the frame as measured."""
        current = early is not None and early.registered is state.registered
        measured = early if current else self.measure(record, state)
        if measured is None:
            state, measured = self._register_again(record, state)
        if isinstance(measured, MeasuredDarkFrame):
            return self.with_dark_frame(measured, state), measured
        return self.with_frame(measured, state), measured

    def with_frame(self, measured: MeasuredFrame, state: IntakeState) -> IntakeState:
        """Return the state after a light or white frame."""
        return replace(
            state,
            figures=(*state.figures, measured.figures),
            statistics=state.statistics.with_frame(measured),
            saturation=min(state.saturation, measured.saturation),
        )

    def with_dark_frame(self, measured: MeasuredDarkFrame, state: IntakeState) -> IntakeState:
        """Return the state after a dark frame."""
        state = replace(
            state,
            figures=(*state.figures, measured.figures),
            statistics=state.statistics.with_dark_frame(measured),
        )
        if not self.subtracts_dark:
            return state
        estimator = deepcopy(state.estimator)
        return replace(state, estimator=estimator, dark=self._learn(estimator, measured))

    def _register_again(self, record: FrameRecord, state: IntakeState) -> tuple[IntakeState, MeasuredFrame]:
        """Return the state with the chart registered in this frame, and what the frame shows."""
        decoded = decode_frame(self.session, record)
        registered = self.baseline.register(decoded)
        shift = movement_of(self.baseline, state.registered, registered)
        estimator = deepcopy(state.estimator)
        estimator.restart()
        even = self.selected.is_even(record)
        measured = measure_registered_frame(self.baseline, decoded, registered, shift, even, state.dark)
        return replace(state, registered=registered, estimator=estimator), measured

    def _learn(self, estimator: DarkLightEstimator, measured: MeasuredDarkFrame) -> DarkLight:
        """Take a dark frame into the estimate and return what is subtracted from the frames after it."""
        points, reader = self.baseline.points, self.baseline.paper
        means = measured.means[len(points.cells_mm) :][: len(points.whites_mm)]
        inside = measured.registered.references.inside[: len(points.whites_mm), None]
        paper, shape = reader.read(np.where(inside, means, np.nan), measured.figures.record.file)
        field = np.concatenate([shape, paper.field.at(points.references_mm)])
        return estimator.add(measured.means, measured.figures.noise, paper, field)
