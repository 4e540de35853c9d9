"""Options of a build, selection of the frames for a LUT, and the origin that a session states."""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from itertools import pairwise
from statistics import median
from typing import Any, get_args

from pydantic import ValidationError

from calibration.citation import Rig, SessionOrigin
from calibration.radiometry.primaries import pure_lights
from calibration.sampling import WINDOW, WINDOWS
from calibration.spread.predicting import VARYING_BITS
from calibration.table.lut import Lut, SourceFrame
from experiment.config import CameraSettings, CitationSettings, validate_settings
from experiment.framing.field import Corners
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.errors import CropError, FormatError, InputError
from foundation.files import file_sha256

_log = logging.getLogger(__name__)

_MAX_MORE_WHITES = 3  # Maximum of `SelectedFrames.more_whites`


@dataclass(frozen=True)
class BuildOptions:
    """Options of a build; the defaults follow Banić et al. 2019, but subtract light that the lens spreads."""

    window: int = WINDOW  # Side of a patch's sampling window, px; one of `calibration.sampling.WINDOWS`
    subtract_dark: bool = False  # Subtract dark light from samples and ground truth
    # Corners (x, y) of the patches, half-size px, clockwise from top left; for a chart without tags
    corners: Corners | None = None
    correct_drift: bool = False  # Correct samples and ground truth for lamp drift between white frames
    lens_correction: bool = True  # Subtract light spread by the lens, if it was measured significantly

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise InputError(
                f"window = {self.window} px, expected {', '.join(map(str, WINDOWS[:-1]))} or {WINDOWS[-1]} px, "
                "because a window has a central pixel, and patches are about 10 px wide; use 5 px if in doubt"
            )

    @property
    def samples(self) -> int:
        """Number of samples per patch."""
        return self.window**2


PAPER_OPTIONS = BuildOptions()  # The defaults


@dataclass(frozen=True, eq=False)
class SelectedFrames:
    """The frames of a LUT."""

    # Last accepted frame of each illuminant, and accepted white and dark frames, in the order taken
    records: tuple[FrameRecord, ...]
    missing_lights: tuple[int, ...]  # Illuminants without a frame
    registered: FrameRecord  # Frame to register first
    primaries: tuple[FrameRecord, ...]  # Frames of red, green and blue alone; () if one is missing
    more_whites: tuple[FrameRecord, ...]  # Further white frames, to measure the lens on charts with few patches

    @property
    def newest(self) -> FrameRecord:
        """The light or white frame taken last."""
        return max(self._lit_frames, key=lambda record: record.attempt)

    @property
    def first_dark(self) -> FrameRecord | None:
        """The first dark frame, if any."""
        return next((record for record in self.records if record.kind == "dark"), None)

    @property
    def _lit_frames(self) -> Iterator[FrameRecord]:
        return (record for record in self.records if record.kind != "dark")

    def is_evenly_lit(self, record: FrameRecord) -> bool:
        """Return True if a frame is used as evenly lit: a white frame, or the first of all light and white frames.

        Of several white frames with the same file, only the first is used, because they have the same noise.
        """
        first = next((white for white in self.records if white.kind == "white" and white.sha256 == record.sha256), None)
        return record == first or record is next(self._lit_frames)


ReportProgress = Callable[[int, int, str], None]  # Called with the numbers of finished and of all frames, and a text

_CONFIGURED_RIGS = ("lab", "simulated")  # In sessions of these rigs, the settings contain the exposure


def select_frames(session: Session) -> SelectedFrames:
    """Return the frames for a LUT that the session contains so far."""
    accepted = [record for record in session.frames() if record.accepted]
    if not any(record.kind in ("white", "light") for record in accepted):
        raise FormatError(
            f"{session.folder} has 0 accepted light or white frames, expected at least 1; take the session with "
            "acquire run"
        )
    last = _last_of_each_light(session, accepted)
    reference_frames = [record for record in accepted if record.kind in ("white", "dark")]
    whites = list({record.sha256: record for record in reference_frames if record.kind == "white"}.values())
    pure = pure_lights(session.illuminations) or ()
    return SelectedFrames(
        records=_in_order_taken(session, [*last.values(), *reference_frames]),
        missing_lights=tuple(light.index for light in session.illuminations if light.index not in last),
        registered=_frame_to_register(session, accepted),
        primaries=tuple(last[light] for light in pure) if all(light in last for light in pure) else (),
        more_whites=tuple(whites[1 : 1 + _MAX_MORE_WHITES]) if session.chart.bits < VARYING_BITS else (),
    )


