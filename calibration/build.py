"""A session becomes a table: registered once, then every light sampled in the order in which it was taken.

Laws that hold inside:

- Every frame is read once, its SHA-256 checked against the journal before one of its counts is believed.
- The last accepted frame of a light counts; a session that lacks a light makes no table.
- The chart must lie where it was registered: a movement up to a tenth of a pixel is let be, up to half a pixel the
  grid is moved along, and beyond it the frame is registered anew.
- The table appears whole or not at all. Until then it grows under a hidden name (`calibration.growing`), and a build
  that was stopped, anywhere, goes on from its last checkpoint and ends in the bytes of one that was not: frames enter
  in the order taken, and what one adds depends on those before it alone.

Threads read and decode ahead, one measures in order, so the memory is that of a few frames whatever the session.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from acquisition.framing import Framing
from acquisition.movement import Shift, shift_between
from acquisition.planes import CHANNELS, Channel, Plane, channel_offset_px, frame_black, phases, plane_of
from acquisition.session import FrameRecord, Session
from calibration.darkness import Darkness, DarkReading, additivity, drift_gains
from calibration.growing import Checkpoint, Growing, growing
from calibration.lut import SAMPLES as SAMPLES_FILE
from calibration.lut import Frame, Lut, LutWriter, Provenance, Unfit, frames_sha256
from calibration.matching import MIN_BLOCK_SCORE
from calibration.noise import PhotonTransfer, photon_transfer
from calibration.radiometry import CLIPPED, Field, Paper, black_drift, corrections, read_paper, saturation
from calibration.references import NAME as REFERENCES_FILE
from calibration.references import Levels, references_csv
from calibration.registration import Registration, register
from calibration.sampling import SAMPLES, Sites, dead_samples, gather, noise_of, sites_at, table_values, uneven
from calibration.verdict import Verdict, figures_of, judge, refusal
from drivers.errors import FormatError, QualityError
from drivers.rawfile import Mosaic, decode_raw
from drivers.storage import write_whole

STILL_PX = 0.1
BUMP_PX = 0.5
REPORT_FILES = ("report.html", "report.json")

CHECKPOINT_EVERY = 16
"""Frames from one checkpoint to the next: what a build that is killed has to do again."""

THREADS = 2
_AHEAD = 3
_AROUND_TAG = 12
"""Half-size pixels around a tag that its movement may need: more than `acquisition.framing` looks at."""

_Array = npt.NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and what is being done."""


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """What was measured on one frame.

    Attributes
    ----------
    record
        The frame.
    black
        (2, 2) float64 counts, black level of each position of the block.
    channel
        The colour in which the chart's movement was measured.
    shift
        Movement against the frame registered last.
    registered
        Whether this frame was registered anew.
    paper
        Field and white.
    greys, grey_errors
        (G, 3) float64 counts above black of each level of grey, field divided out, and their standard errors.
    """

    record: FrameRecord
    black: _Array
    channel: Channel
    shift: Shift
    registered: bool
    paper: Paper
    greys: _Array = field(default_factory=lambda: np.zeros((0, 3)))
    grey_errors: _Array = field(default_factory=lambda: np.zeros((0, 3)))

    def told(self) -> dict[str, Any]:
        """Return the figures as JSON holds them; `recall` makes them again to the last bit."""
        return {
            "black": self.black.tolist(),
            "channel": self.channel,
            "shift": [self.shift.dx, self.shift.dy, self.shift.largest_px, self.shift.tags],
            "registered": self.registered,
            "field": [[factor.tolist() for factor in factors] for factors in self.paper.field.coefficients],
            "white": self.paper.white.tolist(),
            "error": self.paper.error.tolist(),
            "references": self.paper.references,
            "spread": self.paper.spread.tolist(),
            "greys": self.greys.tolist(),
            "grey_errors": self.grey_errors.tolist(),
        }

    @staticmethod
    def recall(record: FrameRecord, page_mm: tuple[float, float], told: dict[str, Any]) -> FrameFigures:
        """Return the figures of a frame from what `told` returned."""
        red, green, blue = (tuple(np.array(factor) for factor in factors) for factors in told["field"])
        field = Field(page_mm, (red, green, blue))
        white, error, spread = (np.array(told[name]) for name in ("white", "error", "spread"))
        return FrameFigures(
            record,
            np.array(told["black"]),
            told["channel"],
            Shift(*told["shift"]),
            told["registered"],
            Paper(field, white, error, told["references"], spread),
            *(np.array(told[name]).reshape(-1, 3) for name in ("greys", "grey_errors")),
        )


