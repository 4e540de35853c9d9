"""A session becomes a table: registered once, then every light sampled in the order in which it was taken.

Laws that hold inside:

- A session that lacks a light makes no table.
- The table appears whole or not at all. Until then it grows under a hidden name (`calibration.pipeline.checkpoint`),
  and a build that was stopped, anywhere, goes on from its last checkpoint and ends in the bytes of one that was not:
  frames enter in the order taken, and what one adds depends on those before it alone.

Threads read, decode and measure frames ahead, each with what holds at that moment; what has changed by the time a frame
is taken in is measured again. The memory is that of a few frames whatever the session.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.framing.annotated import annotated_png
from acquisition.session.folder import FrameRecord, Session
from calibration.checks.labels import angles_off_codes_deg
from calibration.pipeline.checkpoint import Checkpoint, Growing, growing
from calibration.pipeline.frames import (
    Progress,
    ahead,
    best_frame,
    chosen_frames,
    decode,
    listed,
    pure_frames,
    session_sha256,
)
from calibration.pipeline.linearity import read_linearity
from calibration.pipeline.measuring import FrameFigures, Measured, MeasuredDark, Measurement
from calibration.pipeline.options import Choices
from calibration.pipeline.result import BuildResult, Growth
from calibration.pipeline.tally import Tally
from calibration.radiometry.dark_light import DarkLight
from calibration.radiometry.darkness import DarkFigures, additivity, drift_gains
from calibration.radiometry.greys import NAME as REFERENCES_FILE
from calibration.radiometry.greys import references_csv
from calibration.radiometry.paper import Field, corrections
from calibration.registration.movement import Shift
from calibration.table.lut import SAMPLES as SAMPLES_FILE
from calibration.table.lut import LutWriter, Provenance
from calibration.verdict.verdict import refusal, truth_errors_deg
from foundation.errors import FormatError, QualityError, RegistrationError, first_of
from foundation.files import write_whole
from foundation.version import software

REPORT_FILES = ("report.html", "report.json")

CHECKPOINT_EVERY = 16
"""Frames from one checkpoint to the next: what a build that is killed has to do again."""

METHOD = 5
"""Raised when samples or ground truth come out otherwise than before, so that no table is made by two methods."""

_SAME_EXPOSURE = 1.01

PLAIN = Choices()
"""The paper's way: 25 samples, nothing subtracted but black."""

_Array = npt.NDArray[np.float64]
_Report = Callable[[BuildResult, Session, Path], None]


def check(
    session: Session, choices: Choices = PLAIN, linearity: Path | None = None, picture: Path | None = None
) -> BuildResult:
    """Register a session's best frame and judge it; write nothing but a picture.

    Parameters
    ----------
    session
        The session.
    choices
        How the table would be made; a window that is too large is told.
    linearity
        A folder of exposures that tell the sensor's linearity; `calibration.pipeline.linearity.read_linearity`.
    picture
        Where to draw what was found on the frame, or looked for, PNG; None for nowhere.

    Raises
    ------
    FormatError
        No frame can be used, two lights have the same file, or the file is not what the journal says.
    RegistrationError
        The chart is not found, or not the one expected.
    QualityError
        The white references cannot be used.
    """
    _require_darks(session, choices)
    _, missing = chosen_frames(session)
    best = best_frame(session)
    decoded = decode(session, best)
    try:
        work = Measurement(session.chart, decoded, choices.window, choices.corners)
    except RegistrationError as error:
        if picture is None:
            raise RegistrationError(f"{error}; see what is there with --picture PNG") from error
        write_whole(picture, annotated_png(decoded.mosaic, session.chart, None))
        raise RegistrationError(f"{error}; see {picture}") from error
    if picture is not None:
        write_whole(picture, annotated_png(decoded.mosaic, session.chart, work.first.registration.framing))
    tally = Tally(session.chart, choices.samples, work.first)
    measured = work.measure_first(decoded, work.first, Shift(0.0, 0.0, 0.0, 0), even=True)
    tally.add(measured)
    dark = next((record for record in session.frames() if record.kind == "dark" and record.accepted), None)
    if dark is not None:
        tally.add_dark(work.measure_dark(decode(session, dark), work.first))
    figures = measured.figures
    stains = tally.stains(figures.paper.field)
    return BuildResult(
        session=session.folder,
        lut=None,
        camera=decoded.mosaic.camera,
        registration=work.first.registration,
        registered_file=best.file,
        lights=len(session.illuminations) - len(missing),
        white=figures.paper.white[None],
        white_error=figures.paper.error[None],
        white_level=round(decoded.saturation - float(decoded.black.mean())),
        unfit=tally.unfit(decoded.saturation, stains),
        stains=stains,
        frames=(figures,),
        grey_names=work.levels.names,
        greys=figures.greys[None],
        grey_errors=figures.grey_errors[None],
        darkness=tally.darkness,
        transfer=work.transfer,
        saturated=tally.saturated(decoded.saturation),
        noise=tally.noise(),
        white_references=len(session.chart.white_references),
        window=choices.window,
        linearity=None if linearity is None else read_linearity(linearity, work),
    )