def _in_order_taken(session: Session, records: Sequence[FrameRecord]) -> tuple[FrameRecord, ...]:
    """Return frames in the order taken; their times never decrease."""
    # Drift is interpolated in time between white frames. If a clock was set back between two frames, the usual interval
    # is assumed between them. For imported frames, only the times in their files are known.
    if any(event.what == "import" for event in session.journal.events()):
        return tuple(sorted(records, key=lambda record: (record.taken_at, record.file)))
    ordered = sorted(records, key=lambda record: record.attempt)
    gaps = [later.taken_at - earlier.taken_at for earlier, later in pairwise(ordered)]
    zero = timedelta(0)
    positive_gaps = [gap.total_seconds() for gap in gaps if gap > zero]
    usual_gap = timedelta(seconds=median(positive_gaps)) if positive_gaps else zero
    adjusted, offset = ordered[:1], timedelta(0)
    for record, gap in zip(ordered[1:], gaps, strict=True):
        offset += usual_gap - gap if gap < zero else zero
        adjusted.append(replace(record, taken_at=record.taken_at + offset))
    return tuple(adjusted)


def _last_of_each_light(session: Session, accepted: Sequence[FrameRecord]) -> dict[int, FrameRecord]:
    last_by_light = {
        record.illumination: record for record in accepted if record.kind == "light" and record.illumination is not None
    }
    light_by_hash: dict[str, int] = {}
    for light, record in last_by_light.items():
        first_light = light_by_hash.setdefault(record.sha256, light)
        if first_light != light:
            raise FormatError(
                f"{session.folder}: illuminants {first_light} and {light} have the same raw file, {record.file}, "
                f"SHA-256 {record.sha256[:16]}…; correct the list of frames and import it again"
            )
    return last_by_light


def _frame_to_register(session: Session, accepted: Sequence[FrameRecord]) -> FrameRecord:
    white = next((record for record in accepted if record.kind == "white"), None)
    if white is not None:
        return white

    def brightness(record: FrameRecord) -> int:
        if record.illumination is None or record.illumination >= len(session.illuminations):
            return -1
        return min(session.illuminations[record.illumination].colour)

    return max((record for record in accepted if record.kind == "light"), key=brightness)


def stated_origin(session: Session) -> SessionOrigin:
    """Return the origin that the settings and the journal of a session state; damaged values count as unknown."""
    try:
        document: dict[str, Any] = tomllib.loads(session.settings_text())
        rig: Rig | None = next((name for name in get_args(Rig) if name == document.get("rig")), None)
        source = f"{session.folder / 'session.toml'}: citation"
        citation = validate_settings(CitationSettings, document.get("citation", {}), source)
        settings = CameraSettings.model_validate(document["camera"]) if rig in _CONFIGURED_RIGS else None
    except (CropError, ValidationError, ValueError, KeyError, RecursionError) as error:
        if isinstance(error, CropError | tomllib.TOMLDecodeError):
            fault = error if isinstance(error, CropError) else f"{session.folder / 'session.toml'} is not TOML: {error}"
            _log.warning(
                "%s; the LUT will not contain origin, authors, exposure and licence; correct it, and build the LUT "
                "again",
                fault,
            )
        return SessionOrigin(CitationSettings(), None, None, session.journal.records())
    return SessionOrigin(citation, rig, settings, session.journal.records())


def source_frames(records: Sequence[FrameRecord]) -> list[SourceFrame]:
    """Return the rows of frames in `frames.csv` of a LUT."""
    return [SourceFrame(record.kind, record.illumination, record.file, record.sha256) for record in records]


def frame_faults(lut: Lut, session: Session, progress: ReportProgress | None = None) -> list[str]:
    """Return a message for each frame of a LUT that is missing or changed."""
    if lut.provenance.computed is not None:
        raise FormatError(f"{lut.folder} was computed and has no frames; verify it without a session")
    if not lut.frames:
        raise FormatError(f"{lut.folder} lists no frames; build it again from its session")
    faults: list[str] = []
    if session.chart.sha256 != lut.provenance.chart_sha256:
        faults.append(f"{session.folder / 'chart.json'} is not the chart of the LUT; restore the session's chart.json")
    for checked_count, frame in enumerate(lut.frames, 1):
        path = session.folder / frame.file
        try:
            sha256 = file_sha256(path)
        except OSError as error:
            faults.append(f"{path} cannot be read: {error.strerror}")
        else:
            if sha256 != frame.sha256:
                faults.append(f"{path} has changed: its SHA-256 is {sha256[:16]}…, expected {frame.sha256[:16]}…")
        if progress is not None:
            progress(checked_count, len(lut.frames), frame.file)
    return faults
