"""Make a session from existing raw files, with a list of these frames, the chart, and the illuminants.

Every file is copied unchanged. It is checked against its hash if the list has one, and judged if the list has no
verdict.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from acquisition.judge.measure import judge_file, whole_frame
from drivers.camera import CapturedFrame
from drivers.presenter import BLACK, WHITE
from drivers.raw.rawfile import LAYOUT_START, layout_is_known
from experiment.chart.model import load_chart
from experiment.config import LabSettings
from experiment.lights import Illuminant, load_illuminants
from experiment.session.folder import FRAME_COLUMNS, Session
from experiment.session.records import ACCEPTED, REFUSED, FrameKind, Judgement, SessionStep
from foundation.errors import FormatError
from foundation.files import file_sha256, read_csv
from foundation.folders import require_free


@dataclass(frozen=True)
class ListedFrame:
    """One row of the list; fields without a value in the row are empty or None."""

    kind: FrameKind
    illumination: int | None
    path: Path
    sha256: str
    taken_at: datetime
    exposure_s: float
    verdict: str


@dataclass(frozen=True)
class Imported:
    """Result of an import.

    - `refused`: one sentence for each refused frame.
    - `missing`: illuminants and kinds of frames without an accepted frame, in words.
    - `unchecked`: suffixes of the files that could not be checked for completeness.
    """

    refused: tuple[str, ...]
    missing: tuple[str, ...]
    unchecked: tuple[str, ...]


def read_frame_list(path: Path) -> tuple[list[ListedFrame], tuple[Illuminant, ...]]:
    """Read a list of frames (columns as in `frames.csv`, paths relative to it) and the illuminants next to it.

    Only `kind`, `illumination` and `file` must be filled. Rows of the kind ``response`` are ignored, because only a
    running session needs them.
    """
    columns, rows = read_csv(path, "name a CSV file in UTF-8", "the list of frames")
    if not rows or not set(columns).issuperset(FRAME_COLUMNS[:3]):
        problem = f"{len(rows)} frames with the columns {','.join(columns)}, expected 1 or more frames with at least "
        raise FormatError(f"{problem}{','.join(FRAME_COLUMNS[:3])}; correct the list", about=path)
    timeless = [number for number, row in enumerate(rows, 2) if not (row.get("taken_at") or "").strip()]
    # A row without taken_at would get the time of its file. If the file is a copy, this is later than other exposures.
    if 0 < len(timeless) < len(rows):
        problem = f"{len(timeless)} of {len(rows)} frames have no taken_at, the first in line {timeless[0]}"
        raise FormatError(f"{problem}, expected all frames or none; complete the list", about=path)
    lights = load_illuminants(path.parent / "illuminations.csv")
    frames = [
        _parse_row(row, f"{path}, line {number}", path.parent, len(lights))
        for number, row in enumerate(rows, 2)
        if (row["kind"] or "").strip() != "response"
    ]
    return frames, lights


def _parse_row(row: Mapping[str, str | None], where: str, folder: Path, lights: int) -> ListedFrame:
    def cell(column: str) -> str:
        return (row.get(column) or "").strip()

    kind = cell("kind")
    if kind not in ("light", "white", "dark"):
        raise FormatError(f"kind is {kind!r}, expected light, white or dark; correct it", about=where, value=kind)
    file = folder / cell("file")
    if not cell("file") or not file.is_file():
        raise FormatError(
            f"the file {file} does not exist", about=where, remedy="give paths relative to the list", value=file
        )
    try:
        illumination = int(cell("illumination")) if kind == "light" else None
        exposure_s = float(cell("exposure_s") or 0)
        time = cell("taken_at")
        taken_at = datetime.fromisoformat(time) if time else datetime.fromtimestamp(file.stat().st_mtime, UTC)
        # Local time occurs twice when the clock goes back, and then frames would be in the wrong order.
        if taken_at.tzinfo is None:
            raise ValueError(f"taken_at is {time!r}, expected a time with its offset from UTC, such as {time}+02:00")
        taken_at = taken_at.astimezone(UTC)
        # Range of the journal; a camera whose clock was never set reports year 0.
        if not 1970 <= taken_at.year < 9999:
            raise ValueError(f"taken_at is {time or taken_at}, expected a time after 1970")
    except (ValueError, OverflowError) as error:
        remedy = "give illumination as an integer, exposure_s in s, and taken_at in ISO 8601 with an offset"
        raise FormatError(str(error), about=where, remedy=remedy) from error
    if illumination is not None and not 0 <= illumination < lights:
        problem = f"illumination is {illumination}, expected 0 … {lights - 1} as in illuminations.csv; correct it"
        raise FormatError(problem, about=where, value=illumination)
    if not 0 <= exposure_s < math.inf:
        problem = f"exposure_s is {exposure_s:g}, expected seconds, or nothing if it is unknown; correct it"
        raise FormatError(problem, about=where, value=exposure_s)
    verdict = cell("verdict")
    if verdict not in ("", ACCEPTED, REFUSED) and not verdict.startswith(f"{REFUSED}: "):
        problem = f"verdict is {verdict!r}, expected {ACCEPTED}, {REFUSED}: REASON, or nothing; correct it"
        raise FormatError(problem, about=where, value=verdict)
    return ListedFrame(kind, illumination, file, cell("sha256").lower(), taken_at, exposure_s, verdict)


def import_session(
    frame_list: Path, chart: Path, folder: Path, observe: Callable[[int, int], None] = lambda done, total: None
) -> Imported:
    """Make a session from listed raw files."""
    require_free(folder, "the session")
    frames, lights = read_frame_list(frame_list)
    loaded = load_chart(chart)
    for frame in frames:
        if frame.sha256 and file_sha256(frame.path) != frame.sha256:
            problem = f"the SHA-256 of {frame.path} differs from its value in {frame_list}"
            raise FormatError(problem, remedy="copy the file again", value=frame.path)
    settings = LabSettings(rig="imported", chart=chart, illuminations=frame_list.parent / "illuminations.csv")
    steps = [_step(number, frame, lights) for number, frame in enumerate(frames)]
    refused: list[str] = []
    light_files: dict[str, ListedFrame] = {}
    with Session.create(folder, settings.to_toml(), loaded, lights, steps) as session:
        try:
            for step, frame in zip(steps, frames, strict=True):
                reason, sha256 = _import_frame(session, step, frame, settings)
                first = light_files.setdefault(sha256, frame) if frame.kind == "light" else frame
                if first.illumination != frame.illumination:
                    raise FormatError(
                        f"illuminants {first.illumination} and {frame.illumination} have the same raw file, "
                        f"{first.path.name} and {frame.path.name}",
                        about=frame_list,
                        remedy="list a separate file for each illuminant",
                        value=(first.illumination, frame.illumination),
                    )
                if reason:
                    refused.append(f"{frame.path.name}: {reason}")
                observe(step.number + 1, len(frames))
            session.journal.note(datetime.now(UTC), "import", f"{len(frames)} frames from {frame_list.name}")
            session.write_frames_csv()
        except BaseException:
            session.close()
            shutil.rmtree(folder)
            raise
        unchecked = {frame.path.suffix.lower() for frame in frames if not _can_be_checked(frame.path)}
        return Imported(tuple(refused), tuple(_missing_frames(session)), tuple(sorted(unchecked)))


def _can_be_checked(path: Path) -> bool:
    with path.open("rb") as stream:
        return layout_is_known(stream.read(LAYOUT_START))


def _missing_frames(session: Session) -> list[str]:
    accepted = {(frame.kind, frame.illumination) for frame in session.frames() if frame.accepted}
    listed = dict.fromkeys((step.kind, step.illumination) for step in session.steps)
    return [
        f"every {kind} frame" if light is None else f"illuminant {light}"
        for kind, light in listed
        if (kind, light) not in accepted
    ]


def _step(number: int, frame: ListedFrame, lights: tuple[Illuminant, ...]) -> SessionStep:
    colour = WHITE if frame.kind == "white" else BLACK
    if frame.illumination is not None:
        colour = lights[frame.illumination].colour
    return SessionStep(number, frame.kind, frame.illumination, colour)


def _import_frame(
    session: Session, step: SessionStep, frame: ListedFrame, settings: LabSettings
) -> tuple[str | None, str]:
    """Copy and judge a frame; return the reason if it is refused, else None, and the SHA-256 of its file."""

    def copy(into: BinaryIO) -> CapturedFrame:
        with frame.path.open("rb") as stream:
            shutil.copyfileobj(stream, into, 1 << 20)
        return CapturedFrame(frame.path.name, frame.path.stat().st_size, frame.taken_at)

    attempt = session.journal.begin(step, f"frames/{step.stem}", frame.taken_at)
    received = session.receive(step.stem, copy)
    if frame.verdict == ACCEPTED:
        # An accepted file may still be damaged.
        content = whole_frame(received.path)
        reason = content if isinstance(content, str) else None
    elif frame.verdict:
        reason = frame.verdict.removeprefix(REFUSED).removeprefix(":").strip() or "the list gives no reason"
    else:
        reason = judge_file(received.path, frame.kind, settings)
    session.journal.commit(
        attempt,
        received,
        Judgement.of_reason("exposure" if not frame.verdict else "list", reason),
        exposure_s=frame.exposure_s,
        ended_at=frame.taken_at,
    )
    return reason, received.sha256
