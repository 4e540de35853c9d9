"""Build a look-up table (LUT) from a session in stages; the result of each stage is the input of the next.

Stage, function and result::

    frames         frames.select_frames          SelectedFrames
    all frames     baseline.baseline_of          Baseline, measured once before the first frame
    decoded        measuring.decode_frame        DecodedFrame
    located        measuring.locate              LocatedFrame
    sampled        measuring.sample              SampledFrame
    measured       measuring.measure             MeasuredFrame
    accumulated    Accumulator.with_frame        Accumulator
    figures        table_figures.table_figures   TableMeasurements
    verdict        calibration.verdict.judge     Verdict
    LUT            _write_table                  the folder

Threads decode and measure the next frames in advance with the current `Accumulator`. If the chart is registered again
in the meantime, these frames are measured again. Only a few frames are in memory at a time.

The LUT appears completely or not at all. Until it is complete, it is a hidden folder next to its final path. An
interrupted build resumes from its last checkpoint (`checkpoint`) with an identical result. A checkpoint is used only if
its inputs and options are unchanged and the samples on disk have the recorded hashes.
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

CHECKPOINT_EVERY = 16  # Number of frames between checkpoints; after a kill, at most this number is measured again

# Version of the method. It is increased if samples, ground truth or unfit patches change, so that no LUT mixes methods.
METHOD = 17

MAX_THREADS = 8  # A thread needs 110 MB for a raw file and its counts (6D Mark II); the limit is 2 GB in total

_Result = TypeVar("_Result")

# A frame measured in advance; None if the chart must be registered again in it.
EarlyMeasurement = MeasuredFrame | MeasuredDarkFrame | None

# Writes the report of a result and its session into a folder: `calibration.report.report.write_report`.
WriteReport = Callable[[BuildResult, Session, Path], None]


@dataclass(frozen=True)
class TableProgress:
    """Progress of a LUT of a session that is not complete."""

    lights: int  # Illuminants with a frame
    lights_planned: int
    new_frames: int  # Frames added by this call
    frames: int  # All frames added so far


def build(
    session: Session,
    out: Path,
    progress: ReportProgress | None = None,
    report: WriteReport | None = None,
    options: BuildOptions = PAPER_OPTIONS,
    linearity: Path | None = None,
    judged_by: Sequence[Figure] = FIGURES,
) -> BuildResult:
    """Build the LUT of a session, completely or not at all, and judge it.

    Parameters
    ----------
    session : Session
        Complete session.
    out : Path
        Folder of the LUT; it must not exist.
    progress : ReportProgress, optional
        Called with the number of finished frames, the number of all frames, and the current step.
    report : WriteReport, optional
        Writes a report into the folder before it gets its final name.
    options : BuildOptions
        Samples and corrections.
    linearity : Path, optional
        Folder with a series of exposures, to measure the sensor's linearity.
    judged_by : Sequence[Figure]
        Figures of the verdict.

    Raises
    ------
    FormatError
        If the frames or the series of exposures cannot be used.
    QualityError
        If the LUT is refused.
    InputError
        If the folder cannot be written.
    """
    selected = select_frames(session)
    if selected.missing_lights:
        raise FormatError(
            f"{session.folder}: {len(selected.missing_lights)} of {len(session.illuminations)} illuminants have no "
            f"accepted frame, expected one each: {first_few(selected.missing_lights)}; complete the session with "
            "acquire run, or add the available frames with build-lut --append"
        )
    _require_dark_frames(session, options)
    _require_white_frames(selected, session, options)
    show = progress or _no_progress
    with unfinished_table(out) as unfinished:
        accumulator, writer, series = _accumulate_all(session, selected, options, linearity, unfinished, show)
        show(len(accumulator.figures), len(accumulator.figures), "writing the report")
        figures = table_figures(accumulator, series)
        result = BuildResult(figures, judge(judged_values(figures), judged_by), out)
        if figures.lights.drift is not None and not result.verdict.refused:
            # If the build is killed here, the samples differ from the checkpoint. The next build measures all frames.
            for light, gain in enumerate(figures.lights.drift.gains):
                writer.put(light, corrected(writer.get(light), gain))
        # The LUT lists the hashes of its report, so the report is written first.
        if report is not None:
            report(result, session, unfinished.folder)
        _write_table(accumulator, figures, writer)
        if result.verdict.refused:
            unfinished.keep = False
            raise _refusal_error(result, out, unfinished.folder)
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
    """Add the available frames of a session in progress.

    The LUT is built under a hidden name. It gets its name after the last frame; its bytes are the same as from `build`.
    Parameters and errors as for `build`, except that illuminants may be missing.
    """
    selected = select_frames(session)
    # An imported session may have an empty plan. It is complete if all illuminants have a frame.
    if not selected.missing_lights and {step.number for step in session.steps} <= session.done_steps():
        return build(session, out, progress, report, options, linearity, judged_by)
    _require_dark_frames(session, options)
    with unfinished_table(out) as unfinished:
        checkpoint = unfinished.load(_identity(session, selected, options), _frame_keys(selected))
        frames, previous_count = len(selected.records), 0 if checkpoint is None else len(checkpoint.frames)
        if previous_count < frames:
            report_progress = progress or _no_progress
            accumulator, writer, _ = _accumulate_all(session, selected, options, linearity, unfinished, report_progress)
            unfinished.save(_checkpoint(accumulator, writer))
        lights = len(session.illuminations)
        return TableProgress(lights - len(selected.missing_lights), lights, frames - previous_count, frames)


def check(
    session: Session,
    options: BuildOptions = PAPER_OPTIONS,
    linearity: Path | None = None,
    picture: Path | None = None,
    judged_by: Sequence[Figure] = FIGURES,
) -> BuildResult:
    """Register the chart in the first white frame, or in the frame closest to white, and judge this frame.

    `picture`: PNG path for the frame with the outline of the chart, or with the detected tags if it is not found; None
    for no picture. Nothing else is written.
    """
    _require_dark_frames(session, options)
    selected = select_frames(session)
    first = decode_frame(session, selected.registered)
    try:
        baseline = baseline_of(session.chart, first, replace(options, subtract_dark=False))
    except RegistrationError as error:
        if picture is None:
            raise RegistrationError(f"{error}; use --picture PNG to save the frame") from error
        write_atomic(picture, annotated_png(first.mosaic, session.chart, None))
        raise RegistrationError(f"{error}; see {picture}") from error
    if picture is not None:
        write_atomic(picture, annotated_png(first.mosaic, session.chart, baseline.first.registration.framing))
    located = LocatedFrame(first, baseline.first, baseline.first, IN_PLACE, reregistered=False)
    accumulator = Accumulator.empty(session, selected, baseline, first.saturation)
    accumulator = accumulator.with_frame(measure(baseline, sample(baseline, located, dark=None, keep_samples=True)))
    dark = selected.first_dark
    if dark is not None:
        accumulator = accumulator.with_frame(measure_dark(baseline, decode_frame(session, dark), baseline.first))
    series = None if linearity is None else read_linearity(linearity, baseline)
    figures = check_figures(accumulator, series)
    return BuildResult(figures, judge(judged_values(figures), judged_by), None)


def judge_trial(
    session: Session, saturation: int, options: BuildOptions = PAPER_OPTIONS, linearity: Path | None = None
) -> BuildResult:
    """Judge a few trial frames like a complete session; nothing is written.

    Light spread by the lens is not measured, because this takes a minute. Figures that depend on it are not judged.

    `saturation`: raw count of saturation. `linearity`: folder with a series of exposures.
    """
    selected = select_frames(session)
    first = decode_frame(session, selected.registered)
    primaries = [decode_frame(session, record) for record in selected.primaries]
    baseline = baseline_of(session.chart, first, options, primaries, measures_lens=False)
    series = None if linearity is None else read_linearity(linearity, baseline)
    empty = Accumulator.empty(session, selected, baseline, min(saturation, first.saturation))
    accumulator, _ = deque(_accumulate(empty, selected.records), maxlen=1).pop()
    figures = table_figures(accumulator, series)
    return BuildResult(figures, judge(judged_values(figures), FIGURES), None)


def _accumulate_all(
    session: Session,
    selected: SelectedFrames,
    options: BuildOptions,
    linearity: Path | None,
    unfinished: UnfinishedTable,
    progress: ReportProgress,
) -> tuple[Accumulator, LutWriter, LinearityMeasurements | None]:
    records = selected.records
    checkpoint = unfinished.load(_identity(session, selected, options), _frame_keys(selected))
    writer, checkpoint = _open_writer(session, options, unfinished, checkpoint)
    progress(0, len(records), "registering the chart")
    accumulator = _new_accumulator(session, selected, options)
    series = None if linearity is None else read_linearity(linearity, accumulator.baseline)
    if checkpoint is not None:
        accumulator = accumulator.restored(checkpoint.values, checkpoint.arrays)
    previous_count = len(accumulator.figures)
    try:
        for updated, frame in _accumulate(accumulator, records[previous_count:]):
            accumulator = updated
            record = records[len(accumulator.figures) - 1]
            if isinstance(frame, MeasuredFrame) and record.kind == "light" and record.illumination is not None:
                writer.put(record.illumination, frame.values)
            if (len(accumulator.figures) - previous_count) % CHECKPOINT_EVERY == 0:
                unfinished.save(_checkpoint(accumulator, writer))
            progress(len(accumulator.figures), len(records), record.file)
    except ChangedFrame:
        raise
    except (FormatError, QualityError) as error:
        raise _frame_error(error, records[len(accumulator.figures)], accumulator, unfinished.out) from error
    return accumulator, writer, series


def _accumulate(
    accumulator: Accumulator, records: Sequence[FrameRecord]
) -> Generator[tuple[Accumulator, MeasuredFrame | MeasuredDarkFrame]]:
    """Yield the accumulator after each frame, with the measured frame; threads measure the next frames."""

    def measure_early(record: FrameRecord) -> EarlyMeasurement:
        # Runs in a thread, with the accumulator at that moment.
        return _measure_frame(accumulator, record, register_again=False)

    def others_wait_for(record: FrameRecord) -> bool:
        return accumulator.baseline.options.subtract_dark and record.kind == "dark"

    for record, prefetched_frame in prefetched(measure_early, records, others_wait_for):
        frame = prefetched_frame
        if frame is None or frame.registered is not accumulator.registered:
            frame = _measure_frame(accumulator, record, register_again=True)
            assert frame is not None
        accumulator = accumulator.with_frame(frame)
        yield accumulator, frame


def _measure_frame(accumulator: Accumulator, record: FrameRecord, register_again: bool) -> EarlyMeasurement:
    baseline = accumulator.baseline
    decoded = decode_frame(accumulator.session, record)
    if record.kind == "dark":
        return measure_dark(baseline, decoded, accumulator.registered)
    located = locate(baseline, decoded, accumulator.registered, register_again)
    if located is None:
        return None
    is_evenly_lit = accumulator.selected.is_evenly_lit(record)
    return measure(baseline, sample(baseline, located, accumulator.dark, keep_samples=is_evenly_lit))


def _new_accumulator(session: Session, selected: SelectedFrames, options: BuildOptions) -> Accumulator:
    first = decode_frame(session, selected.registered)
    primaries = [decode_frame(session, record) for record in selected.primaries]
    more_whites = _readable_frames(session, selected.more_whites)
    baseline = baseline_of(session.chart, first, options, primaries, more_whites)
    # These frames are decoded again later, because keeping them would need too much memory.
    dark = selected.first_dark if options.subtract_dark else None
    measured_dark = None if dark is None else measure_dark(baseline, decode_frame(session, dark), baseline.first)
    return Accumulator.empty(session, selected, baseline, first.saturation, measured_dark)


def _readable_frames(session: Session, records: Sequence[FrameRecord]) -> Iterator[DecodedFrame]:
    for record in records:
        # A fault of a frame is reported later, when the frame is measured.
        with contextlib.suppress(CropError):
            yield decode_frame(session, record)


def _frame_error(
    error: FormatError | QualityError, record: FrameRecord, accumulator: Accumulator, out: Path
) -> FormatError | QualityError:
    """Return the error that ends the build, after writing a report for `acquire run --retake bad`."""
    content = {"format": REPORT_FORMAT, "version": REPORT_VERSION, "verdict": "refuse", "reason": str(error)}
    content["session"] = accumulator.session.folder.name
    content |= retake_json((record,), record.sha256, accumulator.selected.newest.sha256)
    write_atomic(refused_folder(out) / REPORT_JSON, json.dumps(content, indent=2) + "\n")
    return type(error)(f"{error}; or take {record.file} again: {COMMAND}")


def prefetched(
    work: Callable[[FrameRecord], _Result],
    records: Sequence[FrameRecord],
    others_wait_for: Callable[[FrameRecord], bool],
) -> Generator[tuple[FrameRecord, _Result]]:
    """Yield each frame with its result of `work`, in order, while threads process the following frames.

    `others_wait_for`: True for a frame if the following frames must not be processed before its result is yielded.
    """
    count = thread_count()
    with ThreadPoolExecutor(count) as pool:
        running: deque[tuple[FrameRecord, Future[_Result]]] = deque()
        waiting = deque(records)
        try:
            while waiting or running:
                while waiting and len(running) <= count and not any(others_wait_for(record) for record, _ in running):
                    record = waiting.popleft()
                    running.append((record, pool.submit(work, record)))
                record, future = running[0]
                result = future.result()
                yield record, result
                running.popleft()
        finally:
            for _, future in running:
                future.cancel()


def _write_table(accumulator: Accumulator, figures: TableMeasurements, writer: LutWriter) -> None:
    session, records, lights, greys = accumulator.session, accumulator.records, figures.lights, figures.greys
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
    lens = accumulator.baseline.lens
    if lens is not None and figures.lens.corrected:
        applied.append(lens.correction())
    gain = np.ones(lights.white.shape)
    if lights.drift is not None:
        gain = lights.drift.gains
        applied.append(applied_drift(gain))
    provenance = Provenance(
        camera=accumulator.baseline.camera,
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


def _refusal_error(result: BuildResult, out: Path, folder: Path) -> QualityError:
    report_folder = refused_folder(out)
    saved = [name for name in (REPORT_PAGE, REPORT_JSON) if (folder / name).exists()]
    for name in saved:
        write_atomic(report_folder / name, (folder / name).read_bytes())
    hint = f"; see {report_folder / saved[0]}" if saved else ""
    figures = result.figures
    return QualityError(
        f"{figures.session.folder}: the LUT is refused: {refusal(result.verdict, figures, reported=bool(saved))}{hint}"
    )


def refused_folder(out: Path) -> Path:
    """Return the folder for the report of a refused LUT: `LUT.refused` next to `LUT`."""
    return out.with_name(f"{out.name}.refused")


def _require_dark_frames(session: Session, options: BuildOptions) -> None:
    if options.subtract_dark and not any(record.kind == "dark" and record.accepted for record in session.frames()):
        raise FormatError(
            f"{session.folder} has 0 accepted dark frames, expected at least 1 for --subtract-dark; take the session "
            "with acquire run, which takes dark frames, or build the LUT without --subtract-dark"
        )


def _require_white_frames(selected: SelectedFrames, session: Session, options: BuildOptions) -> None:
    count = sum(record.kind == "white" for record in selected.records)
    if options.correct_drift and count < LEAST_WHITES:
        raise FormatError(
            f"{session.folder} has {counted(count, 'accepted white frame')}, expected at least "
            f"{LEAST_WHITES} for --correct-drift; take the session with acquire run, which takes one every "
            "sequence.reference_every illuminants, or build the LUT without --correct-drift"
        )


def _no_progress(done: int, total: int, step: str) -> None: ...


def thread_count() -> int:
    """Return the number of frames to process in parallel: one per processor, limited by memory."""
    return min(processor_count(), MAX_THREADS)


def _identity(session: Session, selected: SelectedFrames, options: BuildOptions) -> dict[str, Any]:
    return {
        "software": software(),
        "method": METHOD,
        "stored": stored_names(),
        # Drift is corrected in the finished samples, after the last checkpoint.
        "options": to_plain(replace(options, correct_drift=False)),
        "chart": session.chart.sha256,
        "lights": hashlib.sha256(repr(session.illuminations).encode()).hexdigest(),
        "registered": selected.registered.sha256,
        "primaries": [record.sha256 for record in selected.primaries],
        "more_whites": [record.sha256 for record in selected.more_whites],
    }


def _frame_keys(selected: SelectedFrames) -> list[str]:
    return [f"{record.kind},{record.illumination},{record.sha256}" for record in selected.records]


def _checkpoint(accumulator: Accumulator, writer: LutWriter) -> Checkpoint:
    identity = _identity(accumulator.session, accumulator.selected, accumulator.baseline.options)
    frames = _frame_keys(accumulator.selected)[: len(accumulator.figures)]
    return Checkpoint(identity, frames, accumulator.to_json() | {"sha256": writer.sha256}, accumulator.to_arrays())


def _open_writer(
    session: Session, options: BuildOptions, unfinished: UnfinishedTable, checkpoint: Checkpoint | None
) -> tuple[LutWriter, Checkpoint | None]:
    shape = len(session.illuminations), session.chart.colour_count, options.samples
    if checkpoint is not None:
        written = {int(light): sha256 for light, sha256 in checkpoint.values["sha256"].items()}
        writer = LutWriter(unfinished.folder, *shape, written=written)
        if not writer.damaged():
            return writer, checkpoint
    clear_folder(unfinished.folder)
    return LutWriter(unfinished.folder, *shape), None
