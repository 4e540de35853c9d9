"""A session becomes a table, in a straight line of stages; each takes a value and returns the next one.

The stages, their functions and their values::

    frames         frames.select_frames          SelectedFrames
    shared by all  baseline.baseline_of          Baseline, made once before the first frame
    decoded        measuring.decode_frame        DecodedFrame
    located        measuring.locate              LocatedFrame
    sampled        measuring.sample              SampledFrame
    measured       measuring.measure             MeasuredFrame
    collected      Accumulator.with_frame        Accumulator
    figures        table_figures.table_figures   TableMeasurements
    verdict        calibration.verdict.judge     Verdict
    table          _write_table                  the folder

Threads take frames from decoded to measured before their turn, with what is collected at that moment (`_measured`); a
frame counts only if the frame registered last is still the same, and is measured again otherwise. The memory is that of
a few frames whatever the session.

The table appears whole or not at all. Until then it stands beside its place under a hidden name, and a build that was
stopped, anywhere, goes on from its last checkpoint and ends in the bytes of one that was not. A checkpoint is a record
and its file of arrays (`checkpoint`): the accumulator, and the hashes of the samples on the disk. It is used only if it
was made of what is asked for now and the samples have these hashes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import Figure
from calibration.measurements import LinearityMeasurements, TableMeasurements
from calibration.pipeline.baseline import baseline_of
from calibration.pipeline.checkpoint import Checkpoint, UnfinishedTable, unfinished_table
from calibration.pipeline.collecting import Accumulator, stored_names
from calibration.pipeline.frames import (
    PAPER_OPTIONS,
    BuildOptions,
    ReportProgress,
    SelectedFrames,
    select_frames,
    source_frames,
)
from calibration.pipeline.measuring import (
    IN_PLACE,
    ChangedFrame,
    DecodedFrame,
    LocatedFrame,
    MeasuredDarkFrame,
    MeasuredFrame,
    decode_frame,
    locate,
    measure,
    measure_dark,
    sample,
)
from calibration.pipeline.table_figures import check_figures, read_linearity, table_figures
from calibration.radiometry.drift import LEAST_WHITES, applied_drift, corrected, corrections
from calibration.table.lut import (
    CELLS,
    REFERENCES,
    REPORT_FORMAT,
    REPORT_JSON,
    REPORT_PAGE,
    REPORT_VERSION,
    UNCERTAINTY,
    Provenance,
    frames_sha256,
)
from calibration.table.writing import LutWriter, references_csv
from calibration.verdict import COMMAND, BuildResult, judge, judged_values, refusal, retake_json
from experiment.framing.finding import annotated_png
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.compiled import processor_count
from foundation.errors import CropError, FormatError, QualityError, RegistrationError, counted, first_few
from foundation.files import write_atomic
from foundation.folders import clear_folder
from foundation.records import to_plain
from foundation.version import software

CHECKPOINT_EVERY = 16  # Frames from one checkpoint to the next: what a build that is killed has to do again

# Raised when samples, ground truth or unfit cells come out otherwise, so that no table is made by two methods.
METHOD = 17

MOST_THREADS = 8  # Each thread holds a raw file and its counts, 110 MB for a 6D Mark II: more would not stay below 2 GB

_Result = TypeVar("_Result")

# A frame as measured before its turn; None where the chart has to be registered again in it.
EarlyMeasurement = MeasuredFrame | MeasuredDarkFrame | None

# Writes the report of a result and its session into a folder; `calibration.report.report.write_report`.
WriteReport = Callable[[BuildResult, Session, Path], None]


@dataclass(frozen=True)
class TableProgress:
    """How far a table has come that still lacks frames; `new_frames` of them were taken in now."""

    lights: int
    lights_planned: int
    new_frames: int
    frames: int


def build(
    session: Session,
    out: Path,
    progress: ReportProgress | None = None,
    report: WriteReport | None = None,
    options: BuildOptions = PAPER_OPTIONS,
    linearity: Path | None = None,
    judged_by: Sequence[Figure] = FIGURES,
) -> BuildResult:
    """Build the table of a session, whole or not at all, and return it with its figures.

    `out`: the table's folder, which must not be there. `progress`: told frames done, frames in all, and what is done.
    `report`: writes a report into the folder before it gets its name. `linearity`: a measurement of the sensor to
    correct by. `judged_by`: the figures of the verdict. Raises FormatError where frames, or the linearity, cannot make
    a table, InputError where the folder may not be written.
    """
    selected = select_frames(session)
    if selected.lights_without:
        raise FormatError(
            f"{session.folder}: {len(selected.lights_without)} of {len(session.illuminations)} lights have no accepted "
            f"frame: {first_few(selected.lights_without)}; finish the session with acquire run, then build the table; "
            "or take in what there is with build-lut --append"
        )
    _require_dark_frames(session, options)
    _require_white_frames(selected, session, options)
    show = progress or _no_progress
    with unfinished_table(out) as unfinished:
        done, writer, series = _take_in_all(session, selected, options, linearity, unfinished, show)
        show(len(done.figures), len(done.figures), "writing the report")
        figures = table_figures(done, series)
        result = BuildResult(figures, judge(judged_values(figures), judged_by), out)
        if figures.lights.drift is not None and not result.verdict.refused:
            # A build that is killed meanwhile finds other samples than its checkpoint names, and begins anew.
            for light, gain in enumerate(figures.lights.drift.gains):
                writer.put(light, corrected(writer.get(light), gain))
        # The table lists the hashes of its report.
        if report is not None:
            report(result, session, unfinished.folder)
        _write_table(done, figures, writer)
        if result.verdict.refused:
            unfinished.keep = False
            raise _refused(result, out, unfinished.folder)
        unfinished.publish()
        return result


def append(
    session: Session,
    out: Path,
    progress: ReportProgress | None = None,
    report: WriteReport | None = None,
    options: BuildOptions = PAPER_OPTIONS,
    linearity: Path | None = None,
    judged_by: Sequence[Figure] = FIGURES,
) -> BuildResult | TableProgress:
    """Take in the frames that have come so far of a session that is being taken.

    The table is made under a hidden name and appears when the plan's last frame has been taken in, the same to the byte
    as if it had been built at once. Parameters and errors are those of `build`, except that lights may be missing.
    """
    selected = select_frames(session)
    # The plan of a session that was put together otherwise may be empty; its lights are the plan then.
    if not selected.lights_without and {step.number for step in session.steps} <= session.done_steps():
        return build(session, out, progress, report, options, linearity, judged_by)
    _require_dark_frames(session, options)
    with unfinished_table(out) as unfinished:
        stored = unfinished.load(_identity(session, selected, options), _frame_keys(selected))
        frames, before = len(selected.records), 0 if stored is None else len(stored.frames)
        if before < frames:
            show = progress or _no_progress
            done, writer, _ = _take_in_all(session, selected, options, linearity, unfinished, show)
            unfinished.save(_checkpoint(done, writer))
        lights = len(session.illuminations)
        return TableProgress(lights - len(selected.lights_without), lights, frames - before, frames)


def check(
    session: Session,
    options: BuildOptions = PAPER_OPTIONS,
    linearity: Path | None = None,
    picture: Path | None = None,
    judged_by: Sequence[Figure] = FIGURES,
) -> BuildResult:
    """Register a session's best frame and judge it; write nothing but a picture.

    `picture`: where to draw what was found on the frame, or looked for, PNG; None for nowhere.
    """
    _require_dark_frames(session, options)
    selected = select_frames(session)
    first = decode_frame(session, selected.registered)
    try:
        baseline = baseline_of(session.chart, first, replace(options, subtract_dark=False))
    except RegistrationError as error:
        if picture is None:
            raise RegistrationError(f"{error}; see what is there with --picture PNG") from error
        write_atomic(picture, annotated_png(first.mosaic, session.chart, None))
        raise RegistrationError(f"{error}; see {picture}") from error
    if picture is not None:
        write_atomic(picture, annotated_png(first.mosaic, session.chart, baseline.first.registration.framing))
    located = LocatedFrame(first, baseline.first, baseline.first, IN_PLACE, reregistered=False)
    done = Accumulator.empty(session, selected, baseline, first.saturation)
    done = done.with_frame(measure(baseline, sample(baseline, located, dark=None, keep_samples=True)))
    dark = selected.first_dark
    if dark is not None:
        done = done.with_frame(measure_dark(baseline, decode_frame(session, dark), baseline.first))
    series = None if linearity is None else read_linearity(linearity, baseline)
    figures = check_figures(done, series)
    return BuildResult(figures, judge(judged_values(figures), judged_by), None)


def judge_trial(
    session: Session, saturation: int, options: BuildOptions = PAPER_OPTIONS, linearity: Path | None = None
) -> BuildResult:
    """Judge a few trial frames as those of a whole session; write nothing.

    The lens is not measured, which takes a minute; nor are the figures that rest on it.

    `saturation`: the raw count at which the sensor saturates. `linearity`: a folder with a series of exposures.
    """
    selected = select_frames(session)
    first = decode_frame(session, selected.registered)
    primaries = [decode_frame(session, record) for record in selected.primaries]
    baseline = baseline_of(session.chart, first, options, primaries, measures_lens=False)
    series = None if linearity is None else read_linearity(linearity, baseline)
    empty = Accumulator.empty(session, selected, baseline, min(saturation, first.saturation))
    done, _ = deque(_collected(empty, selected.records), maxlen=1).pop()
    figures = table_figures(done, series)
    return BuildResult(figures, judge(judged_values(figures), FIGURES), None)


def _take_in_all(
    session: Session,
    selected: SelectedFrames,
    options: BuildOptions,
    linearity: Path | None,
    unfinished: UnfinishedTable,
    progress: ReportProgress,
) -> tuple[Accumulator, LutWriter, LinearityMeasurements | None]:
    """Return what all frames give, after taking in those that an earlier program has not, with their samples written.

    With them what a series of exposures shows, which is read first: it may be none.
    """
    records = selected.records
    stored = unfinished.load(_identity(session, selected, options), _frame_keys(selected))
    writer, stored = _writer(session, options, unfinished, stored)
    progress(0, len(records), "finding the chart")
    done = _begin(session, selected, options)
    series = None if linearity is None else read_linearity(linearity, done.baseline)
    if stored is not None:
        done = done.restored(stored.values, stored.arrays)
    before = len(done.figures)
    try:
        for collected, frame in _collected(done, records[before:]):
            done = collected
            record = records[len(done.figures) - 1]
            if isinstance(frame, MeasuredFrame) and record.kind == "light" and record.illumination is not None:
                writer.put(record.illumination, frame.values)
            if (len(done.figures) - before) % CHECKPOINT_EVERY == 0:
                unfinished.save(_checkpoint(done, writer))
            progress(len(done.figures), len(records), record.file)
    except ChangedFrame:
        raise
    except (FormatError, QualityError) as error:
        raise _stopped_by(error, records[len(done.figures)], done, unfinished.out) from error
    return done, writer, series


def _collected(
    done: Accumulator, records: Sequence[FrameRecord]
) -> Generator[tuple[Accumulator, MeasuredFrame | MeasuredDarkFrame]]:
    """Yield what is collected after each frame, and that frame as measured; threads measure those that follow."""

    def measure_early(record: FrameRecord) -> EarlyMeasurement:
        # In a thread, with what is collected at that moment.
        return _measured(done, record, register_again=False)

    def others_wait_for(record: FrameRecord) -> bool:
        return done.baseline.options.subtract_dark and record.kind == "dark"

    for record, early in prefetched(measure_early, records, others_wait_for):
        frame = early
        if frame is None or frame.registered is not done.registered:
            frame = _measured(done, record, register_again=True)
            assert frame is not None
        done = done.with_frame(frame)
        yield done, frame


def _measured(done: Accumulator, record: FrameRecord, register_again: bool) -> EarlyMeasurement:
    """Return what a frame shows beside those taken in: from its file to its figures. Thread-safe.

    None where the chart has to be registered again and `register_again` is False.
    """
    baseline = done.baseline
    decoded = decode_frame(done.session, record)
    if record.kind == "dark":
        return measure_dark(baseline, decoded, done.registered)
    located = locate(baseline, decoded, done.registered, register_again)
    if located is None:
        return None
    return measure(baseline, sample(baseline, located, done.dark, keep_samples=done.selected.is_even(record)))


def _begin(session: Session, selected: SelectedFrames, options: BuildOptions) -> Accumulator:
    """Return what there is before any frame: what all frames share, and the dark light of the first dark frame."""
    first = decode_frame(session, selected.registered)
    primaries = [decode_frame(session, record) for record in selected.primaries]
    more_whites = _whole_frames(session, selected.more_whites)
    baseline = baseline_of(session.chart, first, options, primaries, more_whites)
    # The counts of these frames are not held any longer: they are read again in their turn.
    dark = selected.first_dark if options.subtract_dark else None
    measured_dark = None if dark is None else measure_dark(baseline, decode_frame(session, dark), baseline.first)
    return Accumulator.empty(session, selected, baseline, first.saturation, measured_dark)


def _whole_frames(session: Session, records: Sequence[FrameRecord]) -> Iterator[DecodedFrame]:
    """Yield frames; what is wrong with one is said when its turn comes."""
    for record in records:
        with contextlib.suppress(CropError):
            yield decode_frame(session, record)


def _stopped_by(
    error: FormatError | QualityError, record: FrameRecord, done: Accumulator, out: Path
) -> FormatError | QualityError:
    """Return why the build ends at a frame, after naming it in a report that `acquire run --retake bad` reads."""
    says = {"format": REPORT_FORMAT, "version": REPORT_VERSION, "verdict": "refuse", "reason": str(error)}
    says |= {"session": done.session.folder.name, **retake_json((record,), record.sha256, done.selected.newest.sha256)}
    write_atomic(refused_folder(out) / REPORT_JSON, json.dumps(says, indent=2) + "\n")
    return type(error)(f"{error}; or take {record.file} again: {COMMAND}")


def prefetched(
    work: Callable[[FrameRecord], _Result],
    records: Sequence[FrameRecord],
    others_wait_for: Callable[[FrameRecord], bool],
) -> Generator[tuple[FrameRecord, _Result]]:
    """Yield each frame with what `work` returned for it, in order, while threads work on those that follow."""
    count = thread_count()
    with ThreadPoolExecutor(count) as pool:
        begun: deque[tuple[FrameRecord, Future[_Result]]] = deque()
        todo = deque(records)
        try:
            while todo or begun:
                while todo and len(begun) <= count and not any(others_wait_for(record) for record, _ in begun):
                    record = todo.popleft()
                    begun.append((record, pool.submit(work, record)))
                record, future = begun[0]
                result = future.result()
                yield record, result
                begun.popleft()
        finally:
            for _, future in begun:
                future.cancel()


def _write_table(done: Accumulator, figures: TableMeasurements, writer: LutWriter) -> None:
    session, records, lights, greys = done.session, done.records, figures.lights, figures.greys
    by_light = {frame.record.illumination: frame for frame in figures.frames if frame.record.kind == "light"}
    frames = [by_light[light.index] for light in session.illuminations]
    applied = corrections(
        session.chart.page_mm,
        np.array([frame.black for frame in frames]),
        figures.sensor.saturation_counts,
        [frame.paper.field for frame in frames],
        saturation_from="frames" if figures.sensor.saturation_measured else "raw files",
        gains=lights.gains if figures.white_frames and lights.drift is None else None,
        subtracted=lights.subtracted,
        at_zero=lights.share_at_zero,
    )
    if figures.primaries is not None:
        applied.append(figures.primaries.correction(lights.white))
    lens = done.baseline.lens
    if lens is not None and figures.lens.corrected:
        applied.append(lens.correction())
    gain = np.ones(lights.white.shape)
    if lights.drift is not None:
        gain = lights.drift.gains
        applied.append(applied_drift(gain))
    provenance = Provenance(
        camera=done.baseline.camera,
        bits=session.chart.bits,
        white_level=figures.sensor.white_level,
        corrections=applied,
        session_sha256=frames_sha256(source_frames(records)),
        chart_sha256=session.chart.sha256,
        software=software(),
        unfit=list(figures.cells.unfit),
        origin=figures.origin,
    )
    per_light = gain[:, None]
    references = references_csv(
        greys.names, lights.white / gain, lights.white_error / gain, greys.values / per_light, greys.errors / per_light
    )
    files = {UNCERTAINTY: figures.budget.lights_csv(), CELLS: figures.budget.cells_csv()}
    if greys.names:
        files[REFERENCES] = references
    writer.finish(session.illuminations, lights.white / gain, provenance, source_frames(records), files)


def _refused(result: BuildResult, out: Path, folder: Path) -> QualityError:
    """Return why there is no table; its report is kept beside the place where the table would be."""
    refused = refused_folder(out)
    kept = [name for name in (REPORT_PAGE, REPORT_JSON) if (folder / name).exists()]
    for name in kept:
        write_atomic(refused / name, (folder / name).read_bytes())
    where = f"; see {refused / kept[0]}" if kept else ""
    figures = result.figures
    return QualityError(
        f"{figures.session.folder}: no table is made. {refusal(result.verdict, figures, reported=bool(kept))}{where}"
    )


def refused_folder(out: Path) -> Path:
    """Return where the report of a refused table goes: `LUT.refused` beside `LUT`."""
    return out.with_name(f"{out.name}.refused")


def _require_dark_frames(session: Session, options: BuildOptions) -> None:
    if options.subtract_dark and not any(record.kind == "dark" and record.accepted for record in session.frames()):
        raise FormatError(
            f"{session.folder} has no accepted dark frame, and --subtract-dark takes the light to subtract from them; "
            "take the session with acquire run, which takes dark frames, or build the table without --subtract-dark"
        )


def _require_white_frames(selected: SelectedFrames, session: Session, options: BuildOptions) -> None:
    count = sum(record.kind == "white" for record in selected.records)
    if options.correct_drift and count < LEAST_WHITES:
        raise FormatError(
            f"{session.folder} has {counted(count, 'accepted white frame')}, and --correct-drift takes the lamp's "
            f"drift from {LEAST_WHITES} or more; take the session with acquire run, which takes one every "
            "sequence.reference_every lights, or build the table without --correct-drift"
        )


def _no_progress(done: int, total: int, what: str) -> None:
    """Show nothing."""


def thread_count() -> int:
    """Return how many frames are read and measured at a time: one a processor, as far as memory allows."""
    return min(processor_count(), MOST_THREADS)


def _identity(session: Session, selected: SelectedFrames, options: BuildOptions) -> dict[str, Any]:
    return {
        "software": software(),
        "method": METHOD,
        "stored": stored_names(),
        # The drift is taken out of the finished samples.
        "options": to_plain(replace(options, correct_drift=False)),
        "chart": session.chart.sha256,
        "lights": hashlib.sha256(repr(session.illuminations).encode()).hexdigest(),
        "registered": selected.registered.sha256,
        "primaries": [record.sha256 for record in selected.primaries],
        "more_whites": [record.sha256 for record in selected.more_whites],
    }


def _frame_keys(selected: SelectedFrames) -> list[str]:
    return [f"{record.kind},{record.illumination},{record.sha256}" for record in selected.records]


def _checkpoint(done: Accumulator, writer: LutWriter) -> Checkpoint:
    identity = _identity(done.session, done.selected, done.baseline.options)
    frames = _frame_keys(done.selected)[: len(done.figures)]
    return Checkpoint(identity, frames, done.to_json() | {"sha256": writer.sha256}, done.to_arrays())


def _writer(
    session: Session, options: BuildOptions, unfinished: UnfinishedTable, stored: Checkpoint | None
) -> tuple[LutWriter, Checkpoint | None]:
    """Return the writer of the samples, and the checkpoint if the samples on the disk are those that it names."""
    shape = len(session.illuminations), session.chart.colour_count, options.samples
    if stored is not None:
        written = {int(light): sha256 for light, sha256 in stored.values["sha256"].items()}
        writer = LutWriter(unfinished.folder, *shape, written=written)
        if not writer.damaged():
            return writer, stored
    clear_folder(unfinished.folder)
    return LutWriter(unfinished.folder, *shape), None