def build(
    session: Session,
    out: Path,
    progress: Progress | None = None,
    report: _Report | None = None,
    choices: Choices = PLAIN,
    linearity: Path | None = None,
) -> BuildResult:
    """Build the table of a session.

    Parameters
    ----------
    session
        A finished session: an accepted frame for every light.
    out
        The table's folder; must be free.
    progress
        Told after every frame.
    report
        Writes the report into the table's folder before it gets its name; `calibration.report.report.write_report`.
    choices
        How the table is made.
    linearity
        A folder of exposures that tell the sensor's linearity; read before the frames, told in the report.

    Raises
    ------
    FormatError
        A light has no accepted frame, dark frames are lacking that are to be subtracted, or a frame's file is missing
        or not what the journal says.
    RegistrationError
        The chart is not found, or not the one expected.
    QualityError
        The white references cannot be used, or the verdict on the table is to refuse it; its report is then in
        `refused_folder(out)`.
    InputError
        `out` is taken.
    StorageError
        The disk is full or read-only.
    """
    chosen, missing = chosen_frames(session)
    if missing:
        raise FormatError(
            f"{session.folder}: {len(missing)} of {len(session.illuminations)} lights have no accepted frame: "
            f"{first_of(missing)}; finish the session with acquire run, then build the table; or let it grow with "
            "build-lut --append"
        )
    _require_darks(session, choices)
    with growing(out) as making:
        work = _Work(session, making, chosen, progress or _silent, choices, linearity)
        work.take_in()
        return work.finish(out, report)


def append(
    session: Session,
    out: Path,
    progress: Progress | None = None,
    report: _Report | None = None,
    choices: Choices = PLAIN,
    linearity: Path | None = None,
) -> BuildResult | Growth:
    """Let the table of a session that is being taken grow by the frames that have come.

    It grows under a hidden name and appears when the plan's last frame has been taken in, the same to the byte as if
    it had been built at once. Parameters and errors are those of `build`, but that lights may lack.
    """
    chosen, missing = chosen_frames(session)
    # The plan of a session that was put together otherwise may be empty; its lights are the plan then.
    complete = not missing and {step.number for step in session.steps} <= session.done_steps()
    _require_darks(session, choices)
    with growing(out) as making:
        work = _Work(session, making, chosen, progress or _silent, choices, linearity)
        before = work.taken_in
        if complete:
            work.take_in()
            return work.finish(out, report)
        if before < len(chosen):
            work.take_in()
            work.save()
        return Growth(
            len(session.illuminations) - len(missing), len(session.illuminations), len(chosen) - before, len(chosen)
        )


