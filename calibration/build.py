"""A session becomes a table: registered once, then every light sampled in the order in which it was taken.

Laws that hold inside:

- Every frame is read once, its SHA-256 checked against the journal before one of its counts is believed.
- The last accepted frame of a light counts; a session that lacks a light makes no table.
- The chart must lie where it was registered: a movement up to a tenth of a pixel is let be, up to half a pixel the
  grid is moved along, and beyond it the frame is registered anew.
- The table appears whole or not at all.

Two threads read and decode ahead, one measures in order, so the memory is that of a few frames whatever the session.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from acquisition.framing import CHANNELS, Channel, Plane, Shift, frame_black, plane_of, shift_between, strongest_plane
from acquisition.session import FrameRecord, Session, file_sha256
from calibration.lut import LutWriter, Provenance, Unfit
from calibration.radiometry import CLIPPED, Field, Paper, black_drift, corrections, read_paper, saturation
from calibration.registration import MIN_BLOCK_SCORE, Registration, register
from calibration.sampling import SAMPLES, Sites, gather, noise_of, sites_at, table_values, uneven
from calibration.verdict import Verdict, figures_of, judge, refusal
from drivers.errors import FormatError, QualityError
from drivers.rawfile import Mosaic, read_raw
from drivers.storage import whole_folder, write_whole

STILL_PX = 0.1
BUMP_PX = 0.5
REPORT_FILES = ("report.html", "report.json")

_THREADS = 2
_AHEAD = 3

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
    """

    record: FrameRecord
    black: _Array
    channel: Channel
    shift: Shift
    registered: bool
    paper: Paper


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
        return black_drift([figures.black for figures in self.frames])

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
    strongest: Plane
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
        unfit=work.unfit(decoded.saturation),
        frames=(figures,),
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
    told = progress or _silent
    chart, lights = session.chart, session.illuminations
    chosen = _chosen(session)
    with whole_folder(out, "the table") as folder:
        writer = LutWriter(folder, len(lights), chart.colour_count, SAMPLES)
        told(0, len(chosen), "finding the chart")
        best = _best_frame(session)
        first = _decode(session, best)
        registration = register(first.mosaic, chart, best.file)
        work = _Measurement(session, first, registration)
        white, error = np.zeros((len(lights), 3)), np.zeros((len(lights), 3))
        fields: list[Field | None] = [None] * len(lights)
        blacks = np.zeros((len(lights), 2, 2))
        frames: list[FrameFigures] = []
        limit = first.saturation
        for decoded in _decoded(session, chosen):
            figures, samples = work.measure(decoded)
            frames.append(figures)
            limit = min(limit, decoded.saturation)
            light = decoded.record.illumination
            if decoded.record.kind == "light" and light is not None:
                writer.put(light, samples)
                # A channel without light may be measured at or below 0; its standard error is what is known of it.
                white[light] = np.maximum(figures.paper.white, np.maximum(figures.paper.error, 1e-3))
                error[light] = figures.paper.error
                fields[light] = figures.paper.field
                blacks[light] = figures.black
            told(len(frames), len(chosen), decoded.record.file)
        told(len(chosen), len(chosen), "writing the report")
        unfit = work.unfit(limit)
        level = round(limit - float(np.mean([figures.black.mean() for figures in frames])))
        result = BuildResult(
            session=session.folder,
            lut=out,
            camera=first.mosaic.camera,
            registration=registration,
            registered_file=best.file,
            lights=len(lights),
            white=white,
            white_error=error,
            white_level=level,
            unfit=unfit,
            frames=tuple(frames),
            noise=work.noise(),
            white_references=len(chart.white_references),
        )
        writer.finish(
            lights,
            white,
            Provenance(
                camera=first.mosaic.camera,
                bits=chart.bits,
                white_level=level,
                corrections=corrections(chart.page_mm, blacks, limit, [shape for shape in fields if shape]),
                session_sha256=session_sha256([figures.record for figures in frames]),
                chart_sha256=chart.sha256,
                software=f"croplab {version('croplab')}",
                unfit=list(unfit),
            ),
        )
        if report is not None:
            report(result, session, folder)
        _require_good(result, out, folder)
    return result


def _silent(done: int, total: int, what: str) -> None:
    """Tell nobody."""


