"""Accumulate measurements of the frames of a session, and list the unfit patches.

Frames are added in the order taken. Each state depends only on the frames added so far. Therefore an interrupted build
resumes with identical results. Arrays have C patches in the order of colour indices, with S samples each.
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

# Percentile of the levels of patches, used as paper white. The brightest patch may be a reflection.
_BRIGHTEST_PERCENTILE = 99.5

_Array = npt.NDArray[np.float64]
_Arrays = dict[str, npt.NDArray[Any]]
_Figures = tuple[FrameMeasurements | DarkFrameFigures, ...]


@dataclass(frozen=True, eq=False)
class Accumulator:
    """State after the frames added so far; adding a frame returns a new state."""

    session: Session
    selected: SelectedFrames
    baseline: Baseline
    figures: _Figures
    saturation: int  # Raw count of saturation, the lowest of all frames
    registered: RegisteredFrame
    dark: DarkLight | None  # Light to subtract from the following frames, if any
    estimate: DarkLightEstimate  # Estimate of the dark light; unchanged if dark light is not subtracted
    hot: HotPixels
    highest: npt.NDArray[np.uint16]  # (C,), highest raw count of each patch
    highest_at: npt.NDArray[np.int64]  # (C,), illuminant with this count; −1 for a white frame
    outside: npt.NDArray[np.bool_]  # (C,), patch partly outside a frame
    covered: npt.NDArray[np.bool_]  # (C,), patch does not match the chart in a registered frame
    place_error: _Array  # (C,) px, largest uncertainty of position (`Registration.expanded_px`) in registered frames
    even_sum: npt.NDArray[np.float32]  # (C, S, 3) counts above black, sum of the evenly lit frames (`is_evenly_lit`)
    even_noise2: _Array  # (C, 3) counts², sum of the variances of one sample in these frames
    even_frames: int

    @staticmethod
    def empty(
        session: Session,
        selected: SelectedFrames,
        baseline: Baseline,
        saturation: int,
        first_dark: MeasuredDarkFrame | None = None,
    ) -> Accumulator:
        """Return the state before the first frame.

        `saturation`: count of saturation in the first registered frame. `first_dark`: first dark frame, which is
        subtracted from the frames before it.
        """
        count, samples, first = baseline.chart.colour_count, baseline.options.samples, baseline.first
        inside = np.concatenate([first.cells.inside, first.references.inside])
        empty = Accumulator(
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
        return empty if first_dark is None else replace(empty, dark=empty._with_dark_light(first_dark).dark)

    @cached_property
    def frames(self) -> tuple[FrameMeasurements, ...]:
        """Measurements of the light and white frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, FrameMeasurements))

    @property
    def darks(self) -> tuple[DarkFrameFigures, ...]:
        """Measurements of the dark frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, DarkFrameFigures))

    @property
    def records(self) -> list[FrameRecord]:
        """Records of the added frames."""
        return [figures.record for figures in self.figures]

    def with_frame(self, measured: MeasuredFrame | MeasuredDarkFrame) -> Accumulator:
        """Return the state with the next frame added."""
        previous = self if measured.registered is self.registered else self._registered_again(measured.registered)
        updated = replace(previous, figures=(*previous.figures, measured.figures))
        if isinstance(measured, MeasuredDarkFrame):
            updated = replace(updated, hot=previous.hot.with_frame(measured.excess))
            return updated._with_dark_light(measured) if self.baseline.options.subtract_dark else updated  # noqa: SLF001 - its own class
        light = measured.figures.record.illumination
        brighter = measured.highest > previous.highest
        updated = replace(
            updated,
            saturation=min(previous.saturation, measured.saturation),
            highest=np.where(brighter, measured.highest, previous.highest),
            highest_at=np.where(brighter, -1 if light is None else light, previous.highest_at),
            outside=previous.outside | ~measured.inside,
        )
        if measured.samples is None or measured.noise is None:
            return updated
        return replace(
            updated,
            even_sum=previous.even_sum + measured.samples,
            even_noise2=previous.even_noise2 + measured.noise**2,
            even_frames=previous.even_frames + 1,
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

    def _with_dark_light(self, measured: MeasuredDarkFrame) -> Accumulator:
        points, reader = self.baseline.points, self.baseline.paper
        means = measured.means[points.white_patches]
        inside = measured.registered.references.inside[: len(points.whites_mm), None]
        paper, shape = reader.read(np.where(inside, means, np.nan), measured.figures.record.file)
        field = np.concatenate([shape, paper.field.at(points.references_mm)])
        estimate, dark = self.estimate.with_frame(measured.means, measured.figures.noise, paper, field)
        return replace(self, estimate=estimate, dark=dark)

    def to_json(self) -> dict[str, Any]:
        """Return the part of a checkpoint stored as text; see also `to_arrays`."""
        return {"registered": self.registered.file, "figures": to_plain(self.figures, _Figures)}

    def to_arrays(self) -> _Arrays:
        """Return the part of a checkpoint that is stored as arrays of any shape, by name."""
        owners = {"": self, "estimate.": self.estimate, "hot.": self.hot, "dark.": self.dark}
        return {prefix + name: array for prefix, owner in owners.items() for name, array in _arrays_of(owner).items()}

    def restored(self, values: Mapping[str, Any], arrays: _Arrays) -> Accumulator:
        """Return the state of a checkpoint; `self` must be empty. `values`, `arrays`: from `to_json`, `to_arrays`."""
        stored_figures = from_plain(_Figures, values["figures"], self.session.folder, "start the build again")
        figures = tuple(
            replace(value, record=record) for value, record in zip(stored_figures, self.selected.records, strict=False)
        )
        registered = self.baseline.first
        if values["registered"] != registered.file:
            record = next(record for record in self.selected.records if record.file == values["registered"])
            registered = self.baseline.register(decode_frame(self.session, record))

        def stored(prefix: str) -> dict[str, Any]:
            subset = {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
            return {name: value if value.ndim else value.item() for name, value in subset.items() if "." not in name}

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
        """Return the summary of the dark frames."""
        return dark_summary(self.darks, self.hot)

    def noise(self) -> _Array:
        """Return (3,) float64, median noise of one sample in evenly lit frames, relative to paper white."""
        frames = max(self.even_frames, 1)
        level = np.percentile(self.even_sum.mean(axis=1) / frames, _BRIGHTEST_PERCENTILE, axis=0)
        return np.sqrt(np.median(self.even_noise2 / frames, axis=0)) / np.maximum(level, 1e-6)

    def stains(self, field: _Array) -> Stains:
        """Return the areas of the print with colours that differ from patches of similar codes elsewhere.

        `field`: (C, 3) float64, flat field of an evenly lit frame for the colour of each patch. It differs from the
        flat field of paper if the primaries have different flat fields.
        """
        cells_mm = self.baseline.points.cells_mm
        level = self.even_sum.mean(axis=1, dtype=np.float64) / max(self.even_frames, 1) / field
        return find_stains(level, cells_mm, self.baseline.chart.bits, ~(self.outside | self.covered))

    def unfit(self, stains: Stains, frames: Sequence[FrameMeasurements], added: AddedLight) -> tuple[Unfit, ...]:
        """Return the unfit patches, each with the first cause that applies. `frames`: measurements of all frames."""
        added_share = added.certain_share_of(self.baseline.levels).max(axis=1)
        disturbed = disturbed_cells(frames)
        isolated_by_frame = [(frame.consistency.isolated, frame.record.illumination) for frame in frames]
        light_by_colour = {colour: light for cells, light in isolated_by_frame if light is not None for colour in cells}
        even_count, summary = max(self.even_frames, 1), self.dark_summary()
        hottest = summary.hottest if len(summary.hottest) else np.zeros(self.baseline.chart.colour_count)
        dead = has_dead_photosite(self.even_sum / even_count)
        uneven = unevenness(self.even_sum / even_count, np.sqrt(self.even_noise2) / even_count)
        limit, samples = CLIPPING_SHARE * self.saturation, self.even_sum.shape[1]
        unfit_cells: list[Unfit] = []
        for colour in range(self.baseline.chart.colour_count):
            cause = ""
            if self.outside[colour]:
                cause = (
                    f"outside: some of its {samples} pixels are outside the frame; bring the whole chart into the frame"
                )
            elif self.highest[colour] >= limit:
                light = int(self.highest_at[colour])
                under = f"illuminant {light}" if light >= 0 else "white"
                cause = f"clipped: {int(self.highest[colour])} counts under {under}, expected less than {limit:.0f}"
            elif self.covered[colour]:
                cause = "covered: it does not match the chart (covered, damaged, or another print)"
            elif self.place_error[colour] > MAX_PLACE_ERROR_PX:
                cause = (
                    f"misplaced: uncertainty of its position {self.place_error[colour]:.2f} px, expected at most "
                    f"{MAX_PLACE_ERROR_PX:g} px; the print is wavy or partly hidden there"
                )
            elif added_share[colour] > MOST_ADDED:
                cause = f"lit: {added_share[colour]:.1%} of its level is added light on the print (reflection)"
            elif stains.stained[colour]:
                deviation = stains.deviation_of(colour)
                difference = f"{abs(deviation):.1%} {'darker' if deviation < 0 else 'brighter'}"
                cause = f"stained: its area is {difference} than the same codes elsewhere on the print"
            elif hottest[colour] > 0:
                cause = f"hot: a photosite exceeds the others by {hottest[colour]:.0f} counts in every dark frame"
            elif dead[colour]:
                cause = "dead: a photosite receives less than half of the light of its patch"
            elif uneven[colour] > 0:
                cause = f"uneven: rim and centre differ by {uneven[colour]:.1%} under white"
            elif colour in disturbed:
                cause = f"disturbed: {_disturbance(disturbed[colour])}"
            elif colour in light_by_colour:
                cause = f"unlike: only this patch differs from its code under illuminant {light_by_colour[colour]}"
            if cause:
                unfit_cells.append(Unfit(colour=colour, cause=cause))
        return tuple(unfit_cells)


def stored_names() -> list[str]:
    """Return the names of the fields in a checkpoint; a build resumes only from a checkpoint with the same names."""
    stored_types = (Accumulator, FrameMeasurements, DarkFrameFigures, DarkLight, DarkLightEstimate, HotPixels)
    return [f"{stored_type.__name__}.{field.name}" for stored_type in stored_types for field in fields(stored_type)]


def disturbed_cells(frames: Sequence[FrameMeasurements]) -> dict[int, list[tuple[int, float]]]:
    """Return the illuminants under which patches were covered, with the relative deviations, by colour index.

    White frames are excluded, because a LUT has no samples of them.
    """
    disturbances: dict[int, list[tuple[int, float]]] = {}
    for frame in frames:
        if frame.record.illumination is not None:
            for colour, deviation in frame.consistency.disturbed:
                disturbances.setdefault(colour, []).append((frame.record.illumination, deviation))
    return disturbances


def _disturbance(disturbances: list[tuple[int, float]]) -> str:
    light, deviation = max(disturbances, key=lambda disturbance: abs(disturbance[1]))
    others_text = f" and {len(disturbances) - 1} more" if len(disturbances) > 1 else ""
    difference = f"{abs(deviation):.1%} {'darker' if deviation < 0 else 'brighter'} than expected from its code"
    difference_text = difference if deviation else "too dark to be compared"
    return f"under illuminant {light}{others_text}: {difference_text}, next to patches with large deviations"


def _covered_cells(baseline: Baseline, registered: RegisteredFrame) -> npt.NDArray[np.bool_]:
    """Return the patches (C,) that do not match the chart, alone or together with their neighbours."""
    registration = registered.registration
    nearest = np.asarray(cKDTree(registration.blocks.centres_mm).query(baseline.points.cells_mm)[1])
    return registration.mismatched_cells[baseline.chart.cell_of_colour] | ~registration.blocks.good[nearest]


def _arrays_of(owner: Any) -> _Arrays:
    """Return the arrays and integers of a data class by field name; an empty dictionary for None."""
    values = {} if owner is None else {field.name: getattr(owner, field.name) for field in fields(owner)}
    return {name: np.asarray(value) for name, value in values.items() if isinstance(value, np.ndarray | int)}