class _Work:
    """One table being made: what was taken in before, and what is to follow."""

    def __init__(
        self,
        session: Session,
        making: Growing,
        chosen: Sequence[FrameRecord],
        told: Progress,
        choices: Choices,
        series: Path | None,
    ) -> None:
        self._session, self._making, self._chosen, self._told = session, making, chosen, told
        self._choices, self._series = choices, series
        self._best, self._pure = best_frame(session), pure_frames(session, chosen)
        self._keys = [f"{record.kind},{record.illumination},{record.sha256}" for record in chosen]
        self._identity = {
            "software": software(),
            "method": METHOD,
            "choices": choices.told(),
            "chart": session.chart.sha256,
            "lights": hashlib.sha256(repr(session.illuminations).encode()).hexdigest(),
            "registered": self._best.sha256,
            "primaries": [record.sha256 for record in self._pure],
        }
        self._before = self._usable(making.load())
        self._figures: list[FrameFigures | DarkFigures] = []

    @property
    def taken_in(self) -> int:
        """Frames that an earlier program, or this one, has taken in."""
        return max(len(self._figures), len(self._before.frames) if self._before else 0)

    def _usable(self, before: Checkpoint | None) -> Checkpoint | None:
        """Return a checkpoint if this work goes on from it."""
        if before is None or before.identity != self._identity or not before.frames:
            return None
        known = before.frames == self._keys[: len(before.frames)]
        return before if known and (self._making.folder / SAMPLES_FILE).is_file() else None

    def _open_writer(self) -> LutWriter:
        """Return the writer of the samples, in a folder that holds what the checkpoint tells and nothing else."""
        shape = len(self._session.illuminations), self._session.chart.colour_count, self._choices.samples
        if self._before is not None:
            written = {int(light): known for light, known in self._before.told["sha256"].items()}
            writer = LutWriter(self._making.folder, *shape, written=written)
            if not writer.damaged():
                return writer
            self._before = None
        self._making.begin_anew()
        return LutWriter(self._making.folder, *shape)

    def take_in(self) -> None:
        """Measure every frame that was not taken in before."""
        session, chart = self._session, self._session.chart
        self._writer = self._open_writer()
        self._told(0, len(self._chosen), "finding the chart")
        first = decode(session, self._best)
        self._camera = first.mosaic.camera
        primaries = (decode(session, record) for record in self._pure)
        self._measurement = Measurement(chart, first, self._choices.window, self._choices.corners, primaries)
        self._stretch = self._measurement.first
        self._tally = Tally(chart, self._choices.samples, self._stretch)
        self._limit = first.saturation
        self._linearity = None if self._series is None else read_linearity(self._series, self._measurement)
        self._subtraction = self._measurement.subtraction()
        self._dark: DarkLight | None = None
        # Held for no longer than it is needed: it is read again in its turn.
        del first
        if self._before is not None:
            self._recall(self._before)
        saved = len(self._figures)
        if self._choices.subtract_dark and self._dark is None:
            self._dark = self._first_dark()
        for record, early in ahead(self._measured, self._chosen[saved:], self._others_wait):
            self._take_in(record, early)
            if (len(self._figures) - saved) % CHECKPOINT_EVERY == 0:
                self.save()
            self._told(len(self._figures), len(self._chosen), record.file)

    def _recall(self, before: Checkpoint) -> None:
        """Go on where an earlier program stopped."""
        told = before.told
        self._limit = int(told["limit"])
        for record, figures in zip(self._chosen, told["figures"], strict=False):
            if record.kind == "dark":
                self._figures.append(DarkFigures.recall(record, figures))
            else:
                self._figures.append(FrameFigures.recall(record, self._session.chart.page_mm, figures))
        if told["stretch"] != self._stretch.file:
            adopted = next(record for record in self._chosen if record.file == told["stretch"])
            self._stretch = self._measurement.register(decode(self._session, adopted))
        self._tally.restore(before.arrays, self._darks)
        self._subtraction.restore(before.arrays)
        self._dark = self._subtraction.now

    def _first_dark(self) -> DarkLight:
        """Return what is subtracted from the frames before the first dark one: what that one tells."""
        record = next(record for record in self._chosen if record.kind == "dark")
        measured = self._measurement.measure_dark(decode(self._session, record), self._measurement.first)
        return self._measurement.learn(self._measurement.subtraction(), measured)

    def _others_wait(self, record: FrameRecord) -> bool:
        """Return whether those after a frame need what is learnt from it."""
        return self._choices.subtract_dark and record.kind == "dark"

    @property
    def _darks(self) -> list[DarkFigures]:
        return [figures for figures in self._figures if isinstance(figures, DarkFigures)]

    @property
    def _frames(self) -> list[FrameFigures]:
        return [figures for figures in self._figures if isinstance(figures, FrameFigures)]

    def _measured(self, record: FrameRecord) -> Measured | MeasuredDark | None:
        """Return what a frame says with what holds now; None where it has to be registered anew. Threads call this."""
        stretch, decoded = self._stretch, decode(self._session, record)
        if record.kind == "dark":
            return self._measurement.measure_dark(decoded, stretch)
        measured = self._measurement.measure(decoded, stretch, self._is_even(record), self._dark)
        return None if isinstance(measured, Shift) else measured

    def _is_even(self, record: FrameRecord) -> bool:
        """Return whether a frame tells of the evenness of cells: a white one, or the first of all."""
        return record.kind == "white" or record is next(r for r in self._chosen if r.kind != "dark")

    def _take_in(self, record: FrameRecord, early: Measured | MeasuredDark | None) -> None:
        """Take in the next frame, as measured early if what it was measured with still holds."""
        measured = early if early is not None and early.stretch is self._stretch else self._measured(record)
        if measured is None:
            decoded = decode(self._session, record)
            before = self._stretch
            self._stretch = self._measurement.register(decoded)
            shift = self._measurement.moved(before, self._stretch)
            self._subtraction.move()
            even = self._is_even(record)
            measured = self._measurement.measure_first(decoded, self._stretch, shift, even, self._dark)
        self._figures.append(measured.figures)
        if isinstance(measured, MeasuredDark):
            self._tally.add_dark(measured)
            if self._choices.subtract_dark:
                self._dark = self._measurement.learn(self._subtraction, measured)
            return
        self._tally.add(measured)
        self._limit = min(self._limit, measured.saturation)
        if record.kind == "light" and record.illumination is not None:
            self._writer.put(record.illumination, measured.values)

    def save(self) -> None:
        """Write a checkpoint: a later program goes on from here."""
        told = {
            "limit": self._limit,
            "stretch": self._stretch.file,
            "sha256": self._writer.sha256,
            "figures": [figures.told() for figures in self._figures],
        }
        taken_in = self._keys[: len(self._figures)]
        state = {**self._tally.state(), **self._subtraction.state()}
        self._making.save(Checkpoint(self._identity, taken_in, told, state))

    def finish(self, out: Path, report: _Report | None) -> BuildResult:
        """Judge the table and give it its name."""
        session, chart, lights = self._session, self._session.chart, self._session.illuminations
        frames, limit, work, tally = self._frames, self._limit, self._measurement, self._tally
        self._told(len(self._figures), len(self._figures), "writing the report")
        white, error = np.zeros((len(lights), 3)), np.zeros((len(lights), 3))
        fields: list[Field | None] = [None] * len(lights)
        blacks, subtracted, at_zero = np.zeros((len(lights), 2, 2)), np.zeros((len(lights), 3)), np.zeros(len(lights))
        greys, grey_errors = (np.full((len(lights), len(work.levels.names), 3), np.nan) for _ in range(2))
        for figures in frames:
            light = figures.record.illumination
            if figures.record.kind == "light" and light is not None:
                # A channel without light may be measured at or below 0; its standard error is what is known of it.
                white[light] = np.maximum(figures.paper.white, np.maximum(figures.paper.error, 1e-3))
                error[light] = figures.paper.error
                fields[light] = figures.paper.field
                blacks[light], subtracted[light], at_zero[light] = figures.black, figures.dark, figures.at_zero
                greys[light], grey_errors[light] = figures.greys, figures.grey_errors
        dark = tally.darkness
        gains, full_white = _drift(frames, len(lights))
        even = next((figures for figures in frames if self._is_even(figures.record)), frames[0])
        stains = tally.stains(even.paper.field)
        unfit = tally.unfit(limit, stains)
        level = round(limit - float(np.mean([figures.black.mean() for figures in frames])))
        result = BuildResult(
            session=session.folder,
            lut=out,
            camera=self._camera,
            registration=work.first.registration,
            registered_file=self._best.file,
            lights=len(lights),
            white=white,
            white_error=error,
            white_level=level,
            unfit=unfit,
            stains=stains,
            frames=tuple(frames),
            noise=tally.noise(),
            white_references=len(chart.white_references),
            grey_names=work.levels.names,
            greys=greys,
            grey_errors=grey_errors,
            darkness=dark,
            added=additivity(
                lights, white, full_white, np.zeros(3) if self._choices.subtract_dark else dark.light, gains
            ),
            gains=gains,
            transfer=work.transfer,
            saturated=tally.saturated(limit),
            window=self._choices.window,
            subtracted=subtracted if self._choices.subtract_dark else None,
            at_zero=at_zero,
            linearity=self._linearity,
            primaries=work.primaries,
            off_codes_deg=angles_off_codes_deg(lights, white / gains, truth_errors_deg(white, error))
            if _exposed_alike(frames)
            else None,
        )
        records = [figures.record for figures in self._figures]
        self._writer.finish(
            lights,
            white,
            Provenance(
                camera=self._camera,
                bits=chart.bits,
                white_level=level,
                corrections=corrections(
                    chart.page_mm,
                    blacks,
                    limit,
                    [shape for shape in fields if shape],
                    measured=result.saturated,
                    gains=None if full_white is None else gains,
                    subtracted=result.subtracted,
                    at_zero=at_zero,
                )
                + ([] if work.primaries is None else [work.primaries.correction(white)]),
                session_sha256=session_sha256(records),
                chart_sha256=chart.sha256,
                software=software(),
                unfit=list(unfit),
            ),
            listed(records),
            {REFERENCES_FILE: references_csv(work.levels.names, white, error, greys, grey_errors)}
            if work.levels.names
            else {},
        )
        folder = self._making.folder
        if report is not None:
            report(result, session, folder)
        if result.verdict.refused:
            self._making.discard()
        _require_good(result, out, folder)
        self._making.publish()
        return result


