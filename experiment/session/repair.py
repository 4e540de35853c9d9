"""Find the damaged files of a session, and the illuminants that must be repeated.

Raw files are compared with the hashes in the journal. If a file is missing, truncated or changed, its frame is voided,
so that the next run repeats it. Nothing is deleted.
"""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiment.session.records import AcceptedFile
from foundation.compiled import ordered_map, processor_count
from foundation.errors import RUN_AGAIN, FormatError, InputError, StorageError
from foundation.files import file_sha256, storage_error

BAD = "bad"  # Text that selects the illuminants refused by the newest report


# Largest number of files with a read error (EIO) whose frames are repeated. If more files have one, the cause is
# probably a loose cable, not bad sectors.
MOST_UNREADABLE = 3

# Largest number of files that are hashed at the same time. Chosen by judgement: so many threads outrun any disk.
MOST_THREADS = 8

_RANGE = re.compile(r"\s*(\d{1,9})\s*(?:[-–]\s*(\d{1,9})\s*)?")


def damaged_files(folder: Path, frames: Sequence[AcceptedFile], observe: Callable[[int, int], None]) -> dict[int, str]:
    """Return the reason for each attempt whose file is missing or changed."""
    try:
        require_frames_folder(folder)
    except OSError as error:
        raise storage_error(folder / "frames", error) from error
    reasons: dict[int, str] = {}
    threads = min(processor_count(), MOST_THREADS)
    observe(0, len(frames))
    faults = ordered_map(lambda frame: _fault(folder, frame), frames, threads)
    unreadable: list[tuple[AcceptedFile, OSError]] = []
    for count, (frame, fault) in enumerate(zip(frames, faults, strict=True), 1):
        if isinstance(fault, OSError):
            unreadable.append((frame, fault))
            reasons[frame.attempt] = f"{frame.file} cannot be read: {fault.strerror}; the frame is repeated"
        elif fault:
            reasons[frame.attempt] = fault
        observe(count, len(frames))
    _require_readable(folder, unreadable)
    return reasons


def require_frames_folder(folder: Path) -> None:
    """Refuse a session without its folder of raw files, because all its frames would be repeated."""
    if not (folder / "frames").is_dir():
        raise FormatError(
            f"{folder / 'frames'} with the raw files of the session is missing; restore it from a copy, or start a new "
            "session"
        )


def _require_readable(folder: Path, unread: Sequence[tuple[AcceptedFile, OSError]]) -> None:
    # The files may be intact, so their frames must not be repeated because of a cable.
    other_faults = [(frame, error) for frame, error in unread if error.errno != errno.EIO]
    lasting = other_faults or (unread if len(unread) > MOST_UNREADABLE else ())
    if lasting:
        frame, error = lasting[0]
        rest = f" and {len(lasting) - 1} more" if lasting[1:] else ""
        raise StorageError(
            f"cannot read {folder / frame.file}{rest}: {error.strerror}; check the disk, its cable and the "
            f"permissions, or move the files elsewhere to repeat their frames, {RUN_AGAIN}"
        ) from error


def _fault(folder: Path, frame: AcceptedFile) -> str | OSError:
    """Describe the damage of the file of a frame; return the error if it cannot be read, or "" if it is intact."""
    path = folder / frame.file
    try:
        size = path.stat().st_size
        if size != frame.size:
            return f"{frame.file} has {size} bytes, expected {frame.size}; the frame is repeated"
        changed = file_sha256(path) != frame.sha256
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return f"{frame.file} is missing; the frame is repeated"
    except OSError as error:
        return error
    return f"{frame.file} has changed since it was taken: its SHA-256 differs; the frame is repeated" if changed else ""


@dataclass(frozen=True)
class RefusedFrames:
    """Illuminants and frames that a report refuses."""

    report: Path  # file of the report
    lights: str  # numbers of the illuminants, as `parse_lights` reads them; may be empty
    sha256: frozenset[str]  # hashes of the frames


def parse_lights(text: str, valid_numbers: Collection[int]) -> tuple[int, ...]:
    """Parse numbers of illuminants such as ``12,40-44``; return them sorted, each once.

    Examples
    --------
    >>> parse_lights("7, 2-4,3", range(10))
    (2, 3, 4, 7)
    """
    lights: set[int] = set()
    for item in text.split(","):
        match = _RANGE.fullmatch(item)
        if match is None:
            raise InputError(
                f"--retake {text!r}: {item.strip()!r} is not the number of an illuminant; give numbers as 12,40-44, "
                f"or {BAD} for the illuminants that build-lut refused"
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise InputError(f"--retake {text!r}: {item.strip()} is a reversed range; write {last}-{first}")
        unknown = next((light for light in (first, last) if light not in valid_numbers), None)
        if unknown is not None:
            raise InputError(
                f"--retake {text!r}: the session has no illuminant {unknown}; give one of its {len(valid_numbers)} "
                f"illuminants, {min(valid_numbers, default=0)} … {max(valid_numbers, default=0)}"
            )
        lights.update(light for light in range(first, last + 1) if light in valid_numbers)
    return tuple(sorted(lights))


def lights_text(lights: Collection[int]) -> str:
    """Return numbers of illuminants as a text that `parse_lights` reads.

    Examples
    --------
    >>> lights_text([44, 12, 40, 41, 42, 43])
    '12,40-44'
    """
    ranges: list[list[int]] = []
    for light in sorted(set(lights)):
        if ranges and light == ranges[-1][1] + 1:
            ranges[-1][1] = light
        else:
            ranges.append([light, light])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)


def newest_report(session: Path, attempts: Mapping[str, int]) -> RefusedFrames:
    """Return the frames that the newest report refuses. Reports are searched in the session folder and next to it.

    The newest report is the report with the newest frame. If reports have the same newest frame, the file times decide.
    They are not used in other cases, because clocks may be wrong.

    `attempts`: attempt of each frame of the session, by hash.
    """
    home = session.resolve()
    reports: list[tuple[int, int, RefusedFrames]] = []
    for path in [*home.parent.glob("*/report.json"), *home.glob("*/report.json")]:
        with suppress(OSError, ValueError, TypeError, KeyError):
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            refused = RefusedFrames(path, str(content["retake"]), frozenset(map(str, content["retake_sha256"])))
            newest = attempts[content["newest_sha256"]]
            if content["registered_sha256"] in attempts:
                reports.append((newest, path.stat().st_mtime_ns, refused))
    if not reports:
        raise FormatError(
            f"{home.parent} has no report of build-lut on {session}; build the LUT there "
            f"(build-lut {session} {session}-lut), or give numbers of illuminants, as in --retake 12,40-44"
        )
    return max(reports, key=lambda entry: entry[:2])[2]