@dataclass(frozen=True)
class Growth:
    """How far a table is that still lacks frames: lights in it, of how many, and frames taken in now and before."""

    lights: int
    of: int
    new_frames: int
    frames: int


@dataclass(frozen=True, eq=False)
class BuildResult:
    """What a build, or a check, found.

    Attributes
    ----------
    session
        The session's folder.
    lut
        The table's folder; None after a check.
    camera
        Maker and model.
    registration
        Of the frame that was registered first.
    registered_file
        That frame, relative to the session.
    lights
        Lights in the table.
    white, white_error
        (L, 3) float64, ground truth and its standard error, units of the samples.
    white_level
        Sample value of saturation.
    unfit
        Cells not to be used.
    frames
        Figures of every frame read, in order.
    noise
        (3,) float64, median standard deviation of one sample under white, relative to paper white.
    white_references
        White references of the chart.
    grey_names
        Levels of grey of the chart, G.
    greys, grey_errors
        (L, G, 3) float64, each level under each light and its standard error, units of the samples.
    darkness
        What the dark frames say; of a check, the first of them.
    added
        (3,) by how much the primaries together differ from white, relative; None where the session cannot tell.
    gains
        (L, 3) the lamp's drift at each light, as the white frames have it.
    transfer
        Noise of the cells of the frame that was registered first.
    saturated
        Whether a photosite of a cell reached saturation, so that its count was measured.
    """

    session: Path
    lut: Path | None
    camera: str
    registration: Registration
    registered_file: str
    lights: int
    white: _Array
    white_error: _Array
    white_level: int
    unfit: tuple[Unfit, ...]
    frames: tuple[FrameFigures, ...] = field(default=())
    noise: _Array = field(default_factory=lambda: np.zeros(3))
    white_references: int = 0
    grey_names: tuple[str, ...] = ()
    greys: _Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    grey_errors: _Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    darkness: Darkness = field(default_factory=Darkness)
    added: _Array | None = None
    gains: _Array = field(default_factory=lambda: np.ones((0, 3)))
    transfer: PhotonTransfer | None = None
    saturated: bool = False

    @property
    def verdict(self) -> Verdict:
        """The figures against their limits."""
        return judge(figures_of(self))

    @property
    def largest_shift_px(self) -> float:
        """The chart's largest movement between a frame and the registration it was sampled with before correction."""
        return max((figures.shift.length_px for figures in self.frames), default=0.0)

    @property
    def black_drift(self) -> float:
        """Drift of the black level over the session, counts."""
        return black_drift([*(figures.black for figures in self.frames), *self.darkness.blacks])

    @property
    def white_drift(self) -> float:
        """Largest relative change of paper white between white frames, over the channels."""
        whites = np.array([figures.paper.white for figures in self.frames if figures.record.kind == "white"])
        return float((np.ptp(whites, axis=0) / whites.mean(axis=0)).max()) if len(whites) > 1 else 0.0


@dataclass(frozen=True, eq=False)
class _Decoded:
    record: FrameRecord
    mosaic: Mosaic
    black: _Array
    strongest: Channel
    saturation: int


