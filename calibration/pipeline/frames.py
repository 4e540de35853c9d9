"""The options of a table, the frames that it is made of, and what their session states of its origin."""

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

from calibration.citation import Rig, StatedOrigin
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

_MORE_WHITES = 3  # White frames beside the first that a lens is measured on, where the noise of few cells matters


@dataclass(frozen=True)
class BuildOptions:
    """How a table is built; by default 25 samples, the paper's, from which black and the lens's spread are subtracted.

    - `window`: pixels along the side of a cell's window: one of `calibration.sampling.WINDOWS`.
    - `subtract_dark`: whether the light of the dark frames is subtracted from samples and ground truth.
    - `corners`: four corners (x, y) of the field of cells in the frame that is registered first, half-size px,
      clockwise from the printed top-left, which a chart without tags needs; None for a chart with tags.
    - `correct_drift`: whether the lamp's drift between white frames is taken out of samples and ground truth at the
      end.
    - `lens_correction`: whether what the lens spreads beside its sharp core is subtracted from samples and ground
      truth, where the print proves that it does.
    """

    window: int = WINDOW
    subtract_dark: bool = False
    corners: Corners | None = None
    correct_drift: bool = False
    lens_correction: bool = True

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise InputError(
                f"a window of {self.window} pixels was asked for; {', '.join(map(str, WINDOWS[:-1]))} or {WINDOWS[-1]} "
                "expected: a window has a middle pixel, and cells are about 10 pixels wide"
            )

    @property
    def samples(self) -> int:
        """Samples of each cell."""
        return self.window**2


PAPER_OPTIONS = BuildOptions()  # The paper's options, which hold where none are given


@dataclass(frozen=True, eq=False)
class SelectedFrames:
    """The frames that a table is made of.

    - `records`: every light's last accepted frame, and the accepted white and dark ones, in the order taken.
    - `primaries`: the frames of red, green and blue alone; () where one of the three is lacking.
    - `more_whites`: of a chart of few colours, further frames of the light in which it is registered.
    """

    records: tuple[FrameRecord, ...]
    lights_without: tuple[int, ...]
    registered: FrameRecord
    primaries: tuple[FrameRecord, ...]
    more_whites: tuple[FrameRecord, ...]

    @property
    def newest(self) -> FrameRecord:
        """The frame that was taken last, dark ones apart."""
        return max(self._lit, key=lambda record: record.attempt)

    @property
    def first_dark(self) -> FrameRecord | None:
        """The dark frame that was taken first; None if there is none."""
        return next((record for record in self.records if record.kind == "dark"), None)

    @property
    def _lit(self) -> Iterator[FrameRecord]:
        return (record for record in self.records if record.kind != "dark")

    def is_even(self, record: FrameRecord) -> bool:
        """Return whether a frame's samples show how even cells are: the white ones, or the first with any light.

        A file counts once, whatever it stands for: its noise is the same each time, and would not average out.
        """
        first = next((one for one in self.records if one.kind == "white" and one.sha256 == record.sha256), None)
        return record == first or record is next(self._lit)


ReportProgress = Callable[[int, int, str], None]  # Called with frames done, frames in all, and what is being done

_SETTING_RIGS = ("lab", "simulated")  # Rigs whose settings set the camera; of others they say nothing of the exposure


def select_frames(session: Session) -> SelectedFrames:
    """Return the frames that a table of a session is made of, so far."""
    accepted = [record for record in session.frames() if record.accepted]
    if not any(record.kind in ("white", "light") for record in accepted):
        raise FormatError(
            f"{session.folder} holds no accepted frame; take the session with acquire run, then build the table"
        )
    last = _last_of_each_light(session, accepted)
    others = [record for record in accepted if record.kind in ("white", "dark")]
    whites = list({record.sha256: record for record in others if record.kind == "white"}.values())
    pure = pure_lights(session.illuminations) or ()
    return SelectedFrames(
        records=_in_order_taken(session, [*last.values(), *others]),
        lights_without=tuple(light.index for light in session.illuminations if light.index not in last),
        registered=_frame_to_register(session, accepted),
        primaries=tuple(last[light] for light in pure) if all(light in last for light in pure) else (),
        more_whites=tuple(whites[1 : 1 + _MORE_WHITES]) if session.chart.bits < VARYING_BITS else (),
    )


