"""A table that is being made: its hidden folder, and the checkpoint from which a build that was killed goes on.

The checkpoint is a finished piece (`foundation.pieces`) in the file `RECORD`. Its arrays lie beside that file, in one
that is named after the number of frames taken in: it is written before the record names it, and the one before is
removed after that.
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

RECORD = "checkpoint"  # Name of the record file in the hidden folder, and the beginning of the names of files of arrays


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """How far a table has come.

    - `identity`: what it is made of and by what; a build goes on from a checkpoint of the same identity only.
    - `frames`: what names each frame taken in, in their order.
    - `values`: anything JSON can hold; numbers are restored to the last bit.
    """

    identity: dict[str, Any]
    frames: list[str]
    values: dict[str, Any]
    arrays: dict[str, npt.NDArray[Any]]


class UnfinishedTable:
    """The hidden folder of a table that is being made; made by `unfinished_table`.

    `keep`: whether a later program may go on from here; no where that would lead to the same end.
    """

    def __init__(self, folder: Path, out: Path) -> None:
        self.folder = folder
        self.out = out
        self.keep = True

    def load(self, identity: dict[str, Any], frames: list[str]) -> Checkpoint | None:
        """Return how far an earlier program came; None where there is no checkpoint, or it was made of something else.

        A build goes on from a checkpoint of the same identity that took in the first of its `frames`.
        """
        record = self.folder / RECORD
        if not record.is_file() or not (self.folder / SAMPLES).is_file():
            return None
        for name, piece in read_pieces(record.read_bytes()).items():
            begun = frames[: int(name)]
            same = begun and piece.inputs == _hash_of(identity, begun)
            if same and piece.is_complete(lambda file: (self.folder / file).open("rb")):
                with np.load(self.folder / _arrays_of(begun), allow_pickle=False) as stored:
                    arrays: dict[str, npt.NDArray[Any]] = {key: stored[key] for key in stored.files}
                return Checkpoint(identity, begun, json.loads(piece.values), arrays)
        return None

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the checkpoint."""
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **checkpoint.arrays)
        arrays, data = _arrays_of(checkpoint.frames), stream.getvalue()
        write_atomic(self.folder / arrays, data)
        inputs = _hash_of(checkpoint.identity, checkpoint.frames)
        files = {arrays: sha256_of(data)}
        piece = Piece(str(len(checkpoint.frames)), inputs, files, json.dumps(checkpoint.values))
        write_atomic(self.folder / RECORD, piece.to_line())
        self._remove(kept={RECORD, arrays})

    def publish(self) -> None:
        """Give the table its final name."""
        require_free(self.out, "the table")
        try:
            self._remove()
            sync_folder(self.folder)
        except OSError as error:
            raise storage_error(self.out, error) from error
        publish_folder(self.folder, self.out, "the table")

    def _remove(self, kept: set[str] | None = None) -> None:
        for path in self.folder.glob(f"{RECORD}*"):
            if path.name not in (kept or ()):
                path.unlink()


def _arrays_of(frames: list[str]) -> str:
    return f"{RECORD}.{len(frames)}.npz"


def _hash_of(identity: dict[str, Any], frames: list[str]) -> str:
    return sha256_of(json.dumps([identity, frames], sort_keys=True).encode())


@contextmanager
def unfinished_table(out: Path) -> Generator[UnfinishedTable]:
    """Open, or make, the hidden folder of the table `out`; what is not published stays if it holds a checkpoint."""
    require_free(out, "the table")
    folder = partial_path(out)
    busy = f"{out} is being made by another program; wait for it, or name another place"
    with locked_folder(folder, busy, target=out):
        unfinished = UnfinishedTable(folder, out)
        try:
            yield unfinished
        finally:
            if folder.is_dir() and not (unfinished.keep and (folder / RECORD).is_file()):
                with contextlib.suppress(OSError):
                    shutil.rmtree(folder)