def check(session: Session) -> BuildResult:
    """Register a session's best frame and judge it; write nothing.

    Raises
    ------
    FormatError
        No frame can be used, or the file is not what the journal says.
    RegistrationError
        The chart is not found, or not the one expected.
    QualityError
        The white references cannot be used.
    """
    best = _best_frame(session)
    decoded = _decode(session, best)
    registration = register(decoded.mosaic, session.chart, best.file)
    work = _Measurement(session, decoded, registration)
    figures, _ = work.measure(decoded)
    darkness = work.darkness(_decoded(session, _darks(session)[:1]))
    level = decoded.saturation - float(decoded.black.mean())
    return BuildResult(
        session=session.folder,
        lut=None,
        camera=decoded.mosaic.camera,
        registration=registration,
        registered_file=best.file,
        lights=len({record.illumination for record in _lights(session)}),
        white=figures.paper.white[None],
        white_error=figures.paper.error[None],
        white_level=round(level),
        unfit=work.unfit(decoded.saturation, darkness),
        frames=(figures,),
        grey_names=work.levels.names,
        greys=figures.greys[None],
        grey_errors=figures.grey_errors[None],
        darkness=darkness,
        transfer=work.transfer,
        saturated=work.saturated(decoded.saturation),
        noise=work.noise(),
        white_references=len(session.chart.white_references),
    )


