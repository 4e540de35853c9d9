"""Whether the raw files of a session are still what was taken: their bytes against the hashes in the journal.

What is missing, cut off or altered is found by its cause; the session voids it (`Session.verify`), so that the next
run takes it again. Nothing is deleted. A few files that the disk does not read are taken again, too; where it
fails at more, or permissions are in the way, files may be sound, and an error names them when all were looked at.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from pathlib import Path

from experiment.session.records import AcceptedFile
from foundation.errors import FormatError, StorageError
from foundation.files import storage_error
from foundation.hashing import file_sha256
from foundation.processors import ordered_map, processor_count

MOST_UNREADABLE = 3
"""Files that the disk does not read (EIO) and that are given up: bad sectors are few; of a loose cable all are."""

MOST_THREADS = 8
"""Files hashed at a time at most: chosen; SHA-256 runs at .5 to 2 GB/s a thread, faster together than any disk."""


def unsound_files(folder: Path, frames: Sequence[AcceptedFile], observe: Callable[[int, int], None]) -> dict[int, str]:
    """Return why frames cannot be used any longer, by attempt: their files are gone or changed, or others newer."""
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
    newest = {frame.step: frame for frame in frames if frame.attempt not in found}
    for frame in frames:
        if frame.attempt not in found and newest[frame.step] is not frame:
            found[frame.attempt] = f"taken again since, as {newest[frame.step].file}"
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
            "permissions, or remove the files to have their frames taken again, then run the same command again"
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
