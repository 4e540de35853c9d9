"""The hidden folder of an unfinished LUT, and the checkpoint from which a killed build resumes.

A checkpoint has two files. `RECORD` holds its values and hashes, as a `foundation.pieces.Piece`. The arrays are in a
file with the number of frames in its name. This file is written first, and the previous arrays are removed last.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.table.lut import SAMPLES
from foundation.files import partial_path, sha256_of, storage_error, sync_folder, write_atomic
from foundation.folders import locked_folder, publish_folder, require_free
from foundation.pieces import Piece, read_pieces

RECORD = "checkpoint"  # File name of the record, and prefix of the array files


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of an unfinished LUT."""

    identity: dict[str, Any]  # Inputs and options; a build resumes only with the same identity
    frames: list[str]  # Keys of the frames added so far, in their order
    values: dict[str, Any]  # JSON values; numbers are restored exactly
    arrays: dict[str, npt.NDArray[Any]]


class UnfinishedTable:
    """The hidden folder of an unfinished LUT; opened by `unfinished_table`.

    `keep`: whether a later build may resume; False for a refused LUT, which would be refused again.
    """

    def __init__(self, folder: Path, out: Path) -> None:
        self.folder = folder
        self.out = out
        self.keep = True

    def load(self, identity: dict[str, Any], frames: list[str]) -> Checkpoint | None:
        """Return the checkpoint of an earlier build; None if there is none, or if its inputs differ.

        Its identity must be `identity`, and its frames must be the first of `frames`, in the same order.
        """
        record = self.folder / RECORD
        if not record.is_file() or not (self.folder / SAMPLES).is_file():
            return None
        for name, piece in read_pieces(record.read_bytes()).items():
            finished_frames = frames[: int(name)]
            is_same = finished_frames and piece.inputs == _hash_of(identity, finished_frames)
            if is_same and piece.is_complete(lambda file: (self.folder / file).open("rb")):
                with np.load(self.folder / _arrays_of(finished_frames), allow_pickle=False) as stored:
                    arrays: dict[str, npt.NDArray[Any]] = {key: stored[key] for key in stored.files}
                return Checkpoint(identity, finished_frames, json.loads(piece.values), arrays)
        return None

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the checkpoint."""
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **checkpoint.arrays)
        arrays, data = _arrays_of(checkpoint.frames), stream.getvalue()
        write_atomic(self.folder / arrays, data)
        inputs_hash = _hash_of(checkpoint.identity, checkpoint.frames)
        files = {arrays: sha256_of(data)}
        piece = Piece(str(len(checkpoint.frames)), inputs_hash, files, json.dumps(checkpoint.values))
        write_atomic(self.folder / RECORD, piece.to_line())
        self._remove(keep={RECORD, arrays})

    def publish(self) -> None:
        """Move the folder to its final path."""
        require_free(self.out, "the LUT")
        try:
            self._remove()
            sync_folder(self.folder)
        except OSError as error:
            raise storage_error(self.out, error) from error
        publish_folder(self.folder, self.out, "the LUT")

    def _remove(self, keep: set[str] | None = None) -> None:
        for path in self.folder.glob(f"{RECORD}*"):
            if path.name not in (keep or ()):
                path.unlink()


def _arrays_of(frames: list[str]) -> str:
    return f"{RECORD}.{len(frames)}.npz"


def _hash_of(identity: dict[str, Any], frames: list[str]) -> str:
    return sha256_of(json.dumps([identity, frames], sort_keys=True).encode())


@contextmanager
def unfinished_table(out: Path) -> Generator[UnfinishedTable]:
    """Open or create the hidden folder of the LUT `out`; at the end it is removed if it has no checkpoint."""
    require_free(out, "the LUT")
    folder = partial_path(out)
    busy = f"{out} is being built by another program; wait until it has finished, or give another folder"
    with locked_folder(folder, busy, target=out):
        unfinished = UnfinishedTable(folder, out)
        try:
            yield unfinished
        finally:
            if folder.is_dir() and not (unfinished.keep and (folder / RECORD).is_file()):
                with contextlib.suppress(OSError):
                    shutil.rmtree(folder)