def build(
    session: Session,
    out: Path,
    progress: Progress | None = None,
    report: Callable[[BuildResult, Session, Path], None] | None = None,
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
        Writes the report into the table's folder before it gets its name; `calibration.report.write_report`.

    Raises
    ------
    FormatError
        A light has no accepted frame, or a frame's file is missing or not what the journal says.
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
    chosen, missing = _chosen(session)
    if missing:
        named = ", ".join(str(index) for index in missing[:10]) + (" …" if len(missing) > 10 else "")
        raise FormatError(
            f"{session.folder}: {len(missing)} of {len(session.illuminations)} lights have no accepted frame: {named}; "
            "finish the session with acquire run, then build the table; or let it grow with build-lut --append"
        )
    with growing(out) as making:
        work = _Work(session, making, chosen, progress or _silent)
        work.take_in()
        return work.finish(out, report)


def append(
    session: Session,
    out: Path,
    progress: Progress | None = None,
    report: Callable[[BuildResult, Session, Path], None] | None = None,
) -> BuildResult | Growth:
    """Let the table of a session that is being taken grow by the frames that have come.

    It grows under a hidden name and appears when the plan's last frame has been taken in, the same to the byte as if
    it had been built at once. Parameters and errors are those of `build`, but that lights may lack.
    """
    chosen, missing = _chosen(session)
    # The plan of a session that was put together otherwise may be empty; its lights are the plan then.
    complete = not missing and {step.number for step in session.steps} <= session.done_steps()
    with growing(out) as making:
        work = _Work(session, making, chosen, progress or _silent)
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

    def __init__(self, session: Session, making: Growing, chosen: Sequence[FrameRecord], told: Progress) -> None:
        self._session, self._making, self._chosen, self._told = session, making, chosen, told
        self._best = _best_frame(session)
        self._keys = [f"{record.kind},{record.illumination},{record.sha256}" for record in chosen]
        self._identity = {
            "software": _software(),
            "chart": session.chart.sha256,
            "lights": hashlib.sha256(repr(session.illuminations).encode()).hexdigest(),
            "registered": self._best.sha256,
        }
        self._before = self._usable(making.load())
        self._figures: list[FrameFigures] = []

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
        shape = len(self._session.illuminations), self._session.chart.colour_count, SAMPLES
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
        first = _decode(session, self._best)
        self._camera = first.mosaic.camera
        self._registration = register(first.mosaic, chart, self._best.file)
        self._measurement = _Measurement(session, first, self._registration)
        self._limit = first.saturation
        if self._before is not None:
            told = self._before.told
            self._limit = int(told["limit"])
            self._figures = [
                FrameFigures.recall(record, chart.page_mm, figures)
                for record, figures in zip(self._chosen, told["figures"], strict=False)
            ]
            adopted = first
            if told["adopted"] != self._best.file:
                adopted = _decode(session, next(record for record in self._chosen if record.file == told["adopted"]))
            self._measurement.restore(self._before.arrays, adopted, session)
        saved = len(self._figures)
        for decoded in _decoded(session, self._chosen[saved:]):
            figures, samples = self._measurement.measure(decoded)
            self._figures.append(figures)
            self._limit = min(self._limit, decoded.saturation)
            light = decoded.record.illumination
            if decoded.record.kind == "light" and light is not None:
                self._writer.put(light, samples)
            if (len(self._figures) - saved) % CHECKPOINT_EVERY == 0:
                self.save()
            self._told(len(self._figures), len(self._chosen), decoded.record.file)

    def save(self) -> None:
        """Write a checkpoint: a later program goes on from here."""
        told = {
            "limit": self._limit,
            "adopted": self._measurement.adopted_file,
            "sha256": self._writer.sha256,
            "figures": [figures.told() for figures in self._figures],
        }
        taken_in = self._keys[: len(self._figures)]
        self._making.save(Checkpoint(self._identity, taken_in, told, self._measurement.state()))

    def finish(self, out: Path, report: Callable[[BuildResult, Session, Path], None] | None) -> BuildResult:
        """Judge the table and give it its name."""
        session, chart, lights = self._session, self._session.chart, self._session.illuminations
        frames, limit, work = self._figures, self._limit, self._measurement
        self._told(len(frames), len(frames), "writing the report")
        white, error = np.zeros((len(lights), 3)), np.zeros((len(lights), 3))
        fields: list[Field | None] = [None] * len(lights)
        blacks = np.zeros((len(lights), 2, 2))
        for figures in frames:
            light = figures.record.illumination
            if figures.record.kind == "light" and light is not None:
                # A channel without light may be measured at or below 0; its standard error is what is known of it.
                white[light] = np.maximum(figures.paper.white, np.maximum(figures.paper.error, 1e-3))
                error[light] = figures.paper.error
                fields[light] = figures.paper.field
                blacks[light] = figures.black
        greys, grey_errors = (np.full((len(lights), len(work.levels.names), 3), np.nan) for _ in range(2))
        for figures in frames:
            if figures.record.kind == "light" and figures.record.illumination is not None:
                greys[figures.record.illumination] = figures.greys
                grey_errors[figures.record.illumination] = figures.grey_errors
        darkness = self._measurement.darkness(_decoded(session, _darks(session)))
        gains, full_white = _drift(frames, len(lights))
        unfit = work.unfit(limit, darkness)
        level = round(limit - float(np.mean([figures.black.mean() for figures in frames])))
        result = BuildResult(
            session=session.folder,
            lut=out,
            camera=self._camera,
            registration=self._registration,
            registered_file=self._best.file,
            lights=len(lights),
            white=white,
            white_error=error,
            white_level=level,
            unfit=unfit,
            frames=tuple(frames),
            noise=work.noise(),
            white_references=len(chart.white_references),
            grey_names=work.levels.names,
            greys=greys,
            grey_errors=grey_errors,
            darkness=darkness,
            added=additivity(lights, white, full_white, darkness.light, gains),
            gains=gains,
            transfer=work.transfer,
            saturated=work.saturated(limit),
        )
        records = [figures.record for figures in frames]
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
                ),
                session_sha256=session_sha256(records),
                chart_sha256=chart.sha256,
                software=_software(),
                unfit=list(unfit),
            ),
            _frames(records),
        )
        folder = self._making.folder
        if work.levels.names:
            write_whole(folder / REFERENCES_FILE, references_csv(work.levels.names, white, error, greys, grey_errors))
        if report is not None:
            report(result, session, folder)
        if result.verdict.refused:
            self._making.discard()
        _require_good(result, out, folder)
        self._making.publish()
        return result


