"""Whether the raw files of a session are still what was taken: their bytes against the hashes in the journal.

What is missing, cut off or altered is found by its cause; the session voids it (`Session.verify`), so that the next
run takes it again. Nothing is deleted. A file that cannot be read stops the check: it may be sound, the cable loose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from acquisition.session.records import AcceptedFile
from foundation.errors import FormatError, StorageError
from foundation.files import storage_error
from foundation.hashing import file_sha256
from foundation.processors import ordered_map, processor_count

MOST_THREADS = 8
"""Files hashed at a time at most: chosen; SHA-256 runs at .5 to 2 GB/s a thread, faster together than any disk."""


def unsound_files(folder: Path, frames: Sequence[AcceptedFile], observe: Callable[[int, int], None]) -> dict[int, str]:
    """Return why frames cannot be used any longer, by attempt: their files are gone or changed, or others newer.

    Parameters
    ----------
    folder
        The session.
    frames
        Those that were accepted, oldest first.
    observe
        Called with files done and in all, once at the start and after each file.

    Raises
    ------
    FormatError
        The folder of the frames is missing.
    StorageError
        A file is there and cannot be read.
    """
    try:
        require_frames_folder(folder)
    except OSError as error:
        raise storage_error(folder / "frames", error) from error
    found: dict[int, str] = {}
    threads = min(processor_count(), MOST_THREADS)
    observe(0, len(frames))
    reasons = ordered_map(lambda frame: _fault(folder, frame), frames, threads)
    for done, (frame, reason) in enumerate(zip(frames, reasons, strict=True), 1):
        if reason:
            found[frame.attempt] = reason
        observe(done, len(frames))
    newest = {frame.step: frame for frame in frames if frame.attempt not in found}
    for frame in frames:
        if frame.attempt not in found and newest[frame.step] is not frame:
            found[frame.attempt] = f"taken again since, as {newest[frame.step].file}"
    return found


def require_frames_folder(folder: Path) -> None:
    """Refuse a session whose folder of raw files is missing: all of them would be taken again.

    Raises
    ------
    FormatError
        It is missing.
    OSError
        It cannot be looked for.
    """
    if not (folder / "frames").is_dir():
        raise FormatError(
            f"{folder / 'frames'} is missing, where the session's raw files are; restore it from a copy, or begin a "
            "new session"
        )


def _fault(folder: Path, frame: AcceptedFile) -> str:
    """Return what is wrong with a frame's file; empty if nothing is."""
    path = folder / frame.file
    try:
        size = path.stat().st_size
        if size != frame.size:
            return f"{frame.file} has {size} of {frame.size} bytes; it is taken again"
        changed = file_sha256(path) != frame.sha256
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return f"{frame.file} is missing; it is taken again"
    except OSError as error:
        raise StorageError(
            f"cannot read {path}: {error.strerror}; check the disk and the file's permissions, or remove the file to "
            "have its frame taken again, then run the same command again"
        ) from error
    return f"{frame.file} has changed since it was taken: its SHA-256 is another; it is taken again" if changed else ""
