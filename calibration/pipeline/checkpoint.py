"""A table that is being made: its hidden folder, and the checkpoint from which a build that was killed goes on."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.table.lut import SAMPLES
from foundation.files import partial_path, storage_error, sync_folder, write_whole
from foundation.folders import held_folder, publish_folder, require_free

CHECKPOINT = "checkpoint.npz"
"""Name of the checkpoint in the hidden folder."""

_TEXT = "text"
"""Name of the array that holds all that is no array, as JSON."""


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
        if not (self.folder / SAMPLES).is_file():
            return None
        try:
            with np.load(self.folder / CHECKPOINT, allow_pickle=False) as stored:
                arrays: dict[str, npt.NDArray[Any]] = {name: stored[name] for name in stored.files}
            text = json.loads(arrays.pop(_TEXT).tobytes())
            found = Checkpoint(text["identity"], text["frames"], text["values"], arrays)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return None
        began = bool(found.frames) and found.frames == frames[: len(found.frames)]
        return found if began and found.identity == identity else None

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the checkpoint."""
        content = {"identity": checkpoint.identity, "frames": checkpoint.frames, "values": checkpoint.values}
        text = np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **{**checkpoint.arrays, _TEXT: text})
        write_whole(self.folder / CHECKPOINT, stream.getvalue())

    def publish(self) -> None:
        """Give the table its final name."""
        require_free(self.out, "the table")
        try:
            (self.folder / CHECKPOINT).unlink(missing_ok=True)
            sync_folder(self.folder)
        except OSError as error:
            raise storage_error(self.out, error) from error
        publish_folder(self.folder, self.out, "the table")


@contextmanager
def unfinished_table(out: Path) -> Generator[UnfinishedTable]:
    """Open, or make, the hidden folder of the table `out`; what is not published stays if it holds a checkpoint."""
    require_free(out, "the table")
    folder = partial_path(out)
    busy = f"{out} is being made by another program; wait for it, or name another place"
    with held_folder(folder, busy, of=out):
        unfinished = UnfinishedTable(folder, out)
        try:
            yield unfinished
        finally:
            if folder.is_dir() and not (unfinished.keep and (folder / CHECKPOINT).is_file()):
                with contextlib.suppress(OSError):
                    shutil.rmtree(folder)