def _software() -> str:
    return f"croplab {version('croplab')}"


def _silent(done: int, total: int, what: str) -> None:
    """Tell nobody."""


def session_sha256(records: Sequence[FrameRecord]) -> str:
    """Return the hash that names a session: SHA-256 over kind, light and hash of each frame used, a line each."""
    return frames_sha256(_frames(records))


def _frames(records: Sequence[FrameRecord]) -> list[Frame]:
    return [Frame(record.kind, record.illumination, record.file, record.sha256) for record in records]


def lost_frames(lut: Lut, session: Session, progress: Progress | None = None) -> list[str]:
    """Return which of the frames that a table was made of are not in a session, or not as they were, each in words.

    Raises
    ------
    FormatError
        The table lists no frames, as those made before they were recorded.
    """
    if not lut.frames:
        raise FormatError(f"{lut.folder} lists no frames; build it again from its session to have them listed")
    faults: list[str] = []
    if session.chart.sha256 != lut.provenance.chart_sha256:
        faults.append(f"{session.folder / 'chart.json'} is not the chart of the table")
    for done, frame in enumerate(lut.frames, 1):
        path = session.folder / frame.file
        try:
            with path.open("rb") as stream:
                found = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            faults.append(f"{path} cannot be read: {error.strerror}")
        else:
            if found != frame.sha256:
                faults.append(f"{path} has changed: its SHA-256 is {found[:16]}…, the table's {frame.sha256[:16]}…")
        if progress is not None:
            progress(done, len(lut.frames), frame.file)
    return faults


def _darks(session: Session) -> list[FrameRecord]:
    return [record for record in session.frames() if record.kind == "dark" and record.accepted]


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


def _lights(session: Session) -> list[FrameRecord]:
    return [record for record in session.frames() if record.kind == "light" and record.accepted]


def _chosen(session: Session) -> tuple[list[FrameRecord], list[int]]:
    """Return the frames a table is made of, and the lights that have none.

    The frames are every light's last accepted, and the white ones, in the order taken.
    """
    last: dict[int, FrameRecord] = {}
    for record in _lights(session):
        if record.illumination is not None:
            last[record.illumination] = record
    missing = [light.index for light in session.illuminations if light.index not in last]
    whites = [record for record in session.frames() if record.kind == "white" and record.accepted]
    return sorted([*last.values(), *whites], key=lambda record: (record.taken_at, record.file)), missing


def _best_frame(session: Session) -> FrameRecord:
    """Return the frame to register: the first accepted white one, or else the brightest light's."""
    whites = [record for record in session.frames() if record.kind == "white" and record.accepted]
    if whites:
        return whites[0]
    lights = _lights(session)
    if not lights:
        raise FormatError(
            f"{session.folder} holds no accepted frame; take the session with acquire run, then build the table"
        )

    def brightness(record: FrameRecord) -> int:
        if record.illumination is None or record.illumination >= len(session.illuminations):
            return -1
        colour = session.illuminations[record.illumination].colour
        return min(colour.red, colour.green, colour.blue)

    return max(lights, key=brightness)


def _decode(session: Session, record: FrameRecord) -> _Decoded:
    path = session.folder / record.file
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FormatError(
            f"{path} is missing, but the session's journal counts it; restore the file from a copy, "
            "or take the light again with acquire run"
        ) from error
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
    found = hashlib.sha256(data).hexdigest()
    if found != record.sha256:
        raise FormatError(
            f"{path} is not the file that was taken: its SHA-256 is {found[:16]}…, the journal says "
            f"{record.sha256[:16]}…; restore the file from a copy, or take the light again with acquire run"
        )
    mosaic = decode_raw(data, path)
    black = frame_black(mosaic)
    return _Decoded(record, mosaic, black, strongest_channel(mosaic, black), saturation(mosaic))


