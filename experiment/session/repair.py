"""What puts a session right: files that are damaged, and lights that are to be taken again.

Raw files are held against the hashes in the journal; the session voids what is missing, cut off or altered, so that the
next run takes it again. Nothing is deleted.
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

BAD = "bad"  # What stands for the lights that the newest report refused


# Files that the disk does not read (EIO) and that are given up: bad sectors are few; of a loose cable all are.
MOST_UNREADABLE = 3

# Files hashed at a time at most: chosen; SHA-256 runs at .5 to 2 GB/s a thread, faster together than any disk.
MOST_THREADS = 8

_RANGE = re.compile(r"\s*(\d{1,9})\s*(?:[-–]\s*(\d{1,9})\s*)?")


def unsound_files(folder: Path, frames: Sequence[AcceptedFile], observe: Callable[[int, int], None]) -> dict[int, str]:
    """Return why frames cannot be used any longer, by attempt: their files are gone or changed."""
    try:
        require_frames_folder(folder)
    except OSError as error:
        raise storage_error(folder / "frames", error) from error
    found: dict[int, str] = {}
    threads = min(processor_count(), MOST_THREADS)
    observe(0, len(frames))
    reasons = ordered_map(lambda frame: _fault(folder, frame), frames, threads)
    unread: list[tuple[AcceptedFile, OSError]] = []
    for done, (frame, reason) in enumerate(zip(frames, reasons, strict=True), 1):
        if isinstance(reason, OSError):
            unread.append((frame, reason))
            found[frame.attempt] = f"{frame.file} cannot be read: {reason.strerror}; it is taken again"
        elif reason:
            found[frame.attempt] = reason
        observe(done, len(frames))
    _require_readable(folder, unread)
    return found


def require_frames_folder(folder: Path) -> None:
    """Refuse a session whose folder of raw files is missing: all of them would be taken again."""
    if not (folder / "frames").is_dir():
        raise FormatError(
            f"{folder / 'frames'} is missing, where the session's raw files are; restore it from a copy, or begin a "
            "new session"
        )


def _require_readable(folder: Path, unread: Sequence[tuple[AcceptedFile, OSError]]) -> None:
    """Refuse files that cannot be read where they may be sound: their frames are not given up for a cable."""
    others = [(frame, error) for frame, error in unread if error.errno != errno.EIO]
    lasting = others or (unread if len(unread) > MOST_UNREADABLE else ())
    if lasting:
        frame, error = lasting[0]
        more = f" and {len(lasting) - 1} more" if lasting[1:] else ""
        raise StorageError(
            f"cannot read {folder / frame.file}{more}: {error.strerror}; check the disk, its cable and the "
            f"permissions, or move the files elsewhere to have their frames taken again, {RUN_AGAIN}"
        ) from error


def _fault(folder: Path, frame: AcceptedFile) -> str | OSError:
    """Return what is wrong with a frame's file, or why it cannot be read; empty if nothing is."""
    path = folder / frame.file
    try:
        size = path.stat().st_size
        if size != frame.size:
            return f"{frame.file} has {size} of {frame.size} bytes; it is taken again"
        changed = file_sha256(path) != frame.sha256
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return f"{frame.file} is missing; it is taken again"
    except OSError as error:
        return error
    return f"{frame.file} has changed since it was taken: its SHA-256 is another; it is taken again" if changed else ""


@dataclass(frozen=True)
class RefusedFrames:
    """What a report says of lights that are to be taken again.

    - `report`: the file that says so.
    - `lights`: their numbers, as `parse_lights` reads them; empty for none.
    - `sha256`: hashes of their frames.
    """

    report: Path
    lights: str
    sha256: frozenset[str]


def parse_lights(text: str, known: Collection[int]) -> tuple[int, ...]:
    """Return the lights of ``12,40-44``, rising, each once.

    Examples
    --------
    >>> parse_lights("7, 2-4,3", range(10))
    (2, 3, 4, 7)
    """
    lights: set[int] = set()
    for part in text.split(","):
        found = _RANGE.fullmatch(part)
        if found is None:
            raise InputError(
                f"--retake {text!r}: {part.strip()!r} is no light; name lights as 12,40-44, or {BAD} for those that "
                "build-lut refused"
            )
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise InputError(f"--retake {text!r}: {part.strip()} runs backwards; name it {last}-{first}")
        unknown = next((light for light in (first, last) if light not in known), None)
        if unknown is not None:
            raise InputError(
                f"--retake {text!r}: the session has no light {unknown}, its {len(known)} lights are "
                f"{min(known, default=0)} … {max(known, default=0)}"
            )
        lights.update(light for light in range(first, last + 1) if light in known)
    return tuple(sorted(lights))


def lights_text(lights: Collection[int]) -> str:
    """Return lights as `parse_lights` reads them.

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


def newest_report(session: Path, taken: Mapping[str, int]) -> RefusedFrames:
    """Return what the newest report on a session's frames, beside the session or in it, says is to be taken again.

    The newest is the one whose newest frame was taken last: what clocks said when reports were written counts only
    between reports on the same frames.
    """
    home = session.resolve()
    found: list[tuple[int, int, RefusedFrames]] = []
    for path in [*home.parent.glob("*/report.json"), *home.glob("*/report.json")]:
        with suppress(OSError, ValueError, TypeError, KeyError):
            says: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            refused = RefusedFrames(path, str(says["retake"]), frozenset(map(str, says["retake_sha256"])))
            newest = taken[says["newest_sha256"]]
            if says["registered_sha256"] in taken:
                found.append((newest, path.stat().st_mtime_ns, refused))
    if not found:
        raise FormatError(
            f"no report of build-lut on {session} lies beside it in {home.parent}; build the table there "
            f"(build-lut {session} {session}-lut), or name the lights, as in --retake 12,40-44"
        )
    return max(found, key=lambda entry: entry[:2])[2]