def _in_order_taken(session: Session, records: Sequence[FrameRecord]) -> tuple[FrameRecord, ...]:
    """Return frames in the order taken, by the journal, with times that go on.

    White frames are interpolated in time: if a clock was set back between two frames, what follows counts as taken the
    usual interval later. Frames that were taken by other means have their times alone.
    """
    if any(event.what == "import" for event in session.journal.events()):
        return tuple(sorted(records, key=lambda record: (record.taken_at, record.file)))
    ordered = sorted(records, key=lambda record: record.attempt)
    gaps = [after.taken_at - before.taken_at for before, after in pairwise(ordered)]
    nothing = timedelta(0)
    forward = [gap.total_seconds() for gap in gaps if gap > nothing]
    usual = timedelta(seconds=median(forward)) if forward else nothing
    moved, behind = ordered[:1], timedelta(0)
    for record, gap in zip(ordered[1:], gaps, strict=True):
        behind += usual - gap if gap < nothing else nothing
        moved.append(replace(record, taken_at=record.taken_at + behind))
    return tuple(moved)


def _last_of_each_light(session: Session, accepted: Sequence[FrameRecord]) -> dict[int, FrameRecord]:
    last = {
        record.illumination: record for record in accepted if record.kind == "light" and record.illumination is not None
    }
    lights_of: dict[str, int] = {}
    for light, record in last.items():
        other = lights_of.setdefault(record.sha256, light)
        if other != light:
            raise FormatError(
                f"{session.folder}: lights {other} and {light} have the same raw file, {record.file}, SHA-256 "
                f"{record.sha256[:16]}…; each light has its own, so correct the list of frames and import it again"
            )
    return last


def _frame_to_register(session: Session, accepted: Sequence[FrameRecord]) -> FrameRecord:
    white = next((record for record in accepted if record.kind == "white"), None)
    if white is not None:
        return white

    def brightness(record: FrameRecord) -> int:
        if record.illumination is None or record.illumination >= len(session.illuminations):
            return -1
        return min(session.illuminations[record.illumination].colour)

    return max((record for record in accepted if record.kind == "light"), key=brightness)


def stated_origin(session: Session) -> StatedOrigin:
    """Return what a session states; what is lacking or damaged is not known."""
    try:
        document: dict[str, Any] = tomllib.loads(session.settings_text())
        rig: Rig | None = next((known for known in get_args(Rig) if known == document.get("rig")), None)
        where = f"{session.folder / 'session.toml'}: citation"
        citation = validate_settings(CitationSettings, document.get("citation", {}), where)
        set_by = CameraSettings.model_validate(document["camera"]) if rig in _SETTING_RIGS else None
    except (CropError, ValidationError, ValueError, KeyError, RecursionError) as error:
        if isinstance(error, CropError | tomllib.TOMLDecodeError):
            why = error if isinstance(error, CropError) else f"{session.folder / 'session.toml'} is not TOML: {error}"
            _log.warning("%s; the table states neither its origin nor its authors, exposure and licence", why)
        return StatedOrigin(CitationSettings(), None, None, session.journal.records())
    return StatedOrigin(citation, rig, set_by, session.journal.records())


def source_frames(records: Sequence[FrameRecord]) -> list[SourceFrame]:
    """Return frames as `frames.csv` of a table lists them."""
    return [SourceFrame(record.kind, record.illumination, record.file, record.sha256) for record in records]


def frame_faults(lut: Lut, session: Session, progress: ReportProgress | None = None) -> list[str]:
    """Return which of the frames that a table was made of are missing or changed, each fault in words."""
    if lut.provenance.computed is not None:
        raise FormatError(f"{lut.folder} was computed, no frame was taken for it; verify it without a session")
    if not lut.frames:
        raise FormatError(f"{lut.folder} lists no frames; build it again from its session to have them listed")
    faults: list[str] = []
    if session.chart.sha256 != lut.provenance.chart_sha256:
        faults.append(f"{session.folder / 'chart.json'} is not the chart of the table")
    for done, frame in enumerate(lut.frames, 1):
        path = session.folder / frame.file
        try:
            found = file_sha256(path)
        except OSError as error:
            faults.append(f"{path} cannot be read: {error.strerror}")
        else:
            if found != frame.sha256:
                faults.append(f"{path} has changed: its SHA-256 is {found[:16]}…, the table's {frame.sha256[:16]}…")
        if progress is not None:
            progress(done, len(lut.frames), frame.file)
    return faults