def strongest_channel(mosaic: Mosaic, black: _Array) -> Channel:
    """Return the colour with the brightest paper, from every eighth block."""
    blocks = mosaic.block_planes()[:, :, ::8, ::8]
    levels = [
        max(float(np.percentile(blocks[place], 98) - black[place]) for place in places)
        for places in phases(mosaic).values()
    ]
    return CHANNELS[int(np.argmax(levels))]


def tags_of(mosaic: Mosaic, channel: Channel, black: _Array, framing: Framing) -> Plane:
    """Return one colour of a mosaic around the tags, and 0 elsewhere: all that the chart's movement is measured in."""
    places = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = np.float32(np.mean([black[place] for place in places]))
    values = np.zeros(blocks.shape[2:], dtype=np.float32)
    for tag in framing.tags:
        left, top = np.maximum(np.floor(tag.corners_px.min(axis=0)).astype(int) - _AROUND_TAG, 0)
        right, bottom = np.ceil(tag.corners_px.max(axis=0)).astype(int) + _AROUND_TAG
        part = np.s_[top:bottom, left:right]
        values[part] = sum(blocks[place][part].astype(np.float32) for place in places) / np.float32(len(places)) - level
    return Plane(channel, values, channel_offset_px(places))


def _decoded(session: Session, records: Sequence[FrameRecord]) -> Generator[_Decoded]:
    """Yield the frames in order, a few decoded ahead."""
    with ThreadPoolExecutor(THREADS) as threads:
        waiting: deque[Future[_Decoded]] = deque()
        todo = iter(records)
        try:
            while True:
                while len(waiting) < _AHEAD and (record := next(todo, None)) is not None:
                    waiting.append(threads.submit(_decode, session, record))
                if not waiting:
                    return
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