def _require_darks(session: Session, choices: Choices) -> None:
    """Refuse to subtract what no frame tells."""
    if choices.subtract_dark and not any(record.kind == "dark" and record.accepted for record in session.frames()):
        raise FormatError(
            f"{session.folder} has no accepted dark frame, and --subtract-dark takes the light to subtract from them; "
            "take the session with acquire run, which takes dark frames, or build the table without --subtract-dark"
        )


def _silent(done: int, total: int, what: str) -> None:
    """Tell nobody."""


def _drift(frames: Sequence[FrameFigures], lights: int) -> tuple[_Array, _Array | None]:
    """Return the lamp's drift at each light (L, 3), and paper in the first white frame, None without one."""
    whites = [figures for figures in frames if figures.record.kind == "white"]
    if not whites:
        return np.ones((lights, 3)), None
    start = whites[0].record.taken_at
    at = np.zeros(lights)
    for figures in frames:
        if figures.record.kind == "light" and figures.record.illumination is not None:
            at[figures.record.illumination] = (figures.record.taken_at - start).total_seconds()
    white_at = np.array([(figures.record.taken_at - start).total_seconds() for figures in whites])
    return drift_gains(at, white_at, np.array([figures.paper.white for figures in whites])), whites[0].paper.white


def _exposed_alike(frames: Sequence[FrameFigures]) -> bool:
    """Return whether all lights are known to have been exposed alike: what they are to one another is their codes'."""
    exposures = [figures.exposure for figures in frames if figures.record.kind == "light"]
    return min(exposures) > 0 and max(exposures) < _SAME_EXPOSURE * min(exposures)


def _require_good(result: BuildResult, out: Path, folder: Path) -> None:
    """Refuse a table that is not good enough; its report is kept beside the place where the table would be."""
    verdict = result.verdict
    if not verdict.refused:
        return
    refused = refused_folder(out)
    kept = [name for name in REPORT_FILES if (folder / name).exists()]
    for name in kept:
        write_whole(refused / name, (folder / name).read_bytes())
    where = f"; see {refused / kept[0]}" if kept else ""
    raise QualityError(f"{result.session}: no table is made. {refusal(verdict, result)}{where}")


def refused_folder(out: Path) -> Path:
    """Return where the report of a refused table goes: `LUT.refused` beside `LUT`."""
    return out.with_name(f"{out.name}.refused")
