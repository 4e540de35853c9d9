"""Take in frames, one after another, in the order taken; what is known after each is one frozen value.

Rules that hold inside:

- What a frame adds depends on those before it alone, so that a build that was stopped goes on to the same bits.
- A frame measured before its turn counts only if the frame registered last is still the one it was measured with.
- The dark light of a frame is that of the last dark frame before it, or of the first, for frames before that.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.measurements import FrameMeasurements
from calibration.pipeline.baseline import Baseline
from calibration.pipeline.cell_statistics import CellStatistics
from calibration.pipeline.frames import SelectedFrames, decode_frame
from calibration.pipeline.measuring import (
    MeasuredDarkFrame,
    MeasuredFrame,
    measure_frame,
    measure_registered_frame,
    movement_of,
    sample_dark_frame,
)
from calibration.pipeline.registered_frame import RegisteredFrame
from calibration.radiometry.dark_frames import DarkFrameFigures
from calibration.radiometry.dark_subtraction import DarkLight, DarkLightEstimator
from experiment.framing.movement import Shift
from experiment.session.folder import Session
from experiment.session.records import FrameRecord

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

    figures: tuple[FrameMeasurements | DarkFrameFigures, ...]
    statistics: CellStatistics
    saturation: int
    registered: RegisteredFrame
    estimator: DarkLightEstimator
    dark: DarkLight | None

    @cached_property
    def frames(self) -> tuple[FrameMeasurements, ...]:
        """Figures of the light and white frames."""
        return tuple(figures for figures in self.figures if isinstance(figures, FrameMeasurements))

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
            else FrameMeasurements.from_json(record, page_mm, figures)
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