def session_sha256(records: Sequence[FrameRecord]) -> str:
    """Return the hash that names a session: SHA-256 over kind, light and hash of each frame used, a line each."""
    lines = [f"{record.kind},{record.illumination},{record.sha256}\n" for record in records]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _lights(session: Session) -> list[FrameRecord]:
    return [record for record in session.frames() if record.kind == "light" and record.accepted]


def _chosen(session: Session) -> list[FrameRecord]:
    """Return the frames a table is made of, in the order taken: every light's last accepted, and the white ones."""
    last: dict[int, FrameRecord] = {}
    for record in _lights(session):
        if record.illumination is not None:
            last[record.illumination] = record
    missing = [light.index for light in session.illuminations if light.index not in last]
    if missing:
        named = ", ".join(str(index) for index in missing[:10]) + (" …" if len(missing) > 10 else "")
        raise FormatError(
            f"{session.folder}: {len(missing)} of {len(session.illuminations)} lights have no accepted frame: {named}; "
            "finish the session with acquire run, then build the table"
        )
    whites = [record for record in session.frames() if record.kind == "white" and record.accepted]
    return sorted([*last.values(), *whites], key=lambda record: (record.taken_at, record.file))


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
    if not path.is_file():
        raise FormatError(
            f"{path} is missing, but the session's journal counts it; restore the file from a copy, "
            "or take the light again with acquire run"
        )
    found = file_sha256(path)
    if found != record.sha256:
        raise FormatError(
            f"{path} is not the file that was taken: its SHA-256 is {found[:16]}…, the journal says "
            f"{record.sha256[:16]}…; restore the file from a copy, or take the light again with acquire run"
        )
    mosaic = read_raw(path)
    black = frame_black(mosaic)
    return _Decoded(record, mosaic, black, strongest_plane(mosaic, black), saturation(mosaic))


def _decoded(session: Session, records: Sequence[FrameRecord]) -> Generator[_Decoded]:
    """Yield the frames in order, a few decoded ahead."""
    with ThreadPoolExecutor(_THREADS) as threads:
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

    def _adopt(self, decoded: _Decoded, registration: Registration) -> None:
        """Make a frame the one that others are compared with."""
        self._registration = registration
        self._sites = self._sites_of(registration)
        self._planes = {channel: plane_of(decoded.mosaic, channel, decoded.black) for channel in CHANNELS}

    def _covered_cells(self, registration: Registration) -> npt.NDArray[np.bool_]:
        """Return the cells that do not look like the chart's, alone or with their neighbourhood."""
        blocks = registration.blocks
        nearest = np.asarray(cKDTree(blocks.centres_mm).query(self._cells_mm)[1])
        strangers = registration.strangers[self._chart.cell_of_colour]
        return strangers | np.asarray(blocks.score[nearest] < MIN_BLOCK_SCORE)

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
        channel = decoded.strongest.channel
        shift = shift_between(self._planes[channel], self._registration.framing, decoded.strongest)
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
        return FrameFigures(decoded.record, decoded.black, channel, shift, anew, paper), values

    def _sites_of(self, registration: Registration) -> Sites:
        """Return the sites of the cells in the order of colour indices, then of the white references."""
        places = registration.to_pixels(np.concatenate([self._cells_mm, self._reference_mm]))
        return sites_at(places, (self._shape[0], self._shape[1]))

    def _paper(
        self, decoded: _Decoded, samples: npt.NDArray[np.float32], highest: npt.NDArray[np.uint16], sites: Sites
    ) -> Paper:
        cells = self._chart.colour_count
        usable = sites.inside[cells:] & (highest[cells:] < CLIPPED * decoded.saturation)
        seen = samples[cells:].mean(axis=1, dtype=np.float64)
        seen[~usable] = np.nan
        return read_paper(
            self._reference_mm, seen, self._cells_mm, self._chart.page_mm, self._base, decoded.record.file
        )

    def noise(self) -> _Array:
        """Return the median standard deviation of one sample of the even frames, relative to the brightest cells."""
        frames = max(self._even_frames, 1)
        level = np.percentile(self._even_sum.mean(axis=1) / frames, 99.5, axis=0)
        return np.sqrt(np.median(self._even_noise / frames, axis=0)) / np.maximum(level, 1e-6)

    def unfit(self, saturation_counts: int) -> tuple[Unfit, ...]:
        """Return the cells not to be used, each with the first cause that applies."""
        frames = max(self._even_frames, 1)
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
