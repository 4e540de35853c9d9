"""What the frames of a session give together: each is taken in, and which cells are not to be used is found.

Frames enter in the order taken. What one adds depends on those before it alone, so that a build that was stopped goes
on to the same bits.

C cells of S samples, in the order of colour indices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from calibration.measurements import FrameMeasurements
from calibration.pipeline.frames import SelectedFrames
from calibration.pipeline.measuring import Baseline, MeasuredDarkFrame, MeasuredFrame, RegisteredFrame, decode_frame
from calibration.radiometry.dark_frames import (
    DarkFrameFigures,
    DarkLight,
    DarkLightEstimate,
    DarkSummary,
    HotPixels,
    dark_summary,
    median_noise,
)
from calibration.registration.register import MAX_PLACE_ERROR_PX
from calibration.sampling import has_dead_photosite, unevenness
from calibration.spread.added_light import MOST_ADDED, AddedLight
from calibration.table.lut import Unfit
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.measures.stains import Stains, find_stains
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.records import from_plain, to_plain

# Of the cells' levels, what is taken for paper white: the brightest of all may be a reflection.
_BRIGHTEST_PERCENTILE = 99.5

_Array = npt.NDArray[np.float64]
_Arrays = dict[str, npt.NDArray[Any]]
_Figures = tuple[FrameMeasurements | DarkFrameFigures, ...]


@dataclass(frozen=True, eq=False)
class Accumulator:
    """What the frames of a session that were taken in so far have given; each frame makes a new one.

    - `saturation`: raw count of saturation, the lowest that a frame shows.
    - `dark`: what is subtracted from the frames that follow; None where nothing is.
    - `estimate`: of the dark light; only dark frames that are subtracted enter it.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `highest_at`: (C,) int64, the light under which it was reached; −1 for a white frame.
    - `outside`: (C,) bool, whether a cell was cut off in a frame.
    - `covered`: (C,) bool, whether a cell did not look like the chart's in a frame in which the chart was registered.
    - `place_error`: (C,) float64 half-size px, what a cell's place may be off by, the worst of the frames in
      which the chart was registered; over the clearance of its samples (`Registration.clearance`).
    - `even_sum`: (C, S, 3) float32, sum of the frames of even light, counts above black.
    - `even_noise2`: (C, 3) float64, sum of the variances of one sample in these frames, counts².
    """

    session: Session
    selected: SelectedFrames
    baseline: Baseline
    figures: _Figures
    saturation: int
    registered: RegisteredFrame
    dark: DarkLight | None
    estimate: DarkLightEstimate
    hot: HotPixels
    highest: npt.NDArray[np.uint16]
    highest_at: npt.NDArray[np.int64]
    outside: npt.NDArray[np.bool_]
    covered: npt.NDArray[np.bool_]
    place_error: _Array
    even_sum: npt.NDArray[np.float32]
    even_noise2: _Array
    even_frames: int

    @staticmethod
    def empty(
        session: Session,
        selected: SelectedFrames,
        baseline: Baseline,
        saturation: int,
        first_dark: MeasuredDarkFrame | None = None,
    ) -> Accumulator:
        """Return what there is before any frame.

        `saturation`: the raw count that the first registered frame shows. `first_dark`: the first dark frame, whose
        light is subtracted from the frames before it; None if none is.
        """
        count, samples, first = baseline.chart.colour_count, baseline.options.samples, baseline.first
        inside = np.concatenate([first.cells.inside, first.references.inside])
        found = Accumulator(
            session=session,
            selected=selected,
            baseline=baseline,
            figures=(),
            saturation=saturation,
            registered=first,
            dark=None,
            estimate=DarkLightEstimate.start(baseline.reflectances(), inside, samples),
            hot=HotPixels.start(count, samples),
            highest=np.zeros(count, dtype=np.uint16),
            highest_at=np.zeros(count, dtype=np.int64),
            outside=np.zeros(count, dtype=np.bool_),
            covered=_covered_cells(baseline, first),
            place_error=first.registration.expanded_px(baseline.points.cells_mm),
            even_sum=np.zeros((count, samples, 3), dtype=np.float32),
            even_noise2=np.zeros((count, 3)),
            even_frames=0,
        )
        return found if first_dark is None else replace(found, dark=found._learned(first_dark).dark)

    @cached_property
    def frames(self) -> tuple[FrameMeasurements, ...]:
        """Figures of the light and white frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, FrameMeasurements))

    @property
    def darks(self) -> tuple[DarkFrameFigures, ...]:
        """Figures of the dark frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, DarkFrameFigures))

    @property
    def records(self) -> list[FrameRecord]:
        """The frames taken in."""
        return [figures.record for figures in self.figures]

    def with_frame(self, measured: MeasuredFrame | MeasuredDarkFrame) -> Accumulator:
        """Return what there is after the next frame."""
        before = self if measured.registered is self.registered else self._registered_again(measured.registered)
        after = replace(before, figures=(*before.figures, measured.figures))
        if isinstance(measured, MeasuredDarkFrame):
            after = replace(after, hot=before.hot.with_frame(measured.excess))
            return after._learned(measured) if self.baseline.options.subtract_dark else after  # noqa: SLF001 - its own class
        light = measured.figures.record.illumination
        brighter = measured.highest > before.highest
        after = replace(
            after,
            saturation=min(before.saturation, measured.saturation),
            highest=np.where(brighter, measured.highest, before.highest),
            highest_at=np.where(brighter, -1 if light is None else light, before.highest_at),
            outside=before.outside | ~measured.inside,
        )
        if measured.samples is None or measured.noise is None:
            return after
        return replace(
            after,
            even_sum=before.even_sum + measured.samples,
            even_noise2=before.even_noise2 + measured.noise**2,
            even_frames=before.even_frames + 1,
        )

    def _registered_again(self, registered: RegisteredFrame) -> Accumulator:
        error = registered.registration.expanded_px(self.baseline.points.cells_mm)
        return replace(
            self,
            registered=registered,
            estimate=self.estimate.restarted(),
            hot=self.hot.restarted(median_noise(self.darks)),
            covered=self.covered | _covered_cells(self.baseline, registered),
            place_error=np.maximum(self.place_error, error),
        )

    def _learned(self, measured: MeasuredDarkFrame) -> Accumulator:
        """Return what there is with a dark frame taken into the estimate of what is subtracted from those after it."""
        points, reader = self.baseline.points, self.baseline.paper
        means = measured.means[points.white_patches]
        inside = measured.registered.references.inside[: len(points.whites_mm), None]
        paper, shape = reader.read(np.where(inside, means, np.nan), measured.figures.record.file)
        field = np.concatenate([shape, paper.field.at(points.references_mm)])
        estimate, dark = self.estimate.with_frame(measured.means, measured.figures.noise, paper, field)
        return replace(self, estimate=estimate, dark=dark)

    def to_json(self) -> dict[str, Any]:
        """Return what a checkpoint stores as text; the rest is `to_arrays`."""
        return {"registered": self.registered.file, "figures": to_plain(self.figures, _Figures)}

    def to_arrays(self) -> _Arrays:
        """Return what a checkpoint stores as arrays, (...) of any dtype, by name: those of this value and its parts."""
        parts = {"": self, "estimate.": self.estimate, "hot.": self.hot, "dark.": self.dark}
        return {prefix + name: each for prefix, part in parts.items() for name, each in _arrays_of(part).items()}

    def restored(self, values: Mapping[str, Any], arrays: _Arrays) -> Accumulator:
        """Return what was stored of a build of the same frames, `arrays` (...) of any dtype; this one is empty."""
        found = from_plain(_Figures, values["figures"], self.session.folder, "begin the build anew")
        figures = tuple(
            replace(each, record=record) for each, record in zip(found, self.selected.records, strict=False)
        )
        registered = self.baseline.first
        if values["registered"] != registered.file:
            record = next(record for record in self.selected.records if record.file == values["registered"])
            registered = self.baseline.register(decode_frame(self.session, record))

        def stored(prefix: str) -> dict[str, Any]:
            named = {name.removeprefix(prefix): each for name, each in arrays.items() if name.startswith(prefix)}
            return {name: each if each.ndim else each.item() for name, each in named.items() if "." not in name}

        dark = stored("dark.")
        return replace(
            self,
            figures=figures,
            registered=registered,
            dark=DarkLight(**dark) if dark else None,
            estimate=replace(self.estimate, **stored("estimate.")),
            hot=replace(self.hot, **stored("hot.")),
            **stored(""),
        )

    def dark_summary(self) -> DarkSummary:
        """Return what the dark frames show."""
        return dark_summary(self.darks, self.hot)

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
        cells_mm = self.baseline.points.cells_mm
        level = self.even_sum.mean(axis=1, dtype=np.float64) / max(self.even_frames, 1) / field
        return find_stains(level, cells_mm, self.baseline.chart.bits, ~(self.outside | self.covered))

    def unfit(self, stains: Stains, frames: Sequence[FrameMeasurements], added: AddedLight) -> tuple[Unfit, ...]:
        """Return the cells not to be used, each with the first cause that applies; `frames`: what is said of them."""
        lit_by_others = added.certain_share_of(self.baseline.levels).max(axis=1)
        disturbed = disturbed_cells(frames)
        lit = [(frame.consistency.alone, frame.record.illumination) for frame in frames]
        alone = {colour: light for cells, light in lit if light is not None for colour in cells}
        even, dark = max(self.even_frames, 1), self.dark_summary()
        hottest = dark.hottest if len(dark.hottest) else np.zeros(self.baseline.chart.colour_count)
        dead = has_dead_photosite(self.even_sum / even)
        uneven = unevenness(self.even_sum / even, np.sqrt(self.even_noise2) / even)
        allowed, samples = CLIPPING_SHARE * self.saturation, self.even_sum.shape[1]
        found: list[Unfit] = []
        for colour in range(self.baseline.chart.colour_count):
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
                    "allowed; the print waves there, or little of it is seen"
                )
            elif lit_by_others[colour] > MOST_ADDED:
                cause = (
                    f"lit: {lit_by_others[colour]:.1%} of its level is light that lies on the print there (reflection)"
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


def stored_names() -> list[str]:
    """Return the names that a checkpoint stores; a build does not go on from one that was made with others."""
    parts = (Accumulator, FrameMeasurements, DarkFrameFigures, DarkLight, DarkLightEstimate, HotPixels)
    return [f"{part.__name__}.{field.name}" for part in parts for field in fields(part)]


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


def _covered_cells(baseline: Baseline, registered: RegisteredFrame) -> npt.NDArray[np.bool_]:
    """Return the cells (C,) that do not look like the chart's, alone or with their neighbourhood."""
    registration = registered.registration
    nearest = np.asarray(cKDTree(registration.blocks.centres_mm).query(baseline.points.cells_mm)[1])
    return registration.mismatched_cells[baseline.chart.cell_of_colour] | ~registration.blocks.good[nearest]


def _arrays_of(part: Any) -> _Arrays:
    """Return the arrays and counts of a frozen value by the names of its fields; none of None."""
    values = {} if part is None else {field.name: getattr(part, field.name) for field in fields(part)}
    return {name: np.asarray(value) for name, value in values.items() if isinstance(value, np.ndarray | int)}