class _Measurement:
    """Measures frames one by one with the registration of the moment."""

    def __init__(self, session: Session, first: _Decoded, registration: Registration) -> None:
        self._chart = session.chart
        self._references = [reference for reference in session.chart.references if reference.is_white]
        self._reference_mm = np.array([reference.centre_mm for reference in self._references]).reshape(-1, 2)
        greys = [reference for reference in session.chart.references if not reference.is_white]
        self.levels = Levels.of(greys)
        self._grey_mm = np.array([reference.centre_mm for reference in greys]).reshape(-1, 2)
        # The table is ordered by colour index, the chart by its own order.
        self._cells_mm = self._chart.centres_mm[self._chart.cell_of_colour]
        self._shape = first.mosaic.block_planes().shape[2:]
        self._geometry = first.mosaic.visible, first.mosaic.sensor.shape, first.mosaic.pattern
        self._first_file = first.record.file
        self._adopt(first, registration)
        count = self._chart.colour_count
        self._highest = np.zeros(count, dtype=np.uint16)
        self._highest_at = np.zeros(count, dtype=np.int64)
        self._outside = np.zeros(count, dtype=bool)
        self._even_sum: npt.NDArray[np.float32] = np.zeros((count, SAMPLES, 3), dtype=np.float32)
        self._even_noise = np.zeros((count, 3))
        self._even_frames = 0
        self._covered = self._covered_cells(registration)
        self._base: Field | None = None
        samples, highest = gather(first.mosaic, first.black, self._sites)
        self._base = self._paper(first, samples, highest, self._sites).field
        self._first_sites = self._sites
        first_cells = samples[:count].astype(np.float64)
        self.transfer = photon_transfer(first_cells.mean(axis=1), first_cells.var(axis=1, ddof=1))

    def _adopt(self, decoded: _Decoded, registration: Registration) -> None:
        """Make a frame the one that others are compared with."""
        self._registration = registration
        self.adopted_file = decoded.record.file
        self._sites = self._sites_of(registration)
        self._planes = {channel: plane_of(decoded.mosaic, channel, decoded.black) for channel in CHANNELS}

    def _covered_cells(self, registration: Registration) -> npt.NDArray[np.bool_]:
        """Return the cells that do not look like the chart's, alone or with their neighbourhood."""
        blocks = registration.blocks
        nearest = np.asarray(cKDTree(blocks.centres_mm).query(self._cells_mm)[1])
        strangers = registration.strangers[self._chart.cell_of_colour]
        return strangers | np.asarray(blocks.score[nearest] < MIN_BLOCK_SCORE)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what the frames measured so far leave behind, but for the registration."""
        return {
            "highest": self._highest,
            "highest_at": self._highest_at,
            "outside": self._outside,
            "covered": self._covered,
            "even_sum": self._even_sum,
            "even_noise": self._even_noise,
            "even_frames": np.array(self._even_frames),
        }

    def restore(self, state: dict[str, npt.NDArray[Any]], adopted: _Decoded, session: Session) -> None:
        """Go on from what `state` returned; `adopted` is the frame that was registered last."""
        if adopted.record.file != self.adopted_file:
            self._adopt(adopted, register(adopted.mosaic, session.chart, adopted.record.file))
        self._highest, self._highest_at = state["highest"], state["highest_at"]
        self._outside, self._covered = state["outside"], state["covered"]
        self._even_sum, self._even_noise = state["even_sum"], state["even_noise"]
        self._even_frames = int(state["even_frames"])

    def measure(self, decoded: _Decoded) -> tuple[FrameFigures, npt.NDArray[np.uint16]]:
        """Return a frame's figures and its samples (colours, 25, 3) uint16 in the order of colour indices."""
        mosaic, file = decoded.mosaic, decoded.record.file
        if (mosaic.visible, mosaic.sensor.shape, mosaic.pattern) != self._geometry:
            raise FormatError(
                f"{file}: the sensor has {mosaic.sensor.shape[1]}×{mosaic.sensor.shape[0]} photosites "
                f"{mosaic.pattern}, that of {self._first_file} {self._geometry[1][1]}×{self._geometry[1][0]} "
                f"{self._geometry[2]}; "
                "a session has one camera with one setting"
            )
        channel = decoded.strongest
        seen = tags_of(mosaic, channel, decoded.black, self._registration.framing)
        shift = shift_between(self._planes[channel], self._registration.framing, seen)
        sites, anew = self._sites, False
        # A turn or a change of distance moves the tags differently; moving the grid along would not mend it.
        turned = shift.largest_px > shift.length_px + STILL_PX
        if shift.tags == 0 or shift.length_px > BUMP_PX or turned:
            registration, anew = register(mosaic, self._chart, file), True
            self._adopt(decoded, registration)
            self._covered |= self._covered_cells(registration)
            sites = self._sites
        elif shift.length_px > STILL_PX:
            sites = self._sites_of(self._registration.shifted(shift.dx, shift.dy))
        samples, highest = gather(mosaic, decoded.black, sites)
        paper = self._paper(decoded, samples, highest, sites)
        cells = self._chart.colour_count
        light = decoded.record.illumination
        brighter = highest[:cells] > self._highest
        self._highest[brighter] = highest[:cells][brighter]
        self._highest_at[brighter] = -1 if light is None else light
        self._outside |= ~sites.inside[:cells]
        if decoded.record.kind == "white" or self._even_frames == 0:
            self._even_sum += samples[:cells]
            self._even_noise += noise_of(samples[:cells]) ** 2
            self._even_frames += 1
        values = table_values(samples[:cells], paper.field.at(self._cells_mm))
        greys = self._mean_of(slice(cells + len(self._references), None), decoded, samples, highest, sites)
        levels = self.levels.read(greys, paper.field.at(self._grey_mm))
        return FrameFigures(decoded.record, decoded.black, channel, shift, anew, paper, *levels), values

    def _sites_of(self, registration: Registration) -> Sites:
        """Return the sites of the cells in the order of colour indices, then of the white references, then grey."""
        places = registration.to_pixels(np.concatenate([self._cells_mm, self._reference_mm, self._grey_mm]))
        return sites_at(places, (self._shape[0], self._shape[1]))

    def _paper(
        self, decoded: _Decoded, samples: npt.NDArray[np.float32], highest: npt.NDArray[np.uint16], sites: Sites
    ) -> Paper:
        cells = self._chart.colour_count
        whites = slice(cells, cells + len(self._references))
        seen = self._mean_of(whites, decoded, samples, highest, sites)
        return read_paper(
            self._reference_mm, seen, self._cells_mm, self._chart.page_mm, self._base, decoded.record.file
        )

    def _mean_of(
        self,
        patches: slice,
        decoded: _Decoded,
        samples: npt.NDArray[np.float32],
        highest: npt.NDArray[np.uint16],
        sites: Sites,
    ) -> _Array:
        """Return the mean counts (N, 3) of patches, NaN where one is cut off or clipped."""
        seen = samples[patches].mean(axis=1, dtype=np.float64)
        seen[~(sites.inside[patches] & (highest[patches] < CLIPPED * decoded.saturation))] = np.nan
        return seen

    def darkness(self, frames: Iterable[_Decoded]) -> Darkness:
        """Return what dark frames say, at the places of the frame that was registered first: no tag is seen in them."""
        assert self._base is not None
        reading, cells, sites = DarkReading(), self._chart.colour_count, self._first_sites
        whites = slice(cells, cells + len(self._references))
        shape = self._base.at(self._reference_mm)[sites.inside[whites]]
        for decoded in frames:
            samples, _ = gather(decoded.mosaic, decoded.black, sites)
            paper = samples[whites][sites.inside[whites]]
            record = decoded.record
            reading.add(record.file, record.sha256, decoded.black, samples[:cells], paper, shape)
        return reading.result()

    def saturated(self, saturation_counts: int) -> bool:
        """Return whether a photosite of a cell reached saturation."""
        return bool((self._highest >= saturation_counts).any())

    def noise(self) -> _Array:
        """Return the median standard deviation of one sample of the even frames, relative to the brightest cells."""
        frames = max(self._even_frames, 1)
        level = np.percentile(self._even_sum.mean(axis=1) / frames, 99.5, axis=0)
        return np.sqrt(np.median(self._even_noise / frames, axis=0)) / np.maximum(level, 1e-6)

    def unfit(self, saturation_counts: int, darkness: Darkness) -> tuple[Unfit, ...]:
        """Return the cells not to be used, each with the first cause that applies."""
        frames = max(self._even_frames, 1)
        hottest = darkness.hottest if len(darkness.hottest) else np.zeros(self._chart.colour_count)
        dead = dead_samples(self._even_sum / frames)
        unevenness = uneven(self._even_sum / frames, np.sqrt(self._even_noise) / frames)
        allowed = CLIPPED * saturation_counts
        found: list[Unfit] = []
        for colour in range(self._chart.colour_count):
            cause = ""
            if self._outside[colour]:
                cause = "outside: its 25 pixels do not all lie in the frame"
            elif self._highest[colour] >= allowed:
                light = int(self._highest_at[colour])
                under = f"light {light}" if light >= 0 else "white"
                cause = f"clipped: {int(self._highest[colour])} counts under {under}, below {allowed:.0f} allowed"
            elif self._covered[colour]:
                cause = "covered: it does not look like the chart's (covered, damaged, or printed otherwise)"
            elif hottest[colour] > 0:
                cause = f"hot: a photosite stands out by {hottest[colour]:.0f} counts in every dark frame"
            elif dead[colour]:
                cause = "dead: a photosite sees less than half of the light of its cell"
            elif unevenness[colour] > 0:
                cause = f"uneven: rim and middle differ by {unevenness[colour]:.1%} under white"
            if cause:
                found.append(Unfit(colour=colour, cause=cause))
        return tuple(found)


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
